"""Drives made by a formula, for every test of the metrics."""

from __future__ import annotations

import numpy as np

from lslam.core.geometry import se3
from lslam.core.types.trajectory import Trajectory

STEP_NS = 100_000_000


def drive(count: int = 300, start_ns: int = 0, step_ns: int = STEP_NS) -> Trajectory:
    """A vehicle that advances along +x, brakes, stands, turns both ways and climbs a little; about 1 m per scan."""
    k = np.arange(count)
    speed = np.where((k > 120) & (k < 130), 0.0, 1.0 + 0.6 * np.sin(0.13 * k) + 0.2 * np.sin(0.031 * k))
    zero = np.zeros(count)
    turn = 0.02 * np.sin(0.05 * k) + 0.03 * np.sin(0.011 * k + 1)
    twist = np.stack(
        [speed, 0.01 * np.sin(0.3 * k), zero, 0.003 * np.sin(0.41 * k), 0.004 * np.sin(0.37 * k), turn], axis=1
    )
    poses = [np.eye(4)]
    for motion in se3.exp(twist[:-1]):
        poses.append(poses[-1] @ motion)
    return Trajectory(start_ns + k * np.int64(step_ns), np.array(poses), frame="lidar", source="truth")


def disturb(trajectory: Trajectory, size: float = 0.02, seed: int = 0, drift: float = 0.001) -> Trajectory:
    """The same drive with drift per scan and noise per pose (m; a tenth of it in rad)."""
    rng = np.random.default_rng(seed)
    n = len(trajectory)
    scale = np.array([1, 1, 1, 0.1, 0.1, 0.1])
    motion = se3.relative(trajectory.poses[:-1], trajectory.poses[1:]) @ se3.exp(
        drift * scale * rng.normal(size=(n - 1, 6))
    )
    poses = [trajectory.poses[0]]
    for m in motion:
        poses.append(poses[-1] @ m)
    noisy = np.array(poses) @ se3.exp(size * scale * rng.normal(size=(n, 6)))
    return Trajectory(trajectory.stamps_ns, noisy, frame=trajectory.frame, source="estimate")
