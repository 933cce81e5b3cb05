"""Recordings and trajectories into other formats and frames."""
