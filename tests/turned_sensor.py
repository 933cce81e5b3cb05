"""A drive as a sensor records it that hangs, lies or is pitched in its place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lslam.backend.keyframes.store import KeyframeStore
from lslam.core.geometry import se3, so3

Floats = NDArray[np.float64]
# Roll, pitch, yaw, deg.
TURNS = {"upside down": (180.0, 0.0, 0.0), "pitched 60": (0.0, 60.0, 0.0), "pitched 90": (0.0, 90.0, 0.0)}


def turn(name: str) -> Floats:
    """(3, 3) from the frame of the turned sensor to that of the upright one."""
    return np.asarray(so3.from_euler_rpy(np.deg2rad(TURNS[name])))


def turned_points(points: NDArray[np.float32], R: Floats) -> NDArray[np.float32]:
    """Points (N, 3) in the frame of the turned sensor."""
    return np.ascontiguousarray(points @ R.astype(np.float32))


def turned_pose(T: Floats, R: Floats) -> Floats:
    """The pose (4, 4) in a world that begins at the turned sensor."""
    body = se3.make(R, np.zeros(3))
    return np.asarray(se3.inverse(body) @ T @ body)


def turned_store(store: KeyframeStore, R: Floats) -> KeyframeStore:
    """The keyframes as a run with the turned sensor has them; covariances, which nobody asks for, are left out."""
    out = KeyframeStore()
    for k in store.keyframes:
        T = turned_pose(k.T_world_lidar, R)
        out.add(replace(k, T_world_lidar=T, covariance=None), turned_points(store.points(k.number), R))
    return out
