"""Where a drive of features begins: on a young map all points decide, later the larger consensus of features."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lslam.core.config.config import Config
from lslam.core.config.odometry import RecoveryConfig, RegistrationConfig
from lslam.odometry.feature_target import FeatureTarget
from lslam.odometry.loam import VARIANTS
from lslam.registration.attempt import Attempt
from lslam.registration.history import History
from lslam.registration.policies import CoarseToFine
from lslam.registration.result import RegistrationResult

FINE, COARSE = (RegistrationResult(np.eye(4), matched=2000, pose_source=name) for name in ("fine", "coarse"))


def chosen(
    fine: int,
    coarse: int,
    *,
    starting: int = 5,
    inserted: int = 1,
    prior_m: float = 0.0,
    failed: str = "",
    start_search: bool = True,
) -> str:
    """Which of two results with so many inliers a policy takes."""
    config = RegistrationConfig()
    history = History(config)
    history.starting, history.inserted = starting, inserted
    other = replace(COARSE, inliers=coarse, ok=failed != "coarse")
    features = FeatureTarget(Config(recovery=RecoveryConfig(start_search=start_search)), VARIANTS["loam"])
    target: Any = SimpleNamespace(capture=lambda attempt: other, begins_by_points=features.begins_by_points)
    attempt = Attempt(target, None, np.eye(4), config, history)
    result = replace(FINE, inliers=fine, ok=failed != "fine", prior_error=(prior_m, 0.0))
    return CoarseToFine(of_features=True).recover(attempt, result).pose_source


@pytest.mark.parametrize(("fine", "coarse"), [(1272, 684), (151, 134), (684, 1272), (500, 500)])
def test_on_a_young_map_features_do_not_outvote_all_points(fine: int, coarse: int) -> None:
    """At 30 m/s the road moves with the sensor: 121 of its features agree there, 90 where it is."""
    assert chosen(fine, coarse) == "coarse"


@pytest.mark.parametrize(("fine", "coarse", "wanted"), [(1272, 684, "fine"), (684, 1272, "coarse")])
def test_after_a_failure_the_larger_consensus_counts(fine: int, coarse: int, wanted: str) -> None:
    assert chosen(fine, coarse, starting=1, inserted=50) == wanted
    assert chosen(fine, coarse, start_search=False) == wanted, "points did not begin it"


@pytest.mark.parametrize(("fine", "coarse", "wanted"), [(151, 134, "fine"), (134, 151, "coarse")])
def test_later_the_larger_consensus_counts(fine: int, coarse: int, wanted: str) -> None:
    assert chosen(fine, coarse, starting=0, prior_m=5.0) == wanted
    assert chosen(fine, coarse, starting=0) == "fine", "a small correction of the prior is not looked at"


@pytest.mark.parametrize("starting", [0, 5])
def test_what_failed_is_not_chosen(starting: int) -> None:
    assert chosen(10, 900, starting=starting, prior_m=5.0, failed="coarse") == "fine"
    assert chosen(900, 10, starting=starting, prior_m=5.0, failed="fine") == "coarse"
