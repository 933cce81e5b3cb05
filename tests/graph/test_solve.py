"""The parameters of gtsam's optimiser, and the error when it fails."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np
import pytest

from lslam.config.graph import GraphConfig
from lslam.errors import GraphError
from lslam.graph.solve import marginal_blocks, solve, solve_incrementally


@pytest.mark.parametrize(("optimizer", "asked"), [("dogleg", "DoglegOptimizer"), ("lm", "LevenbergMarquardtOptimizer")])
def test_the_optimiser_of_the_configuration_solves(optimizer: str, asked: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """From 3 m off, where either arrives: the other one is not there."""
    factors, values, target = gtsam.NonlinearFactorGraph(), gtsam.Values(), np.array([1.0, 2.0, -2.0])
    factors.add(gtsam.PriorFactorPoint3(0, target, gtsam.noiseModel.Isotropic.Sigma(3, 0.1)))
    values.insert(0, np.zeros(3))
    for name in {"DoglegOptimizer", "LevenbergMarquardtOptimizer"} - {asked}:
        monkeypatch.delattr(gtsam, name)
    found = solve(factors, values, GraphConfig.model_validate({"optimizer": optimizer}))
    np.testing.assert_allclose(found.atPoint3(0), target, atol=1e-6)


@pytest.mark.parametrize(
    ("ask", "says"),
    [
        (lambda factors, values: marginal_blocks(factors, values, [0, 1]), "has no covariances: .*singular"),
        (
            lambda factors, values: solve_incrementally(factors, values, 2),
            "cannot be optimised: Indeterminate .*system",
        ),
    ],
)
def test_poses_that_hang_on_nothing_are_refused_in_one_line(ask: Callable[[Any, Any], Any], says: str) -> None:
    """One is known from the other alone. Whatever gtsam writes below its first line is for programmers."""
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    factors.add(gtsam.BetweenFactorPose3(0, 1, gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1.0)))
    for key in range(2):
        values.insert(key, gtsam.Pose3())
    with pytest.raises(GraphError, match=f"^the pose graph {says}") as refused:
        ask(factors, values)
    assert "\n" not in str(refused.value)
