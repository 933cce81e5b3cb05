"""Planar poses (..., 3): x, y (m), yaw (rad, wrapped to -pi..pi); `a` of `b` is read as T_a_b of the 3D house."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats


def wrap(angle: NDArray[Any] | float) -> Floats:
    """Angles, rad, in -pi..pi."""
    return np.asarray((np.asarray(angle, np.float64) + np.pi) % (2 * np.pi) - np.pi)


def rotation(yaw: float) -> Floats:
    """(2, 2) rotation matrix by `yaw`, rad."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s], [s, c]])


def compose(a: NDArray[Any], b: NDArray[Any]) -> Floats:
    """The pose T_a_b T_b_c of two planar poses: `b`, which is given in the frame of `a`, in the frame in which `a` is given."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = a[..., 0] + c * b[..., 0] - s * b[..., 1]
    y = a[..., 1] + s * b[..., 0] + c * b[..., 1]
    return np.stack([x, y, wrap(a[..., 2] + b[..., 2])], axis=-1)


def inverse(pose: NDArray[Any]) -> Floats:
    """The inverse pose: that of the reference frame, seen from `pose`."""
    pose = np.asarray(pose, np.float64)
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x, y = pose[..., 0], pose[..., 1]
    return np.stack([-c * x - s * y, s * x - c * y, wrap(-pose[..., 2])], axis=-1)


def relative(a: NDArray[Any], b: NDArray[Any]) -> Floats:
    """Pose `b` in the frame of pose `a`: inverse(a) composed with b."""
    return compose(inverse(a), b)


def apply(pose: NDArray[Any], points: NDArray[Any]) -> Floats:
    """Points (..., 2), m, given in the frame of `pose` (3,), in the frame in which `pose` is given."""
    return np.asarray(np.asarray(points, np.float64) @ rotation(float(pose[2])).T + np.asarray(pose, np.float64)[:2])


def of_se3(T: NDArray[Any]) -> Floats:
    """(..., 3) position and heading of the x axis of poses (..., 4, 4), seen from above."""
    T = np.asarray(T, np.float64)
    return np.stack([T[..., 0, 3], T[..., 1, 3], np.arctan2(T[..., 1, 0], T[..., 0, 0])], axis=-1)


def to_se3(pose: NDArray[Any]) -> Floats:
    """(4, 4) of a planar pose (3,) at height 0."""
    T = np.eye(4)
    T[:2, :2] = rotation(float(pose[2]))
    T[:2, 3] = pose[:2]
    return T
