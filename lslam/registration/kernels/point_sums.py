"""Points that have several matches each: what they may match stands first among their slots."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.core.kernels.jit import inline

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]


@inline
def keep(i: int, slots: Ints, rows: Floats, column: int, least: float) -> None:
    """Of the slots (8,) of point i leave those whose entry in a `column` of `rows` (C, N) is above `least`, before all -1."""
    used = 0
    for k in range(8):
        s = slots[i, k]
        slots[i, k] = -1
        if s >= 0 and rows[s, column] > least:
            slots[i, used] = s
            used += 1
