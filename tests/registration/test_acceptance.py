"""The gates of a registration, one by one: a rejected result keeps the prior with a reason."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from lslam.core.arrays import Floats
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.geometry import se3, so3
from lslam.registration.acceptance import PRIOR_COVARIANCE, Acceptance, correction
from lslam.registration.attempt import Attempt
from lslam.registration.history import History
from lslam.registration.result import RegistrationResult

CONFIG = RegistrationConfig(min_overlap=0.6, min_agreement=0.5, max_jump_m=5.0, max_jump_deg=30.0)
PRIOR = se3.make(np.eye(3), np.array([1.0, 2.0, 3.0]))


def judge(
    source: str = "points", metres: float = 0.1, degrees: float = 1.0, matched: int = 90, inliers: int = 80,
    reason: str = "",
) -> RegistrationResult:  # fmt: skip
    """Of 100 points, so far from the prior; lately 80 % of all and 60 % of the matches agreed, and 60 % have to find one."""
    step = se3.make(so3.exp(np.array([0, 0, np.deg2rad(degrees)])), np.array([metres, 0, 0]))
    result = RegistrationResult(
        PRIOR @ step, reason=reason, iterations=7, source_points=100, matched=matched, inliers=inliers
    )
    history = History(CONFIG)
    history.agreement.observe(0.8)
    history.matches.observe(0.6)
    return attempt(CONFIG, history, source).judge(result)


def attempt(config: RegistrationConfig, history: History, source: str = "points") -> Attempt:
    return Attempt(SimpleNamespace(source=source), None, PRIOR, config, history)


def test_the_share_of_matches_that_agree_is_judged_by_the_share_of_earlier_scans() -> None:
    """16 % is right in a small room, where the first scan has no more on its own planes, and wrong in a street."""
    result = RegistrationResult(PRIOR, source_points=100, matched=100, inliers=16)
    for usual, is_accepted in ((0.2, True), (0.7, False)):
        history = History(RegistrationConfig())
        history.matches.observe(usual)
        assert attempt(RegistrationConfig(), history).judge(result).ok == is_accepted


def test_what_the_prior_does_not_confirm_must_agree_as_usual() -> None:
    """After a second of missing scans a place that looks alike, 10 m on, has 60 % of the usual inliers."""
    history = History(RegistrationConfig())
    history.starting = 0
    history.matches.observe(0.8)

    def is_accepted(metres: float, inliers: int, information: Floats | None = None) -> bool:
        result = RegistrationResult(PRIOR @ moved(metres), source_points=100, matched=100, inliers=inliers)
        return replace(attempt(RegistrationConfig(), history), information=information).judge(result).ok

    assert is_accepted(0.1, 48)
    assert not is_accepted(1.0, 48)
    assert is_accepted(1.0, 70)
    # An IMU that may err by as much confirms it, one that is sure does not.
    assert is_accepted(1.0, 48, np.diag([4.0] * 6))
    assert not is_accepted(1.0, 48, np.diag([400.0] * 6))
    # While the speed is unknown every correction is large.
    history.starting = 1
    assert is_accepted(1.0, 48)


def moved(metres: float) -> Floats:
    return se3.make(np.eye(3), np.array([metres, 0.0, 0.0]))


def test_an_accepted_result_has_its_correction_of_the_prior() -> None:
    result = judge()
    assert (result.ok, result.reason, result.inliers) == (True, "", 80)
    np.testing.assert_allclose(result.prior_error, (0.1, np.deg2rad(1.0)))


@pytest.mark.parametrize(
    ("facts", "reason"),
    [
        ({"matched": 50, "inliers": 50}, "only 50% of the {} overlap the map"),
        ({"inliers": 20}, "only 22% of the matches agree"),
        ({"inliers": 35}, "only 35% of the {} agree with the map, lately 80% did"),
        ({"metres": 5.1}, "impossible jump of 5.1 m and 1 deg"),
        ({"degrees": 31.0}, "impossible jump of 0.1 m and 31 deg"),
        ({"reason": "singular", "inliers": 0}, "singular"),
    ],
)
def test_a_rejected_result_keeps_the_prior_with_a_reason(facts: dict[str, float], reason: str) -> None:
    for source in ("points", "features"):
        result = judge(source, **facts)  # type: ignore[arg-type]
        why = (result.ok, result.reason, result.iterations, result.source_points)
        assert why == (False, reason.format(source), 7, 100)
        np.testing.assert_array_equal(result.T_world_lidar, PRIOR)
        np.testing.assert_array_equal(result.covariance, PRIOR_COVARIANCE)


@pytest.mark.parametrize(
    ("limits", "test"),
    [
        ({"max_rmse": 0.1}, "rmse"),
        ({"needs_all_directions": True}, "directions"),
        ({"needs_covariance": True}, "solution"),
        ({"min_overlap": 0.95}, "overlap"),
        ({"min_inliers": 0.95}, "inliers"),
        ({}, None),
    ],
)
def test_each_limit_is_a_test_of_its_own(limits: dict[str, float], test: str | None) -> None:
    result = RegistrationResult(PRIOR, source_points=100, matched=90, inliers=80, rmse=0.2, degenerate=np.eye(6)[:1])
    rejection = Acceptance(**limits).rejection(result)  # type: ignore[arg-type]
    assert (rejection and rejection.test) == test


def test_a_correction_is_measured_from_the_prior() -> None:
    step = se3.make(so3.exp(np.array([0.0, 0.3, 0.4])), np.array([3.0, 0.0, 4.0]))
    np.testing.assert_allclose(correction(PRIOR, PRIOR @ step), (5.0, 0.5))
