"""What the machine offers to this process."""

from __future__ import annotations

import os
import platform


def available_cores() -> int:
    """Cores that this process may use; `OMP_NUM_THREADS`, which batch systems and our own studies set, is the limit."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limit = os.environ.get("OMP_NUM_THREADS", "")
    return max(1, min(cores, int(limit))) if limit.isdigit() else cores


def pin_blas() -> None:
    """Let OpenBLAS, once NumPy and SciPy load it, take the kernels that every x86-64 processor has: the same bytes on each.

    Matrices of this program are small, so that these kernels cost it nothing.
    """
    if platform.machine().lower() in ("x86_64", "amd64"):
        os.environ["OPENBLAS_CORETYPE"] = "Nehalem"
