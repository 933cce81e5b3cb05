"""A submap made ready to be found again: its surfaces, and what of them stands up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.config.registration import RegistrationConfig
from lslam.kernels import gaussians
from lslam.preprocessing.prepare import PreparedPoints
from lslam.registration.gaussian_map import GaussianMap

Floats = NDArray[np.float64]
Points = NDArray[np.float32]

# m; larger voxels are for single scans, which are sparse; a submap is not.
LARGEST = 0.8
# Voxels of a submap that are registered on another, at most.
SOURCE_POINTS = 4000
# Voxels there is room for at first; a map must have room for as many more as points are added at once.
CAPACITY = 1 << 15
# Planes within 25 degrees of level are ground and ceilings: they fit wherever one is.
LEVEL = float(np.cos(np.deg2rad(25)))


@dataclass(frozen=True)
class Place:
    """What is kept of a submap while it is compared, level axes with z up, origin at its keyframe.

    fine, coarse : its surfaces
    source : means of its voxels, to be registered on another's surfaces; upright : those that are on no level plane
    standing : (N, 3) m, means of all voxels that are on no level plane; floor : (M, 3) m, of those that are
    """

    fine: GaussianMap
    coarse: GaussianMap
    source: PreparedPoints
    upright: PreparedPoints
    standing: Floats
    floor: Floats


def make_place(points: Points, config: RegistrationConfig) -> Place:
    """Prepare the points (N, 3), m, of a submap in level axes, z up.

    Voxels with too few points to be matched are no source either: what is seen so thinly will be seen elsewhere next time.
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
    return Place(
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
