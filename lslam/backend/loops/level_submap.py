"""Levelled keyframes, and submaps prepared for loop verification: Gaussian maps, source points, ground and other points."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lslam.core.config.odometry import RegistrationConfig
from lslam.core.geometry import se3, so3
from lslam.core.kernels import gaussians
from lslam.core.types.arrays import Floats, Longs, Points
from lslam.core.types.trajectory import Keyframe
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.local_map import COARSE_FACTOR
from lslam.registration.preprocessing.ground import NEAR_Z, Z
from lslam.registration.preprocessing.prepare import PreparedPoints

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
        replace(
            k,
            T_world_lidar=T @ k.T_world_lidar,
            covariance=None if k.covariance is None else turn @ k.covariance @ turn.T,
        )
        for k in keyframes
    ]


# m; larger voxels serve sparse single scans; a submap is dense.
LARGEST = 0.8
# Source points of a submap, at most.
SOURCE_POINTS = 4000
# Voxels allocated at first; a map needs room for as many more as points are inserted at once.
CAPACITY = 1 << 15
# Cosine; planes within 25 degrees of horizontal are ground and ceilings, which constrain no horizontal shift.
LEVEL_COSINE = float(np.cos(np.deg2rad(25)))


@dataclass(frozen=True)
class LevelSubmap:
    """A submap in level axes with z up, origin at its keyframe.

    fine, coarse : its Gaussian maps
    source : means of its voxels, the source points of a registration; upright : those of them on no horizontal plane
    non_ground : (N, 3) m, means of all voxels on no horizontal plane; ground : (M, 3) m, of those on one
    """

    fine: GaussianMap
    coarse: GaussianMap
    source: PreparedPoints
    upright: PreparedPoints
    non_ground: Floats
    ground: Floats


def make_level_submap(points: Points, config: RegistrationConfig) -> LevelSubmap:
    """Prepare the points (N, 3), m, of a submap in level axes, z up.

    Voxels with too few points for a Gaussian give no source points either.
    """
    fine = GaussianMap(
        min(config.voxel_size, LARGEST),
        reach=np.inf,
        capacity=CAPACITY,
    )
    for first in range(0, len(points), CAPACITY // 4):
        fine.insert(points[first : first + CAPACITY // 4], np.eye(4))
    kind = fine.planes[:, 7]
    solid = np.flatnonzero((fine.keys != gaussians.FREE) & (kind > gaussians.EMPTY))
    is_level = (kind[solid] >= 0) & (np.abs(fine.planes[solid, 5]) > LEVEL_COSINE)
    step = max(int(np.ceil(len(solid) / SOURCE_POINTS)), 1)
    chosen, is_upright = solid[::step], ~is_level[::step]
    return LevelSubmap(
        fine,
        fine.coarsen(COARSE_FACTOR),
        _source(fine, chosen),
        _source(fine, chosen[is_upright]),
        fine.planes[solid[~is_level], :3],
        fine.planes[solid[is_level], :3],
    )


def _source(target: GaussianMap, slots: Longs) -> PreparedPoints:
    """Means of voxels with the scatter round them."""
    s = target.moments[slots] / np.maximum(target.moments[slots, :1], 1.0)
    mean = s[:, 1:4]
    outer = mean[:, (0, 0, 0, 1, 1, 2)] * mean[:, (0, 1, 2, 1, 2, 2)]
    points = np.ascontiguousarray(target.planes[slots, :3])
    return PreparedPoints(np.zeros((0, 3), np.float32), points, np.ascontiguousarray(s[:, 4:10] - outer), len(points))
