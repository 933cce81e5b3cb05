"""What the machine offers to this process."""

from __future__ import annotations

import os


def available_cores() -> int:
    """Cores that this process may use; `OMP_NUM_THREADS`, which batch systems and our own studies set, is the limit."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limit = os.environ.get("OMP_NUM_THREADS", "")
    return max(1, min(cores, int(limit))) if limit.isdigit() else cores
