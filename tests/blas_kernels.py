"""BLAS in the processes of tests as in the commands that they start, which pin it; imported before NumPy."""

from __future__ import annotations

from lslam.core.machine import pin_blas

pin_blas()
