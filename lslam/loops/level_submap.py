"""A submap prepared for loop verification: Gaussian maps, source points, and points split into ground and non-ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.config.odometry import RegistrationConfig
from lslam.kernels import gaussians
from lslam.preprocessing.prepare import PreparedPoints
from lslam.registration.gaussian_map import GaussianMap

Floats = NDArray[np.float64]
Points = NDArray[np.float32]

# m; larger voxels serve sparse single scans; a submap is dense.
LARGEST = 0.8
# Source points of a submap, at most.
SOURCE_POINTS = 4000
# Voxels allocated at first; a map needs room for as many more as points are inserted at once.
CAPACITY = 1 << 15
# Cosine; planes within 25 degrees of horizontal are ground and ceilings, which constrain no horizontal shift.
LEVEL = float(np.cos(np.deg2rad(25)))


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
        min(config.voxel_size, LARGEST), min_points=config.min_points, planarity=config.planarity, count_cap=config.count_cap,
        reach=np.inf, capacity=CAPACITY,
    )  # fmt: skip
    for first in range(0, len(points), CAPACITY // 4):
        fine.insert(points[first : first + CAPACITY // 4], np.eye(4))
    kind = fine.planes[:, 7]
    solid = np.flatnonzero((fine.keys != gaussians.FREE) & (kind > gaussians.EMPTY))
    is_level = (kind[solid] >= 0) & (np.abs(fine.planes[solid, 5]) > LEVEL)
    step = max(int(np.ceil(len(solid) / SOURCE_POINTS)), 1)
    chosen, is_upright = solid[::step], ~is_level[::step]
    return LevelSubmap(
        fine,
        fine.coarsen(config.coarse_factor),
        _source(fine, chosen),
        _source(fine, chosen[is_upright]),
        fine.planes[solid[~is_level], :3],
        fine.planes[solid[is_level], :3],
    )


def _source(target: GaussianMap, slots: NDArray[np.int64]) -> PreparedPoints:
    """Means of voxels with the scatter round them."""
    s = target.moments[slots] / np.maximum(target.moments[slots, :1], 1.0)
    mean = s[:, 1:4]
    outer = mean[:, (0, 0, 0, 1, 1, 2)] * mean[:, (0, 1, 2, 1, 2, 2)]
    points = np.ascontiguousarray(target.planes[slots, :3])
    return PreparedPoints(np.zeros((0, 3), np.float32), points, np.ascontiguousarray(s[:, 4:10] - outer), len(points))
