"""Poses between stamped poses: translation linear, rotation along the geodesic."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.geometry import portable, se3, so3

Floats = NDArray[np.float64]


def poses_at(stamps_ns: NDArray[np.int64], poses: Floats, query_ns: NDArray[Any]) -> Floats:
    """Poses (M, 4, 4) at `query_ns` (M,) from increasing `stamps_ns` (N,) and `poses` (N, 4, 4), N >= 2.

    Queries outside the stamps extrapolate the first or last segment: the caller decides how far that is wise.
    """
    stamps = np.asarray(stamps_ns, np.int64)
    query = np.asarray(query_ns, np.int64)
    left = np.clip(np.searchsorted(stamps, query, side="right") - 1, 0, len(stamps) - 2)
    span = (stamps[left + 1] - stamps[left]).astype(np.float64)
    share = (query - stamps[left]).astype(np.float64) / span
    a, b = poses[left], poses[left + 1]
    R_a = a[:, :3, :3]
    turn = so3.log(portable.product(np.swapaxes(R_a, -1, -2), b[:, :3, :3]))
    t = a[:, :3, 3] + share[:, None] * (b[:, :3, 3] - a[:, :3, 3])
    return se3.make(portable.product(R_a, so3.exp(share[:, None] * turn)), t)
