"""Integrity of the trajectory: independent checks of the motion between scans, and alerts where poses may be lost."""
