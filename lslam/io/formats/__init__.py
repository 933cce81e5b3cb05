"""One codec per file format, read and write side by side."""
