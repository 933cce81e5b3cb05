"""Rotations, rigid transforms, alignment and geodesy on float64 NumPy arrays."""
