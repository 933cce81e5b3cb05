"""What every room needs: values, geometry, configuration, shared kernels, errors, locks, stops, untrusted input."""

__version__ = "0.1.0"
