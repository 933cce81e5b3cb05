"""Acceptance of a registration: the gates that points and features share."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lslam.config.registration import RegistrationConfig
from lslam.registration.robust import UsualAgreement
from lslam.registration.solver import RegistrationResult

Floats = NDArray[np.float64]

# Of a pose from the motion prior alone: sigmas of half a metre and two degrees.
PRIOR_COVARIANCE = np.diag([0.25] * 3 + [np.deg2rad(2.0) ** 2] * 3)


@dataclass(frozen=True)
class Wording:
    """How a rejection goes on after "only 12 %": of too little overlap with the target, and of too few inliers."""

    overlap: str
    agreement: str


def accepted(
    result: RegistrationResult, T_prior: Floats, config: RegistrationConfig, usual: UsualAgreement, min_overlap: float,
    wording: Wording,
) -> RegistrationResult:  # fmt: skip
    """The result with its correction of the prior, or a failed one at the prior with the reason.

    usual : recent inlier shares; min_overlap : least share of matched source points
    """
    move, turn = correction(T_prior, result.T_world_lidar)
    reason = result.reason
    if not reason and result.overlap < min_overlap:
        reason = f"only {result.overlap:.0%} {wording.overlap}"
    elif not reason and result.inlier_share < config.min_inliers:
        reason = f"only {result.inlier_share:.0%} of the matches agree"
    elif not reason and usual.is_collapse(result.agreement):
        reason = f"only {result.agreement:.0%} {wording.agreement}, lately {usual.usual:.0%} did"
    elif not reason and (move > config.max_jump_m or turn > np.deg2rad(config.max_jump_deg)):
        reason = f"impossible jump of {move:.1f} m and {np.rad2deg(turn):.0f} deg"
    if reason:
        return replace(failed(T_prior, result.source_points, reason), iterations=result.iterations)
    return replace(result, prior_error=(move, turn))


def failed(T_prior: Floats, source_points: int, reason: str) -> RegistrationResult:
    """The motion prior with its covariance."""
    return RegistrationResult(
        T_prior.copy(),
        ok=False,
        reason=reason,
        covariance=PRIOR_COVARIANCE.copy(),
        converged=False,
        source_points=source_points,
    )


def correction(T_prior: Floats, pose: Floats) -> tuple[float, float]:
    """How far (m, rad) the pose is from what was expected."""
    move, R = pose[:3, 3] - T_prior[:3, 3], (T_prior[:3, :3].T @ pose[:3, :3]).tolist()
    sine = math.hypot(R[2][1] - R[1][2], R[0][2] - R[2][0], R[1][0] - R[0][1])
    return math.sqrt(float(move @ move)), math.atan2(sine, R[0][0] + R[1][1] + R[2][2] - 1.0)
