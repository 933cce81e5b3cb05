"""BLAS in the processes of tests as in the commands that they start, which pin it; imported before NumPy."""

from __future__ import annotations

import os

from lslam.machine import pin_blas

pin_blas()
# Workers fill the cores already; threads of BLAS on small matrices wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
