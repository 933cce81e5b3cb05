"""The parameters of gtsam's optimiser, and the error when it fails."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np
import pytest

from lslam.backend.graph.marginals import marginal_blocks
from lslam.backend.graph.solve import refine, solve, solve_incrementally
from lslam.core.config.backend import GraphConfig
from lslam.core.errors import GraphError


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


def bent(x: float) -> tuple[Any, Any]:
    """A residual atan(x), whose Gauss-Newton steps run away from beyond 1.39 (x atan x = x^2 / (1 + x^2) twice over)."""
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()

    def error(_: Any, values: Any, jacobians: list[Any] | None) -> Any:
        x = values.atVector(0)
        if jacobians is not None:
            jacobians[0] = np.diag(1 / (1 + x**2))
        return np.arctan(x)

    factors.add(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), [0], error))
    values.insert(0, np.array([x]))
    return factors, values


@pytest.mark.parametrize(("x", "needs_solve"), [(0.01, False), (1.3, False), (2.0, True)])
def test_refining_converges_and_falls_back_where_gauss_newton_runs_away(
    x: float, needs_solve: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = list[float]()

    def noted(factors: Any, values: Any, config: GraphConfig) -> Any:
        asked.append(float(values.atVector(0)[0]))
        return solve(factors, values, config)

    monkeypatch.setattr("lslam.backend.graph.solve.solve", noted)
    assert refine(*bent(x), GraphConfig()).atVector(0)[0] == pytest.approx(0.0, abs=1e-2)
    assert asked == ([x] if needs_solve else [])


def test_refining_a_linear_graph_is_one_elimination(monkeypatch: pytest.MonkeyPatch) -> None:
    factors, values, stops = gtsam.NonlinearFactorGraph(), gtsam.Values(), list[int]()
    for x in (1.0, 4.0):
        factors.add(gtsam.PriorFactorPoint3(0, np.full(3, x), gtsam.noiseModel.Isotropic.Sigma(3, 0.1)))
    values.insert(0, np.zeros(3))
    monkeypatch.setattr("lslam.backend.graph.solve.check_stop", lambda: stops.append(1))
    np.testing.assert_allclose(refine(factors, values, GraphConfig()).atPoint3(0), 2.5, atol=1e-12)
    assert len(stops) == 1


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
