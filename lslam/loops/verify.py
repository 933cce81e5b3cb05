"""Verification of loop candidates: registration both ways, from every initial guess, with tests of the result."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lslam.config.backend import LoopsConfig
from lslam.config.odometry import RegistrationConfig
from lslam.geometry import se3, so3
from lslam.loops.level_submap import LevelSubmap
from lslam.loops.search import LARGE, SHARED, find_initial_guesses
from lslam.preprocessing.prepare import PreparedPoints, thin
from lslam.registration.acceptance import Acceptance
from lslam.registration.robust import Annealing
from lslam.registration.solver import RegistrationResult, solve
from lslam.types.constraint import LoopStage

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

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
        seen = LARGE.cover(a.non_ground, a.ground).ravel() > 0
        tried = sorted((self._try(a, b, seen, start.T_a_b) for start in starts), key=lambda found: -found[0])
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

    def _try(self, a: LevelSubmap, b: LevelSubmap, seen: Flags, start: Floats) -> tuple[float, Floats]:
        """Inlier share of the upright points after registration from `start`, 0 to 1, and the pose found."""
        r = self.registration
        few = thin(b.source, FEW)
        slow = Annealing(CATCH, r.kernel_max / 2, r.coarse_decay, self.config.max_iterations)
        coarse = self._solve(a, few, start, slow, coarse_only=True)
        fine = self._solve(a, few, coarse.T_world_lidar, Annealing(r.kernel_max, r.kernel_min, 0.7, 15))
        return self._support(a, b.upright, seen, fine.T_world_lidar), fine.T_world_lidar

    def _refine(self, a: LevelSubmap, b: LevelSubmap, start: Floats) -> RegistrationResult:
        r = self.registration
        annealing = Annealing(r.kernel_max, r.kernel_min, r.kernel_decay, self.config.max_iterations)
        return self._solve(a, b.source, start, annealing)

    def _solve(
        self, a: LevelSubmap, points: PreparedPoints, start: Floats, annealing: Annealing, *, coarse_only: bool = False
    ) -> RegistrationResult:
        return solve((a.coarse if coarse_only else a.fine,), points, start, annealing, self.registration)

    def _support(self, a: LevelSubmap, upright: PreparedPoints, seen: Flags, T_a_b: Floats) -> float:
        """Inlier share among the points in cells that a observed: unlike their number, it does not depend on the shift."""
        cells, inside = LARGE.cells_of(se3.apply(T_a_b, upright.source))
        comparable = int((inside & seen[cells]).sum())
        width = 2 * self.registration.kernel_min
        inliers = self._solve(a, upright, T_a_b, Annealing(width, width, 0.5, 1)).inliers
        return 0.0 if comparable < SHARED * len(upright.source) else inliers / comparable

    def _judge(self, a: LevelSubmap, b: LevelSubmap, found: RegistrationResult) -> Verification:
        """Tests of a registration by itself: degeneracy, rmse, overlap both ways."""
        c = self.config
        if not found.ok or found.covariance is None:
            return Verification(LoopStage.REGISTRATION, found.reason or "nothing matches")
        T = found.T_world_lidar
        there = self._solve(a, b.source, T, Annealing(JUDGED, JUDGED, 0.5, 1))
        back = self._solve(b, a.source, se3.inverse(T), Annealing(JUDGED, JUDGED, 0.5, 1))
        worse = min(there, back, key=lambda one: one.overlap)
        both = replace(found, rmse=max(there.rmse, back.rmse), matched=worse.matched, source_points=worse.source_points)
        limits = Acceptance(c.min_overlap, max_rmse=c.max_rmse, needs_all_directions=True, target="other submap")
        rejection = limits.rejection(both)
        facts = Verification(LoopStage.REGISTRATION, "", T, found.covariance, both.rmse, both.overlap)
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
            said = f"old to new and new to old differ by {move:.2f} m and {np.rad2deg(turn):.2f} deg"
            return facts.rejected(LoopStage.AGREEMENT, said)
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
