"""A room of known planes, and a walk through it, for tests of poses that planes correct."""

from __future__ import annotations

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.geometry import se3, so3


def in_room(poses: Floats, of_a_scan: int, rng: np.random.Generator, noise: float = 0.005) -> tuple[Floats, Longs]:
    """Points of floor and four walls of a room of 12 x 8 x 3 m in the frame of each pose, and the pose of each."""
    parts = []
    for T in poses:
        u = rng.random((of_a_scan, 3)) * [12.0, 8.0, 3.0]
        wall = rng.integers(0, 5, of_a_scan)
        for k, (axis, at) in enumerate([(2, 0.0), (0, 0.0), (0, 12.0), (1, 0.0), (1, 8.0)]):
            u[wall == k, axis] = at + noise * rng.normal(size=int((wall == k).sum()))
        parts.append(se3.apply(se3.inverse(T), u))
    return np.concatenate(parts), np.repeat(np.arange(len(poses)), of_a_scan)


def walk(count: int) -> Floats:
    """Poses (count, 4, 4) along a curve through the room."""
    s = np.linspace(0.0, 1.0, count)
    t = np.column_stack([2 + 8 * s, 4 + 2 * np.sin(6 * s), 1.5 + 0.1 * np.sin(20 * s)])
    return se3.make(so3.exp(np.column_stack([0 * s, 0 * s, 2 * s])), t)
