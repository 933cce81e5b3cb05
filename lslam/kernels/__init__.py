"""Compiled loops: bare arrays in, bare arrays out. Nothing here knows the rest of lslam; jit.py holds the compile policy."""
