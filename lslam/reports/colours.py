"""The colours of maps: viridis, which is as even to eyes that are blind to some colours as to others."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Evenly spaced; between two of them colours are mixed.
VIRIDIS = (
    "440154", "481a6c", "472f7d", "414487", "39568c", "31688e", "2a788e", "23888e", "1f988b", "22a884", "35b779", "54c568",
    "7ad151", "a5db36", "d2e21b", "fde725",
)  # fmt: skip


def palette() -> NDArray[np.uint8]:
    """(16, 3) the colours above as red, green, blue."""
    return np.array([[int(colour[i : i + 2], 16) for i in (0, 2, 4)] for colour in VIRIDIS], np.uint8)


def usual_range(values: NDArray[np.floating]) -> tuple[float, float]:
    """The 2nd and 98th percentile of the finite values (0, 1 without any), so that a few stray ones take no colours away."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return 0.0, 1.0
    low, high = (float(v) for v in np.percentile(finite, [2, 98]))
    return low, max(high, low + 1e-3)
