"""Acceptance of a registration: one list of tests, of which each user sets the limits."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.types.scan_result import OPEN_M, OPEN_RAD
from lslam.registration.history import UsualAgreement
from lslam.registration.result import RegistrationResult

Test = Literal["solution", "directions", "rmse", "overlap", "inliers", "agreement", "jump"]

# Of a pose from the motion prior alone.
PRIOR_COVARIANCE = np.diag(np.repeat([OPEN_M, OPEN_RAD], 3) ** 2)


@dataclass(frozen=True)
class Rejection:
    """The first test that a registration failed, and the reason in words."""

    test: Test
    reason: str


@dataclass(frozen=True)
class Acceptance:
    """Limits of a registration. A test whose limit is left at its default passes everything.

    min_overlap : share of the source points with a match; min_inliers : share of these within the kernel
    max_rmse : m; max_jump_m, max_jump_deg : correction of the motion prior
    needs_covariance, needs_all_directions : whether something must be matched, and hold every direction
    usual : inlier shares of the scans before, of which a collapse is rejected; is_usual_of_matches : shares of the matches,
        as where a map ends, not of the source points
    source, target : words for what is registered, and for the target
    """

    min_overlap: float = 0.0
    min_inliers: float = 0.0
    max_rmse: float = math.inf
    max_jump_m: float = math.inf
    max_jump_deg: float = math.inf
    needs_covariance: bool = False
    needs_all_directions: bool = False
    usual: UsualAgreement | None = None
    is_usual_of_matches: bool = False
    source: str = "points"
    target: str = "map"

    def rejection(self, result: RegistrationResult, jump: tuple[float, float] = (0.0, 0.0)) -> Rejection | None:
        """The first test that the result fails; None when it passes them all. `jump` : m and rad, from the prior."""
        move, turn_deg = jump[0], math.degrees(jump[1])
        if result.reason or not result.ok or (self.needs_covariance and result.covariance is None):
            return Rejection("solution", result.reason or "nothing matches")
        if self.needs_all_directions and len(result.degenerate):
            return Rejection("directions", "the surfaces do not hold it in every direction")
        if result.rmse > self.max_rmse:
            return Rejection("rmse", f"rmse {result.rmse:.2f} m, {self.max_rmse:g} m allowed")
        if result.overlap < self.min_overlap:
            return Rejection("overlap", f"only {result.overlap:.0%} of the {self.source} overlap the {self.target}")
        if result.inlier_share < self.min_inliers:
            return Rejection("inliers", f"only {result.inlier_share:.0%} of the matches agree")
        share = result.inlier_share if self.is_usual_of_matches else result.agreement
        if self.usual is not None and self.usual.is_collapse(share):
            message = (
                f"only {share:.0%} of the {self.source} agree with the {self.target}, lately {self.usual.usual:.0%} did"
            )
            return Rejection("agreement", message)
        if move > self.max_jump_m or turn_deg > self.max_jump_deg:
            return Rejection("jump", f"impossible jump of {move:.1f} m and {turn_deg:.0f} deg")
        return None

    def judge(self, result: RegistrationResult, T_prior: Floats) -> RegistrationResult:
        """The result with its correction of the prior (4, 4), or a failed one at the prior with the reason."""
        jump = correction(T_prior, result.T_world_lidar)
        rejection = self.rejection(result, jump)
        if rejection is None:
            return replace(result, prior_error=jump)
        return replace(failure(T_prior, result.source_points, rejection.reason), iterations=result.iterations)


def failure(T_prior: Floats, source_points: int, reason: str) -> RegistrationResult:
    """A failed registration at the motion prior, with the prior's large covariance and the `reason`."""
    return RegistrationResult(
        T_prior.copy(),
        ok=False,
        reason=reason,
        covariance=PRIOR_COVARIANCE.copy(),
        converged=False,
        source_points=source_points,
    )


def correction(T_prior: Floats, pose: Floats) -> tuple[float, float]:
    """Distance, m, and angle, rad, between two poses (4, 4): the prior and the registered one."""
    move, R = pose[:3, 3] - T_prior[:3, 3], (T_prior[:3, :3].T @ pose[:3, :3]).tolist()
    sine = math.hypot(R[2][1] - R[1][2], R[0][2] - R[2][0], R[1][0] - R[0][1])
    return math.sqrt(float(move @ move)), math.atan2(sine, R[0][0] + R[1][1] + R[2][2] - 1.0)
