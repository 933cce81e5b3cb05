"""Verification of loop candidates: a search for initial guesses, registration both ways from each, tests of the result."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from lslam.backend.loops.level_submap import (
    CELL_M,
    BestShifts,
    BevGrid,
    LevelSubmap,
    VisibleCells,
    blur,
    correlate,
    peaks,
    spectra,
)
from lslam.core.arrays import Floats
from lslam.core.config.backend import LoopsConfig
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.geometry import se2, se3, so3
from lslam.core.types.constraint import LoopStage
from lslam.registration.acceptance import Acceptance
from lslam.registration.alignment import solve
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.optimiser import COARSE_DECAY, KERNEL_MIN_M, Annealing
from lslam.registration.preprocessing.prepare import PreparedPoints, thin
from lslam.registration.result import RegistrationResult

# Cells, at least and at most; the least image serves where the search is short.
SMALL, LARGE = BevGrid(128), BevGrid(256)
# m, radius of the compared window, at most and at least; the rest of the image is room for the shift.
WIDEST, NARROWEST = 60.0, 40.0
# Least share of the window's non-ground cells that lie where the other submap was observed.
SHARED_SHARE = 0.25
# m between two guesses, the least score relative to the best, and how many there are at most.
STARTS_APART_M, NEARLY, STARTS = 4.0, 0.7, 5
# A registration of two places is never more certain than this, m and deg: both maps have errors that all their points share.
LEAST_SIGMA_M, LEAST_SIGMA_DEG = 0.01, 0.02
LEAST_COVARIANCE: Floats = np.diag(np.repeat([LEAST_SIGMA_M**2, np.deg2rad(LEAST_SIGMA_DEG) ** 2], 3))


@dataclass(frozen=True)
class InitialGuess:
    """Initial guess T_a_b (4, 4), level axes, and its normalised correlation, 0 to 1."""

    T_a_b: Floats
    score: float


def find_initial_guesses(
    a: LevelSubmap, b: LevelSubmap, expected: Floats, reach: float, yaws: Iterable[float]
) -> list[InitialGuess]:
    """Maxima of the correlation of b in a within `reach` m of `expected` (3,), for yaws (rad) of b in a, best first.

    All shifts of one heading are correlated by FFT. Empty without non-ground points.
    """
    far = float(np.linalg.norm(expected[:2])) + reach
    grid = _grid(far)
    window = min(grid.size * CELL_M / 2 - far, WIDEST)
    there = grid.view(a.non_ground, a.ground)
    image = blur(there[0])
    seen = spectra(np.stack([image, there[2], image**2]))
    near, floor = (p[(p[:, :2] ** 2).sum(axis=1) < max(window, NARROWEST) ** 2] for p in (b.non_ground, b.ground))
    best = BestShifts(grid.within(expected[:2], reach))
    shifts = grid.shifts(best.cells)
    for yaw in yaws:
        view = grid.view(near, floor, se2.rotation(yaw))
        best.observe(correlate(seen, spectra(view)), SHARED_SHARE * max(float(view[1].sum()), 1.0), yaw)
    return [
        InitialGuess(_pose(grid, a, b, shifts[k], float(best.heading[k]), float(expected[2])), float(best.score[k]))
        for k in peaks(shifts, best.score, STARTS_APART_M, STARTS, NEARLY)
    ]


def _grid(far: float) -> BevGrid:
    """Cells that have room for the window at shifts of up to `far` m: the transforms are the work of the search."""
    from scipy import fft

    if far + NARROWEST <= SMALL.size * CELL_M / 2:
        return SMALL
    # Cells round the window are observed, too.
    half = int(np.ceil((far + WIDEST) / CELL_M)) + 2
    return min(BevGrid(2 * int(fft.next_fast_len(half, real=True))), LARGE, key=lambda grid: grid.size)


def _pose(grid: BevGrid, a: LevelSubmap, b: LevelSubmap, shift: Floats, yaw: float, expected_z: float) -> Floats:
    """Initial guess T_a_b (4, 4) by `shift` (2,), m, and `yaw`, rad; z by the median height difference of common ground.

    expected_z : m, z without ground in common
    """
    R = so3.exp(np.array([0.0, 0.0, yaw]))
    low_a, low_b = grid.lowest(a.ground), grid.lowest(b.ground @ R.T + np.array([*shift, 0.0]))
    both = np.isfinite(low_a) & np.isfinite(low_b)
    climb = float(np.median(low_a[both] - low_b[both])) if both.any() else expected_z
    return se3.make(R, np.array([*shift, climb]))


# Every so many-th source point serves to rank the initial guesses.
FEW = 4
# m; kernel widths: at an initial guess, and for rmse and overlap.
CATCH, JUDGED = 2.5, 1.0
# m and rad from which on a place is another.
ELSEWHERE_M, ELSEWHERE_RAD = 1.0, np.deg2rad(5.0)


@dataclass(frozen=True)
class Trial:
    """A registration from one initial guess: inlier share of the upright points, 0 to 1, and pose T_a_b (4, 4)."""

    support: float
    T_a_b: Floats


class SubmapRegistration:
    """Registers submaps b in a submap or whole map a by the sections `loops` and `registration` of the configuration."""

    def __init__(self, a: LevelSubmap, config: LoopsConfig, registration: RegistrationConfig) -> None:
        self.a, self.config, self.registration = a, config, registration

    def try_guesses(self, b: LevelSubmap, guesses: Iterable[Floats], cells: VisibleCells) -> tuple[Trial, Trial | None]:
        """The trial of largest support, and of those elsewhere the one of largest support; at least one guess (4, 4)."""
        best, *others = sorted((self._try(b, guess, cells) for guess in guesses), key=lambda trial: -trial.support)
        return best, next((other for other in others if is_elsewhere(best.T_a_b, other.T_a_b)), None)

    def support(self, b: LevelSubmap, T_a_b: Floats, cells: VisibleCells) -> float:
        """Inlier share among the upright points in the cells: unlike their number, it does not depend on the shift."""
        comparable = cells.count(se3.apply(T_a_b, b.upright.source))
        inliers = self._solve(b.upright, T_a_b, Annealing.once(2 * KERNEL_MIN_M)).inliers
        return inliers / comparable if comparable else 0.0

    def refine(self, b: LevelSubmap, start: Floats) -> RegistrationResult:
        """All source points of b registered from the pose of a trial."""
        return self._solve(b.source, start, Annealing(self.registration.kernel_max, self.config.max_iterations))

    def match(self, b: LevelSubmap, T_a_b: Floats) -> RegistrationResult:
        """Inliers and rmse of b at the pose T_a_b (4, 4), within `JUDGED` m."""
        return self._solve(b.source, T_a_b, Annealing.once(JUDGED))

    def _try(self, b: LevelSubmap, guess: Floats, cells: VisibleCells) -> Trial:
        """Register a few points of b from an initial guess T_a_b (4, 4), coarse to fine, and score the result."""
        r, few = self.registration, thin(b.source, FEW)
        slow = Annealing(CATCH, self.config.max_iterations, r.kernel_max / 2, COARSE_DECAY)
        coarse = self._solve(few, guess, slow, self.a.coarse)
        T = self._solve(few, coarse.T_world_lidar, Annealing(r.kernel_max, 15, decay=0.7)).T_world_lidar
        return Trial(self.support(b, T, cells), T)

    def _solve(
        self, points: PreparedPoints, start: Floats, annealing: Annealing, target: GaussianMap | None = None
    ) -> RegistrationResult:
        """Points registered in the fine map of a, or in another `target`."""
        return solve((self.a.fine if target is None else target,), points, start, annealing, self.registration)


def is_elsewhere(T: Floats, other: Floats) -> bool:
    """Whether two poses (4, 4) are of different places."""
    move, turn = se3.magnitude(se3.relative(T, other))
    return move > ELSEWHERE_M or turn > float(ELSEWHERE_RAD)


@dataclass(frozen=True)
class Verification:
    """The result of verifying one loop candidate.

    stage : that decided; reason : why it was rejected, empty when accepted
    T_a_b : (4, 4) in level axes; covariance : (6, 6), level axes of a; None when nothing was registered
    """

    stage: LoopStage
    reason: str = ""
    T_a_b: Floats | None = None
    covariance: Floats | None = None
    rmse: float = float("nan")
    overlap: float = float("nan")

    def reject(self, stage: LoopStage, reason: str) -> Verification:
        """The verification as a rejection, with its stage and reason."""
        return replace(self, stage=stage, reason=reason)


class Verifier:
    """Verifies loop candidates by the sections `loops` and `registration` of the configuration."""

    def __init__(self, config: LoopsConfig, registration: RegistrationConfig) -> None:
        self.config, self.registration = config, registration

    def verify(
        self, a: LevelSubmap, b: LevelSubmap, expected: Floats, reach: float, yaws: Iterable[float]
    ) -> Verification:
        """Register b in a: T_a_b in level axes, within `reach` m of `expected` (3,), at one of `yaws` (rad) or near it."""
        starts = find_initial_guesses(a, b, expected, reach, yaws)
        if not starts:
            return Verification(LoopStage.OVERLAP, "nothing stands up there")
        cells = VisibleCells(LARGE, LARGE.view(a.non_ground, a.ground)[2].ravel() > 0, SHARED_SHARE)
        in_a, in_b = (SubmapRegistration(submap, self.config, self.registration) for submap in (a, b))
        best, rival = in_a.try_guesses(b, [start.T_a_b for start in starts], cells)
        forward = in_a.refine(b, best.T_a_b)
        facts = self._judge(in_a, in_b, forward)
        if facts.reason:
            return facts
        if rival is not None and rival.support > self.config.max_ambiguity * best.support:
            away = float(np.linalg.norm(rival.T_a_b[:3, 3] - best.T_a_b[:3, 3]))
            reason = f"{away:.1f} m away it fits {rival.support / best.support:.0%} as well"
            return facts.reject(LoopStage.AMBIGUITY, reason)
        return self._agree(facts, forward, in_b.refine(a, se3.inverse(best.T_a_b)))

    def _judge(self, in_a: SubmapRegistration, in_b: SubmapRegistration, result: RegistrationResult) -> Verification:
        """Checks of one registration: degeneracy, rmse, overlap in both directions."""
        c = self.config
        if not result.ok or result.covariance is None:
            return Verification(LoopStage.REGISTRATION, result.reason or "nothing matches")
        T = result.T_world_lidar
        there, back = in_a.match(in_b.a, T), in_b.match(in_a.a, se3.inverse(T))
        worse = min(there, back, key=lambda one: one.overlap)
        both = replace(
            result, rmse=max(there.rmse, back.rmse), matched=worse.matched, source_points=worse.source_points
        )
        limits = Acceptance(c.min_overlap, max_rmse=c.max_rmse, needs_all_directions=True, target="other submap")
        rejection = limits.rejection(both)
        facts = Verification(LoopStage.REGISTRATION, "", T, result.covariance, both.rmse, both.overlap)
        if rejection is None:
            return facts
        stage = LoopStage.OVERLAP if rejection.test == "overlap" else LoopStage.REGISTRATION
        return facts.reject(stage, rejection.reason)

    def _agree(self, facts: Verification, forward: RegistrationResult, backward: RegistrationResult) -> Verification:
        """Check that forward and backward registration agree; their difference is added to the covariance of the loop closure."""
        c = self.config
        if not backward.ok:
            return facts.reject(LoopStage.AGREEMENT, f"new to old: {backward.reason or 'nothing matches'}")
        gap = se3.log(forward.T_world_lidar @ backward.T_world_lidar)
        move, turn = float(np.linalg.norm(gap[:3])), float(np.linalg.norm(gap[3:]))
        if move > c.max_disagreement_m or np.rad2deg(turn) > c.max_disagreement_deg:
            reason = f"old to new and new to old differ by {move:.2f} m and {np.rad2deg(turn):.2f} deg"
            return facts.reject(LoopStage.AGREEMENT, reason)
        assert forward.covariance is not None
        disagreement = np.diag([move**2 / 3] * 3 + [turn**2 / 3] * 3)
        covariance = forward.covariance + LEAST_COVARIANCE + disagreement
        # The mean of both.
        T = se3.exp(-0.5 * gap) @ forward.T_world_lidar
        return Verification(LoopStage.AGREEMENT, "", se3.normalise(T), covariance, facts.rmse, facts.overlap)
