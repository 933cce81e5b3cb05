"""Compiled loops that rooms share: bare arrays in, bare arrays out. They import kernels alone; jit.py has the compile policy."""
