"""The one optimiser: annealed Gauss-Newton over whatever residuals are handed to it.

The kernels hold no GIL; between two of them there is a handful of Python, microseconds of the milliseconds that a scan takes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lslam.core.arrays import Floats, Ints, Longs
from lslam.core.geometry import se3
from lslam.core.kernels import linearisation as at
from lslam.core.kernels.gauss_newton import UNSEEN_SHARE, step, step_on_surfaces, trimming_distance2
from lslam.core.types.scan import LEVER_M
from lslam.registration.result import RegistrationResult

# A step below these ends the iteration: a tenth of the noise of a point, and what that is of a turn.
STEP_M = 1e-3
STEP_RAD = STEP_M / LEVER_M
# m; the kernel's width at the end, five sigma of a point, and its factor from step to step.
KERNEL_MIN_M, KERNEL_DECAY = 0.15, 0.5
# Coarse planes: the kernel's width at the start, m, which is the capture range, and its factor.
COARSE_KERNEL_M, COARSE_DECAY = 5.0, 0.85
# Steps of each stage while starting or recovering.
START_ITERATIONS = 40
EVERYWHERE: Floats = np.zeros((0, 6))


@dataclass(frozen=True)
class Annealing:
    """Widths of the Geman-McClure kernel, m: from `start` times `decay` per step down to `end`, `steps` at most."""

    start: float
    steps: int
    end: float = KERNEL_MIN_M
    decay: float = KERNEL_DECAY

    @classmethod
    def slow(cls, width: float) -> Annealing:
        """Widths from `width`, m, on that narrow slowly, for coarse planes and starts far off."""
        return cls(width, START_ITERATIONS, decay=COARSE_DECAY)

    @classmethod
    def once(cls, width: float) -> Annealing:
        """One step at `width`, m."""
        return cls(width, 1, width)


class Correspondences:
    """Squared distances (count,), m2, of source points to their matches, negative without one; shared by the maps of a problem.

    It also keeps the voxels that were looked up in each map, for reuse while that map is unchanged.
    """

    def __init__(self, count: int) -> None:
        self.is_done = np.zeros(count, np.bool_)
        self.distance2 = np.full(count, -1.0)
        self._looked_up: dict[object, tuple[Any, ...]] = {}

    def __len__(self) -> int:
        return len(self.distance2)

    def clear(self) -> None:
        """Mark all points as unmatched."""
        self.is_done.fill(False)
        self.distance2.fill(-1.0)

    def search(self, target: object = None) -> tuple[Any, ...]:
        """Arrays that a residual keeps of its search in one map, of type `Search` in `core.kernels.linearisation`."""
        if target not in self._looked_up:
            count = len(self)
            self._looked_up[target] = (*slots_of(count), np.empty((count, 2), np.int32), np.empty((count, 4)))
        return *self._looked_up[target], self.is_done, self.distance2


def slots_of(count: int) -> tuple[Longs, Ints]:
    """Arrays for the octant cells (count, ...) and voxel slots of so many points, nothing looked up yet.

    The system provides memory only for what is written.
    """
    return np.full(count, -1, np.int64), np.empty((count, 8), np.int32)


@dataclass(frozen=True)
class Term:
    """A residual of some points on one map: its compiled `linearise` and what this takes, see `core.kernels.linearisation`."""

    linearise: Callable[..., None]
    points: tuple[Any, ...]
    target: tuple[Any, ...]
    settings: tuple[float, ...]
    search: tuple[Any, ...] = ()


@dataclass(frozen=True)
class Limits:
    """When a direction counts as observed, and which may be stepped in.

    weak_share : part of the information below which it does not; least : 1/m2, likewise
    unseen : part of either below which it is not even followed
    by_surfaces : the residual's matrices are full, and its surfaces alone tell
    directions : (6, 6) projector on the directions of the steps; no rows: all
    """

    weak_share: float
    least: float = 0.0
    unseen: float = UNSEEN_SHARE
    by_surfaces: bool = False
    directions: Floats = field(default_factory=lambda: EVERYWHERE)


@dataclass(frozen=True)
class Problem:
    """Terms that share their `matches`, and the pose `T_start` (4, 4) to begin with.

    inlier_distance : m, beyond which correspondences are rejected
    inlier_ratio : from the second step on those are rejected, too, that lie farther than so many of the last step's
    """

    terms: Sequence[Term]
    T_start: Floats
    annealing: Annealing
    limits: Limits
    matches: Correspondences
    inlier_distance: float = np.inf
    inlier_ratio: float = 1.0


def optimise(problem: Problem) -> RegistrationResult:
    """Step from the start until, at the kernel's end width, a step is below `STEP_M` and `STEP_RAD`.

    Every step linearises all terms anew, in their order: on several maps the finest first.
    """
    T_start, annealing, limits, matches = problem.T_start, problem.annealing, problem.limits, problem.matches
    pose = np.ascontiguousarray(T_start[:3, :3], np.float64).copy(), np.array(T_start[:3, 3], np.float64)
    # One buffer, so that one call clears it.
    buffer = np.zeros(78 + at.COUNT)
    H, S, g, facts = buffer[:36].reshape(6, 6), buffer[36:72].reshape(6, 6), buffer[72:78], buffer[78:]
    sums, d, weak, count = (H, S, g, facts), np.zeros(6), np.zeros((6, 6)), 0
    bounds = (float(limits.weak_share), float(limits.least), float(limits.unseen))
    advance = step_on_surfaces if limits.by_surfaces else step
    scale, end = float(annealing.start), float(annealing.end)
    farthest2 = gate2 = float(problem.inlier_distance) ** 2
    iterations, converged = 0, False
    while iterations < annealing.steps and not converged:
        iterations += 1
        buffer.fill(0.0)
        matches.clear()
        width = (scale, end, gate2)
        for term in problem.terms:
            term.linearise(term.points, term.target, term.settings, term.search, pose, width, sums)
        if facts[at.MATCHED] < len(d):
            break
        is_moved, count, move, turn = advance(pose, sums, scale, bounds, limits.directions, d, weak)
        if not is_moved:
            break
        converged = scale <= end and move < STEP_M and turn < STEP_RAD
        scale = max(scale * annealing.decay, end)
        if problem.inlier_ratio < 1.0:
            gate2 = trimming_distance2(matches.distance2, float(problem.inlier_ratio), farthest2)
    weak = weak[:count]
    if len(limits.directions):
        weak = weak[np.linalg.norm(weak @ limits.directions, axis=1) > 0.5]
    return RegistrationResult.of(
        se3.make(*pose),
        H,
        facts,
        T_start,
        step=d,
        weak=weak,
        source_points=len(matches),
        iterations=iterations,
        converged=converged,
    )


def warm_up() -> None:
    """Compile or load the step, which takes longer than any other kernel."""
    sums = np.eye(6), np.zeros((6, 6)), np.zeros(6), np.zeros(at.COUNT)
    limits = Limits(0.1)
    bounds = (float(limits.weak_share), float(limits.least), float(limits.unseen))
    step((np.eye(3), np.zeros(3)), sums, 1.0, bounds, limits.directions, np.zeros(6), np.zeros((6, 6)))


def normal_equations(terms: Sequence[Term], T: Floats, width: float, matches: Correspondences) -> tuple[Floats, Floats]:
    """H (6, 6) and g (6,) of residuals that weigh no points against each other, at the pose T (4, 4); kernel `width`, m."""
    pose = np.ascontiguousarray(T[:3, :3], np.float64), np.array(T[:3, 3], np.float64)
    H, S, g, facts = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6), np.zeros(at.COUNT)
    matches.clear()
    for term in terms:
        term.linearise(
            term.points, term.target, term.settings, term.search, pose, (width, width, np.inf), (H, S, g, facts)
        )
    return np.triu(H) + np.triu(H, 1).T, g
