"""The version of lslam: one place, no imports."""

__version__ = "0.1.0"
