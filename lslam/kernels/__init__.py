"""Compiled loops: bare arrays in, bare arrays out. They import nothing else of lslam; jit.py has the compile policy."""
