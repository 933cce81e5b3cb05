"""Registers a scan on an earlier one from several starts, by fixed settings: none of the run's configuration.

A sensor that stands goes on seeing something in the same directions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Bools, Floats, Longs
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.geometry import se3
from lslam.core.kernels.linearisation import OUTLIER_SIGMAS
from lslam.core.types.scan import LEVER_M
from lslam.core.types.scan_result import SAME_M, motion_apart
from lslam.registration.alignment import voxel_terms
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.local_map import COARSE_FACTOR, LEAST_BREADTH, WIDE_FACTORS
from lslam.registration.optimiser import (
    COARSE_KERNEL_M,
    KERNEL_MIN_M,
    Annealing,
    Correspondences,
    Limits,
    Problem,
    Term,
    optimise,
)
from lslam.registration.policies import MUCH_RATIO
from lslam.registration.preprocessing.prepare import PreparedPoints
from lslam.registration.residuals import PLANES_ALONE
from lslam.registration.result import RegistrationResult

# Edge of a cell of directions, rad: two rings of sixteen beams, a hundred shots.
CELL_RAD = float(np.deg2rad(5.0))
# Points that tell the directions of a scan, and that fill a cell of them.
DIRECTION_POINTS, FILLING = 20_000, 3
# Share of the directions that empty: far from the few per cent of dropouts, and from the half and more of a cloud that leaves.
EMPTIED_SHARE = 0.25
# Cells are numbered by row, from the pole below upwards.
_ROWS = round(np.pi / CELL_RAD)
_COLUMNS = 2 * _ROWS


def directions(points: Floats) -> Longs:
    """(N,) index of the viewing cell, of roughly equal solid angle, of each of the points (N, 3) seen from the origin."""
    ranges = np.maximum(np.linalg.norm(points, axis=1), 1e-9)
    row = np.minimum((np.arcsin(points[:, 2] / ranges) + np.pi / 2) / CELL_RAD, _ROWS - 1).astype(np.int64)
    count = np.maximum(np.round(_COLUMNS * np.cos((row + 0.5) * CELL_RAD - np.pi / 2)), 1)
    column = np.minimum((np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5) * count, count - 1).astype(
        np.int64
    )
    return np.asarray(row * _COLUMNS + column)


def filled_directions(points: NDArray[np.floating]) -> Longs:
    """Numbers of the cells of `directions` that hold some of the points (N, 3), m."""
    cloud = points[:: 1 + len(points) // DIRECTION_POINTS, :3].astype(np.float64)
    ranges = np.linalg.norm(cloud, axis=1)
    cells, filling = np.unique(directions(cloud[np.isfinite(ranges) & (ranges > 0)]), return_counts=True)
    return np.asarray(cells[filling >= FILLING])


def empty_share(before: Longs, now: Longs) -> float:
    """Share of the directions that were filled before and are empty now, in that half of them, lower or upper, where it is less.

    What leaves in front of the sky empties directions, what leaves in front of the ground, or below a ceiling, does not.
    """
    is_lower = before < _ROWS // 2 * _COLUMNS
    is_empty = ~np.isin(before, now)
    halves = [is_empty[half] for half in (is_lower, ~is_lower) if half.any()]
    return min((float(half.mean()) for half in halves), default=0.0)


SETTINGS = RegistrationConfig()
# Edge of the smallest voxels as a part of the median range of the points: small against the room, and several points wide.
EDGE_SHARE = 0.2
# m; its bounds: a plane reaches as far as half an edge, which is the kernel's end width at least.
SMALLEST_M, LARGEST_M = 2 * KERNEL_MIN_M, COARSE_FACTOR * SETTINGS.voxel_size


@dataclass(frozen=True)
class MotionHypothesis:
    """A motion at which a scan fits the planes of an earlier one, and which of its points (S,) lie on them.

    in_view : number of points in directions in which the earlier scan had returns
    """

    result: RegistrationResult
    on_planes: Bools
    in_view: int

    @property
    def motion(self) -> Floats:
        """(4, 4) pose of the later scan in the earlier one."""
        return self.result.T_world_lidar

    @property
    def agreement(self) -> float:
        """Share of the points in view that lie on the planes; of half of all points, where fewer are in view."""
        return self.result.inliers / max(self.in_view, 0.5 * len(self.on_planes), 1.0)

    @cached_property
    def sigma(self) -> Floats | None:
        """(6,) standard deviation, m and rad; None where too few points fit."""
        return None if self.result.covariance is None else np.sqrt(np.diag(self.result.covariance))

    def own_points(self, other: MotionHypothesis) -> int:
        """Number of points that this motion explains and the other does not."""
        return int(np.count_nonzero(self.on_planes & ~other.on_planes))

    def is_same(self, other: MotionHypothesis) -> bool:
        """Whether both motions agree within their sigmas; True where a sigma is unknown."""
        if other is self or is_near(self.motion, other.motion):
            return True
        if self.sigma is None or other.sigma is None:
            return True
        bound = np.repeat([SAME_M, SAME_M / LEVER_M], 3) + OUTLIER_SIGMAS * np.hypot(self.sigma, other.sigma)
        return bool(np.all(np.abs(motion_apart(self.motion, other.motion)) < bound))


class PairRegistration:
    """Registers a later scan on the planes of an earlier one, in voxels of three sizes that follow the scale of the scene."""

    def __init__(self) -> None:
        # One scan has no fine planes.
        self._planes = tuple(
            GaussianMap(LARGEST_M * wider, reach=1e4, capacity=1 << 13, breadth=LEAST_BREADTH)
            for wider in (1, *WIDE_FACTORS)
        )
        self._edge = LARGEST_M
        self._terms: list[Term] = []
        self._matches = Correspondences(0)
        self._view: Longs = np.zeros(0, np.int64)
        self._source: Floats = np.zeros((0, 3))

    def begin(self, first: Floats, last: PreparedPoints) -> None:
        """Set the points (N, 3), m, of the earlier scan, and those of the later one to register."""
        self._edge = float(np.clip(EDGE_SHARE * median_range(first), SMALLEST_M, LARGEST_M))
        for level, wider in zip(self._planes, (1, *WIDE_FACTORS), strict=True):
            level.clear()
            level.size = self._edge * wider
            level.insert(first.astype(np.float32), np.eye(4))
        sigma = SETTINGS.sigma
        self._view, self._source = filled_directions(first), last.source
        # What one start looked up the others need not.
        self._matches = Correspondences(len(last.source))
        self._terms = voxel_terms(PLANES_ALONE, PLANES_ALONE.points(last, sigma), self._planes, self._matches, sigma)

    def near(self, start: Floats) -> MotionHypothesis:
        """The motion (4, 4) registered from `start`, within reach of the planes."""
        return self._register(start, Annealing(self._edge / 2, SETTINGS.max_iterations))

    def far(self, start: Floats) -> MotionHypothesis:
        """The motion registered from `start` (4, 4) by a search of some metres around it."""
        return self._register(start, Annealing.slow(COARSE_KERNEL_M))

    def at(self, motion: Floats) -> MotionHypothesis:
        """The hypothesis of a given motion (4, 4), refined by one step, with the points that fit there."""
        return self._register(motion, Annealing.once(KERNEL_MIN_M))

    def _register(self, start: Floats, annealing: Annealing) -> MotionHypothesis:
        """Register the later scan on the planes from `start` (4, 4), and mark the points that lie on them."""
        motion = optimise(Problem(self._terms, start, annealing, Limits(SETTINGS.weak_share), self._matches))
        distance2 = self._matches.distance2
        cells = directions(se3.apply(motion.T_world_lidar, self._source))
        on_planes = (distance2 >= 0) & (distance2 < KERNEL_MIN_M**2)
        return MotionHypothesis(motion, on_planes, int(np.isin(cells, self._view).sum()))


def best_of(hypotheses: Sequence[MotionHypothesis]) -> tuple[MotionHypothesis, MotionHypothesis | None]:
    """The motion with the most points, the first one unless another has many more (`MUCH_RATIO`), and its rival.

    A rival is another motion whose own points are at least half as many as those of the best.
    """
    best = max(hypotheses, key=lambda h: h.result.inliers)
    if best.result.inliers <= MUCH_RATIO * hypotheses[0].result.inliers:
        best = hypotheses[0]
    rivals = [h for h in hypotheses if not h.is_same(best) and 2 * h.own_points(best) >= best.own_points(h)]
    return best, max(rivals, key=lambda h: h.own_points(best), default=None)


def is_near(a: Floats, b: Floats) -> bool:
    """Whether two motions (4, 4) differ so little that they are one."""
    return is_within(se3.relative(a, b), SAME_M)


def is_within(motion: Floats, metres: float) -> bool:
    """Whether a motion (4, 4) goes no farther, and turns by no more at `LEVER_M`."""
    # The distance of a rotation from none is sqrt(8) sin of half its angle.
    turn = float(np.linalg.norm(motion[:3, :3] - np.eye(3)))
    return float(np.linalg.norm(motion[:3, 3])) < metres and turn < np.sqrt(8.0) * np.sin(0.5 * metres / LEVER_M)


def median_range(points: Floats) -> float:
    """m, of points (N, 3)."""
    return float(np.median(np.linalg.norm(points, axis=1))) if len(points) else 0.0
