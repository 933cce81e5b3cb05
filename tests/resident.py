"""The memory this process holds, for tests that it stays flat."""

from __future__ import annotations

import os
from pathlib import Path

from lslam.pipeline.manifest import peak_memory_mb

STATM = Path("/proc/self/statm")


def resident_mb() -> float:
    """Memory this process holds, or has held at most where the system says no more; MB."""
    if STATM.exists():
        return int(STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    return peak_memory_mb() or 0.0
