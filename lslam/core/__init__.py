"""What every room needs: values, geometry, configuration, shared kernels, errors, locks, stops, untrusted input."""
