"""Trajectories against ground truth: every number with its recipe."""
