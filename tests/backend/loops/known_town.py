"""A town of walls on a plane, and what a LiDAR sees of it: where everything is, is known exactly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.core.geometry import se3, so3
from lslam.core.types.trajectory import Keyframe

Floats = NDArray[np.float64]
Points = NDArray[np.float32]

HEIGHT = 1.7
NOISE = 0.02


def box(x: float, y: float, width: float, depth: float, height: float, step: float = 0.3) -> Floats:
    """Points (N, 3) on the four walls of a house whose corner is at x, y."""
    up = np.arange(0, height, step)
    along, across = np.arange(0, width, step), np.arange(0, depth, step)
    walls = [(along, np.full_like(along, s)) for s in (0.0, depth)]
    walls += [(np.full_like(across, s), across) for s in (0.0, width)]
    line = np.concatenate([np.column_stack(wall) for wall in walls]) + np.array([x, y])
    return np.column_stack([np.repeat(line, len(up), axis=0), np.tile(up, len(line))])


def town(seed: int = 0, size: float = 90.0) -> Floats:
    """Houses of all sizes along both sides of a square street that runs at +-`size` / 2, on level ground."""
    rng = np.random.default_rng(seed)
    houses = []
    for side in range(4):
        for offset in (6.0, -6.0):
            at = -size / 2 - 10
            while at < size / 2:
                width, depth, height = rng.uniform(5, 14), rng.uniform(5, 10), rng.uniform(3, 9)
                set_back = rng.uniform(0, 3)
                y = -size / 2 + (offset + set_back if offset > 0 else offset - set_back - depth)
                turned = box(at, y, width, depth, height)
                houses.append(turned @ so3.exp(np.array([0, 0, side * np.pi / 2])).T)
                at += width + rng.uniform(2, 9)
    ground = np.stack(np.meshgrid(*[np.arange(-size, size, 0.3)] * 2), axis=-1).reshape(-1, 2)
    return np.concatenate([*houses, np.column_stack([ground, np.zeros(len(ground))])])


def terrace(houses: int = 12, period: float = 14.0) -> Floats:
    """A street along x with the same house every `period` m on both sides."""
    rows = [box(k * period, y, 9, 8, 6) for k in range(houses) for y in (5.0, -13.0)]
    x, y = np.arange(-10, houses * period + 10, 0.3), np.arange(-14, 14, 0.3)
    ground = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return np.concatenate([*rows, np.column_stack([ground, np.zeros(len(ground))])])


def seen(world: Floats, pose: Floats, rng: np.random.Generator, reach: float = 40.0) -> Points:
    """World points within reach of a LiDAR at `pose` (4, 4), in its frame, with noise."""
    near = world[((world[:, :2] - pose[:2, 3]) ** 2).sum(axis=1) < reach**2]
    points = se3.apply(se3.inverse(pose), near) + rng.normal(0, NOISE, (len(near), 3))
    return points.astype(np.float32)


def pose(x: float, y: float, yaw_deg: float = 0.0, roll_deg: float = 0.0, pitch_deg: float = 0.0) -> Floats:
    """(4, 4) pose of a LiDAR above x, y."""
    turn = so3.from_euler_rpy(np.deg2rad([roll_deg, pitch_deg, yaw_deg]))
    return se3.make(turn, np.array([x, y, HEIGHT]))


def round_the_square(distance: float, size: float = 90.0) -> Floats:
    """(4, 4) pose after so many metres along the street, heading along it."""
    side, along = divmod(distance, size)
    R = so3.exp(np.array([0.0, 0.0, (side % 4) * np.pi / 2]))
    return se3.make(R, R @ np.array([along - size / 2, -size / 2, HEIGHT]))


def keyframes_of(poses: Floats, covariance: Floats | None = None) -> list[Keyframe]:
    """Keyframes at poses (K, 4, 4) with the distances between them."""
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    return [
        Keyframe(k, k, k * 100_000_000, T, covariance, float(d))
        for k, (T, d) in enumerate(zip(poses, travelled, strict=False))
    ]
