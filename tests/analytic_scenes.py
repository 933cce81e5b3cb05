"""Scenes of a few known surfaces, sampled afresh for every scan: what registration should find is known exactly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.core.geometry import se3, so3

Floats = NDArray[np.float64]
Points = NDArray[np.float32]
NOISE = 0.01


def rectangle(
    rng: np.random.Generator, n: int, normal_axis: int, offset: float, spans: list[tuple[float, float]]
) -> Floats:
    """Points (n, 3) on an axis-parallel rectangle with noise across it."""
    p = np.empty((n, 3))
    p[:, normal_axis] = rng.normal(offset, NOISE, n)
    for axis, (low, high) in zip([a for a in range(3) if a != normal_axis], spans, strict=True):
        p[:, axis] = rng.uniform(low, high, n)
    return p


def room(rng: np.random.Generator, n: int = 6000) -> Floats:
    """Floor and four walls, 20 m x 16 m, with a box in it."""
    return np.concatenate(
        [
            rectangle(rng, 2 * n, 2, -1.7, [(-10, 10), (-8, 8)]),
            *(rectangle(rng, n, 0, x, [(-8, 8), (-1.7, 3)]) for x in (-10, 10)),
            *(rectangle(rng, n, 1, y, [(-10, 10), (-1.7, 3)]) for y in (-8, 8)),
            rectangle(rng, n // 4, 0, 4.0, [(-5, -3), (-1.7, 0.5)]),
            rectangle(rng, n // 4, 1, -3.0, [(4, 7), (-1.7, 0.5)]),
        ]
    )


def corridor(rng: np.random.Generator, n: int = 8000, along: float = 0.0) -> Floats:
    """Floor and two walls without end; points lie within 25 m of x = `along`."""
    x = (along - 25, along + 25)
    return np.concatenate(
        [
            rectangle(rng, n, 2, -1.7, [x, (-3, 3)]),
            *(rectangle(rng, n, 1, y, [x, (-1.7, 3)]) for y in (-3, 3)),
        ]
    )


def floor_only(rng: np.random.Generator, n: int = 20000, around: tuple[float, float] = (0.0, 0.0)) -> Floats:
    """One plane, 40 m wide, round the sensor."""
    x, y = around
    return rectangle(rng, n, 2, -1.7, [(x - 20, x + 20), (y - 20, y + 20)])


def bushes(rng: np.random.Generator, n: int = 300, seed: int = 0) -> Floats:
    """Sixty round bushes on no ground at all: no voxel is a plane. Their places depend on `seed` only."""
    centres = np.random.default_rng(seed).uniform([-15, -15, -3], [15, 15, 5], (60, 3))
    return np.asarray((centres[:, None] + rng.normal(0, 0.3, (60, n, 3))).reshape(-1, 3))


def seen_from(world: Floats, pose: Floats) -> Points:
    """World points in the frame of a LiDAR at `pose` (4, 4)."""
    return se3.apply(se3.inverse(pose), world).astype(np.float32)


def pose_at(xyz: tuple[float, float, float] = (0.0, 0.0, 0.0), yaw_deg: float = 0.0) -> Floats:
    """(4, 4) level pose."""
    return se3.make(so3.exp(np.array([0.0, 0.0, np.deg2rad(yaw_deg)])), np.array(xyz))


def random_pose(rng: np.random.Generator, metres: float, degrees: float) -> Floats:
    """(4, 4) pose up to `metres` and `degrees` away from the origin."""
    axis, direction = rng.normal(size=(2, 3))
    turn = axis / np.linalg.norm(axis) * np.deg2rad(rng.uniform(0, degrees))
    return se3.make(so3.exp(turn), direction / np.linalg.norm(direction) * rng.uniform(0, metres))


def distance(a: Floats, b: Floats) -> tuple[float, float]:
    """Metres and degrees between two poses."""
    d = se3.relative(a, b)
    return float(np.linalg.norm(d[:3, 3])), float(np.rad2deg(so3.angle(d[:3, :3])))


def is_near(a: Floats, b: Floats, metres: float, degrees: float) -> bool:
    """Whether two poses lie within `metres` and `degrees` of each other."""
    away, turned = distance(a, b)
    return away < metres and turned < degrees
