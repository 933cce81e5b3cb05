"""The vertical in the world of odometry, which is as tilted as the sensor was at the first scan."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lslam.geometry import se3, so3
from lslam.preprocessing.ground import Z
from lslam.preprocessing.up import NEAR_Z
from lslam.registration.gaussian_map import GaussianMap
from lslam.types.trajectory import Keyframe

Floats = NDArray[np.float64]

# Cosines: surfaces tilted by less against the estimate so far are taken for ground, floors and flat roofs.
ROUNDS = tuple(float(np.cos(np.deg2rad(limit))) for limit in (45.0, 30.0, 20.0, 15.0, 15.0))


def find_up(maps: Iterable[GaussianMap], mounted: Floats = Z) -> Floats:
    """(3,) unit vector: the mean normal of nearly horizontal planes, with a tighter limit each round.

    mounted : (3,) unit vector, up by the mounting of the sensor, which the first round begins with and no plane leaves as it is
    """
    planes = [m.planes[m.planes[:, 7] >= 0, 3:6] for m in maps]
    normals = np.concatenate([*planes, np.zeros((0, 3))])
    up = mounted
    for limit in ROUNDS:
        along = normals @ up
        near = normals[np.abs(along) > limit] * np.sign(along[np.abs(along) > limit, None])
        if len(near) == 0:
            break
        up = near.mean(axis=0)
        up /= np.linalg.norm(up)
    return up


def level_rotation(up: Floats) -> Floats:
    """(3, 3) a rotation that makes the unit vector `up` (3,) the z axis: the least, or x stays ahead where up is far from z."""
    if up[2] <= NEAR_Z:
        return so3.level_frame(up)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    return np.eye(3) if sine < 1e-12 else so3.exp(axis / sine * np.arctan2(sine, up[2]))


def levelled(keyframes: Sequence[Keyframe], up: Floats) -> list[Keyframe]:
    """The keyframes in a world turned so that the unit vector `up` (3,) is its z axis."""
    R = level_rotation(up)
    T, turn = se3.make(R, np.zeros(3)), np.kron(np.eye(2), R)
    return [
        replace(k, T_world_lidar=T @ k.T_world_lidar, covariance=None if k.covariance is None else turn @ k.covariance @ turn.T)
        for k in keyframes
    ]  # fmt: skip
