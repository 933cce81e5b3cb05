"""Small grids of a geoid, as tests need them."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def write_gtx(path: Path, at_48: float, per_degree: float, low: tuple[float, float] = (48.0, 7.0)) -> Path:
    """A GTX grid of 3 x 3 deg from `low` lat, lon: `at_48` m high at its southern edge, `per_degree` m higher a degree north."""
    step, count = 0.25, 13
    rows = at_48 + per_degree * step * np.arange(count)
    head = np.array([*low, step, step], ">f8").tobytes() + np.array([count, count], ">i4").tobytes()
    path.write_bytes(head + np.tile(rows[:, None], (1, count)).astype(">f4").tobytes())
    return path
