"""Bytes to values and back: codecs, data sets on disk, remote storage."""
