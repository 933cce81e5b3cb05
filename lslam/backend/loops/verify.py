"""Verification of loop candidates: a search for initial guesses, registration both ways from each, tests of the result."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from lslam.backend.loops.bev_correlation import CELL_M, BestShifts, BevGrid, blurred, correlate, peaks, spectra, turning
from lslam.backend.loops.level_submap import LevelSubmap
from lslam.core.config.backend import LoopsConfig
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.geometry import se3, so3
from lslam.core.types.arrays import Bools, Floats
from lslam.core.types.constraint import LoopStage
from lslam.registration.acceptance import Acceptance
from lslam.registration.alignment import solve
from lslam.registration.optimiser import COARSE_DECAY, KERNEL_DECAY, KERNEL_MIN_M, Annealing
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
    image = blurred(there[0])
    seen = spectra(np.stack([image, there[2], image**2]))
    near, floor = (p[(p[:, :2] ** 2).sum(axis=1) < max(window, NARROWEST) ** 2] for p in (b.non_ground, b.ground))
    best = BestShifts(grid.within(expected[:2], reach))
    shifts = grid.shifts(best.cells)
    for yaw in yaws:
        view = grid.view(near, floor, turning(yaw))
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
    """(4, 4) with the median height difference of the ground in common; `expected_z` without any."""
    R = so3.exp(np.array([0.0, 0.0, yaw]))
    low_a, low_b = grid.lowest(a.ground), grid.lowest(b.ground @ R.T + np.array([*shift, 0.0]))
    both = np.isfinite(low_a) & np.isfinite(low_b)
    climb = float(np.median(low_a[both] - low_b[both])) if both.any() else expected_z
    return se3.make(R, np.array([*shift, climb]))


# Every so many-th source point serves to rank the initial guesses.
FEW = 4
# m; kernel widths: at an initial guess, and for rmse and overlap.
CATCH, JUDGED = 2.5, 1.0


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

    def rejected(self, stage: LoopStage, reason: str) -> Verification:
        """The same, rejected."""
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
        view = LARGE.view(a.non_ground, a.ground)[2].ravel() > 0
        tried = sorted((self._try(a, b, view, start.T_a_b) for start in starts), key=lambda found: -found[0])
        support, rough = tried[0]
        others = [(s, T) for s, T in tried[1:] if _is_elsewhere(rough, T)]
        forward = self._refine(a, b, rough)
        facts = self._judge(a, b, forward)
        if facts.reason:
            return facts
        if others and others[0][0] > self.config.max_ambiguity * support:
            away = float(np.linalg.norm(others[0][1][:3, 3] - rough[:3, 3]))
            return facts.rejected(
                LoopStage.AMBIGUITY, f"{away:.1f} m away it fits {others[0][0] / support:.0%} as well"
            )
        backward = self._refine(b, a, se3.inverse(rough))
        return self._agree(facts, forward, backward)

    def _try(self, a: LevelSubmap, b: LevelSubmap, view: Bools, start: Floats) -> tuple[float, Floats]:
        """Inlier share of the upright points after registration from `start`, 0 to 1, and the pose found."""
        r = self.registration
        few = thin(b.source, FEW)
        slow = Annealing(CATCH, r.kernel_max / 2, COARSE_DECAY, self.config.max_iterations)
        coarse = self._solve(a, few, start, slow, coarse_only=True)
        fine = self._solve(a, few, coarse.T_world_lidar, Annealing(r.kernel_max, KERNEL_MIN_M, 0.7, 15))
        return self._support(a, b.upright, view, fine.T_world_lidar), fine.T_world_lidar

    def _refine(self, a: LevelSubmap, b: LevelSubmap, start: Floats) -> RegistrationResult:
        r = self.registration
        annealing = Annealing(r.kernel_max, KERNEL_MIN_M, KERNEL_DECAY, self.config.max_iterations)
        return self._solve(a, b.source, start, annealing)

    def _solve(
        self, a: LevelSubmap, points: PreparedPoints, start: Floats, annealing: Annealing, *, coarse_only: bool = False
    ) -> RegistrationResult:
        return solve((a.coarse if coarse_only else a.fine,), points, start, annealing, self.registration)

    def _support(self, a: LevelSubmap, upright: PreparedPoints, view: Bools, T_a_b: Floats) -> float:
        """Inlier share among the points in cells that a observed: unlike their number, it does not depend on the shift."""
        cells, inside = LARGE.cells_of(se3.apply(T_a_b, upright.source))
        comparable = int((inside & view[cells]).sum())
        width = 2 * KERNEL_MIN_M
        inliers = self._solve(a, upright, T_a_b, Annealing(width, width, 0.5, 1)).inliers
        return 0.0 if comparable < SHARED_SHARE * len(upright.source) else inliers / comparable

    def _judge(self, a: LevelSubmap, b: LevelSubmap, result: RegistrationResult) -> Verification:
        """Tests of a registration by itself: degeneracy, rmse, overlap both ways."""
        c = self.config
        if not result.ok or result.covariance is None:
            return Verification(LoopStage.REGISTRATION, result.reason or "nothing matches")
        T = result.T_world_lidar
        there = self._solve(a, b.source, T, Annealing(JUDGED, JUDGED, 0.5, 1))
        back = self._solve(b, a.source, se3.inverse(T), Annealing(JUDGED, JUDGED, 0.5, 1))
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
        return facts.rejected(stage, rejection.reason)

    def _agree(self, facts: Verification, forward: RegistrationResult, backward: RegistrationResult) -> Verification:
        """Forward and backward must agree; their difference is added to the covariance of the loop closure."""
        c = self.config
        if not backward.ok:
            return facts.rejected(LoopStage.AGREEMENT, f"new to old: {backward.reason or 'nothing matches'}")
        gap = se3.log(forward.T_world_lidar @ backward.T_world_lidar)
        move, turn = float(np.linalg.norm(gap[:3])), float(np.linalg.norm(gap[3:]))
        if move > c.max_disagreement_m or np.rad2deg(turn) > c.max_disagreement_deg:
            reason = f"old to new and new to old differ by {move:.2f} m and {np.rad2deg(turn):.2f} deg"
            return facts.rejected(LoopStage.AGREEMENT, reason)
        floor = np.diag([c.sigma_m**2] * 3 + [np.deg2rad(c.sigma_deg) ** 2] * 3)
        assert forward.covariance is not None
        disagreement = np.diag([move**2 / 3] * 3 + [turn**2 / 3] * 3)
        covariance = forward.covariance + floor + disagreement
        # The mean of both.
        T = se3.exp(-0.5 * gap) @ forward.T_world_lidar
        return Verification(LoopStage.AGREEMENT, "", se3.normalise(T), covariance, facts.rmse, facts.overlap)


def _is_elsewhere(T: Floats, other: Floats) -> bool:
    delta = se3.relative(T, other)
    return float(np.linalg.norm(delta[:3, 3])) > 1.0 or float(so3.angle(delta[:3, :3])) > np.deg2rad(5)
