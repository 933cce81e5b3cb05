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
    """Let OpenBLAS, once NumPy and SciPy load it, take one core and kernels that every x86-64 processor has.

    So sums have one order, and bytes are the same on each machine. Matrices of this program are small: more cores would wait for
    each other, a hundred times as long where others use them.
    """
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    if platform.machine().lower() in ("x86_64", "amd64"):
        os.environ["OPENBLAS_CORETYPE"] = "Nehalem"
