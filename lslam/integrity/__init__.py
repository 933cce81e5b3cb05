"""Integrity of the trajectory: the motion between scans checked beside the method, and alerts where its poses may be lost."""
