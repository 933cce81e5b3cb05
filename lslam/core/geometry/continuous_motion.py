"""Pose at any instant between poses that were estimated."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from lslam.core.geometry import se3

Floats = NDArray[np.float64]
Stamps = NDArray[np.int64]


class ContinuousMotion:
    """Motion through poses by cubic splines, in rotation those of Kang and Park (1999).

    A straight line between two poses would cut the swing of a hand: at 2 Hz and 10 scans a second by a fifth.

    stretches : stamps (N,), ns, increasing, and poses (N, 4, 4), N >= 2, of each; shorter ones are left out. Nothing is known
        between two of them
    """

    def __init__(self, stretches: Iterable[tuple[Stamps, Floats]]) -> None:
        from scipy.interpolate import CubicSpline
        from scipy.spatial.transform import Rotation, RotationSpline

        self._parts = []
        for stamps, poses in stretches:
            if len(stamps) < 2:
                continue
            seconds = 1e-9 * (stamps - stamps[0])
            turning = RotationSpline(seconds, Rotation.from_matrix(poses[:, :3, :3]))
            self._parts.append((stamps, CubicSpline(seconds, poses[:, :3, 3]), turning))

    def at(self, stamps_ns: Stamps) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """Poses (K, 4, 4) and turning rates (K,), rad/s, at `stamps_ns` (K,), and whether a stretch covers the instant."""
        poses, rates = np.tile(np.eye(4), (len(stamps_ns), 1, 1)), np.zeros(len(stamps_ns))
        within = np.zeros(len(stamps_ns), np.bool_)
        for stamps, path, turning in self._parts:
            inside = (stamps_ns >= stamps[0]) & (stamps_ns <= stamps[-1])
            if inside.any():
                seconds = 1e-9 * (stamps_ns[inside] - stamps[0])
                poses[inside] = se3.make(turning(seconds).as_matrix(), path(seconds))
                rates[inside] = np.linalg.norm(turning(seconds, 1), axis=1)
            within |= inside
        return poses, rates, within
