"""Scan against local map: Gaussian voxels, robust kernels, the solver."""
