"""Which loop closures are accepted: just inside and just outside of each gate."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.stats import chi2

from lslam.backend.graph.drift import drift_factor
from lslam.backend.graph.pose_graph import judge_loops
from lslam.backend.graph.problem import PoseGraph, UpDirection
from lslam.backend.graph.solve import GncResult, OutlierCandidate, gnc_solve
from lslam.core.config.backend import GraphConfig
from lslam.core.geometry import se3
from lslam.core.types.constraint import Constraint

Floats = NDArray[np.float64]
SURE = 1e-10 * np.eye(6)
# Six degrees of freedom at the configured probability; m and rad that a closure may be wrong by beyond its covariance.
LIMIT = float(np.sqrt(chi2.ppf(0.999, 6)))
WAY = 1000.0
SLACK_M, SLACK_RAD = 0.03, np.deg2rad(0.1)


def there_and_back(
    offsets: list[Floats], apart: list[float] | None = None, origin: tuple[float, float] = (0.0, 0.0), **settings: float
) -> list[str]:
    """What is said of loops between two passes, a kilometre of odometry apart, each wrong by a twist (6,).

    apart : m along either pass at which the loops lie, all at one place if not given; origin : m, where the way begins
    """
    at = np.zeros(len(offsets)) if apart is None else np.array(apart)
    count = len(at)
    away = np.linspace(0, 1, 40)[1:-1]
    x = np.concatenate([at, at[-1] + 500 * np.sin(np.pi * away), at])
    travelled = np.concatenate([at, at[-1] + WAY * np.linspace(0, 1, 40)[1:-1], at[-1] + WAY + at])
    poses = np.tile(np.eye(4), (len(x), 1, 1))
    poses[:, 0, 3] = x
    poses[:, :2, 3] += origin
    odometry = [Constraint(k, k + 1, se3.relative(a, b), SURE) for k, (a, b) in enumerate(pairwise(poses))]
    second = len(x) - count
    loops = [
        Constraint(k, second + k, se3.exp(np.asarray(offset, np.float64)), SURE) for k, offset in enumerate(offsets)
    ]
    return judge_loops(PoseGraph(poses, odometry, loops, distances=travelled), GraphConfig(**settings))  # type: ignore[arg-type]


def shift(x: float, z: float = 0.0) -> Floats:
    return np.array([x, 0, z, 0, 0, 0], np.float64)


@pytest.mark.parametrize(("share", "is_out"), [(0.9, False), (1.1, True)])
def test_loops_may_differ_by_their_slack_and_no_more(share: float, is_out: bool) -> None:
    """Their own covariances are nothing: what is left is 3 cm, and a tenth of a degree."""
    for offset in (shift(share * LIMIT * SLACK_M), np.array([0, 0, 0, 0, 0, share * LIMIT * SLACK_RAD])):
        said = there_and_back([np.zeros(6)] * 4 + [offset])
        assert said[:4] == [""] * 4
        assert said[4] == ("only 0% of the loops around it agree with it" if is_out else "")


def test_a_loop_stays_when_half_of_the_others_agree_with_it() -> None:
    """Four here, four 0.2 m on, and loops between that both agree with: 4 of 8 others agree with each, or 3 of 7."""
    here, between, there = shift(0.0), shift(0.1), shift(0.2)
    assert there_and_back([here] * 4 + [between] + [there] * 4) == [""] * 9
    assert there_and_back([here] * 4 + [there] * 4) == ["only 43% of the loops around it agree with it"] * 8
    # The most contradicted go first, and then nobody contradicts the others.
    assert there_and_back([here] * 5 + [there] * 4) == [""] * 5 + ["only 38% of the loops around it agree with it"] * 4


def test_loops_far_away_do_not_vote() -> None:
    """Odometry may have drifted by some decimetres on 100 m: what a loop there agrees with is no witness."""
    wrong, right = shift(0.2), np.zeros(6)
    said = there_and_back([right] * 3 + [wrong] + [right] * 9, [0.0, 0.001, 0.002, 0.003, *(100.0 + np.arange(9.0))])
    assert [bool(reason) for reason in said] == [False] * 3 + [True] + [False] * 9
    assert said[3].startswith("only 0%")


def test_a_rejected_loop_does_not_vote() -> None:
    """Fifty metres from either neighbour, and a hundred off: it goes, and the two that are left agree."""
    said = there_and_back([shift(0.0), shift(100.0), shift(0.0)], [0.0, 50.0, 100.0])
    assert said == ["", "only 0% of the loops around it agree with it", ""]


@pytest.mark.parametrize("origin", [(0.0, 0.0), (-700.0, 2000.0)])
def test_a_loop_beyond_odometrys_drift_is_rejected_first(origin: tuple[float, float]) -> None:
    """A per cent of a way of 1,000 m, and half a degree per 100 m of it over the mean distance of that way."""
    said = there_and_back([shift(0.0, 1000.0)], origin=origin)
    assert "1000.0 m from where odometry is" in said[0]
    lever = 500 * 2 / np.pi
    allowed = LIMIT * (0.01 * 1000 + np.deg2rad(0.5) / 100 * 1000 * lever)
    for share, is_out in ((0.85, False), (1.1, True)):
        assert bool(there_and_back([shift(share * allowed)], origin=origin)[0]) == is_out


def pulled(
    distances: list[float], sigma: float = 1e-6, robust: str = "gnc", scales: list[float] | None = None
) -> GncResult:
    """A point that is known to lie at 0 to `sigma` m, and one wrong or right sighting of it at each distance, m, to a metre."""
    fixed, values, scales = gtsam.NonlinearFactorGraph(), gtsam.Values(), [] if scales is None else scales
    fixed.add(gtsam.PriorFactorPoint3(0, np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, sigma)))
    values.insert(0, np.zeros(3))

    def sighting(x: float) -> OutlierCandidate:
        def make(scale: float, kernel: Any) -> gtsam.PriorFactorPoint3:
            scales.append(scale)
            noise = gtsam.noiseModel.Isotropic.Sigma(3, np.sqrt(scale))
            if kernel is not None:
                noise = gtsam.noiseModel.Robust.Create(kernel, noise)
            return gtsam.PriorFactorPoint3(0, np.array([x, 0, 0]), noise)

        return OutlierCandidate(make, 3)

    return gnc_solve(fixed, [sighting(x) for x in distances], values, GraphConfig.model_validate({"robust": robust}))


def test_gnc_ends_with_the_chi_square_gate() -> None:
    """Whatever is weighed on the way: in below the quantile of its own degrees of freedom, out above."""
    limit = float(np.sqrt(chi2.ppf(0.999, 3)))
    found = pulled([0.5, 0.95 * limit, 1.05 * limit, 2 * limit, 5 * limit, 30 * limit])
    assert found.weights.tolist() == [1, 1, 0, 0, 0, 0]
    assert pulled([0.5, 1.05 * limit]).weights.tolist() == [1, 0]
    np.testing.assert_allclose(found.limits, limit**2, rtol=1e-4)
    np.testing.assert_allclose(np.sqrt(found.squared_residuals) / limit, [0.5 / limit, 0.95, 1.05, 2, 5, 30], rtol=1e-4)


def test_gnc_doubles_its_control_parameter_up_to_convergence() -> None:
    """The control parameter begins at 1 / (2 R - 1) for a worst ratio R of 100 and is 4 when one of 0.8 counts in full.

    That are ten doublings, a solution each, one before and one after: Yang et al. 2020, section III, with a growth of 2.
    """
    limit = float(np.sqrt(chi2.ppf(0.999, 3)))
    doublings = np.ceil(np.log2(4 * (2 * 100 - 1)))
    assert pulled([np.sqrt(0.8) * limit, 10 * limit]).rounds == pytest.approx(1 + (doublings + 1) + 1, abs=1)
    assert pulled([0.5 * limit, 0.99 * limit]).rounds == 1


def test_a_weight_that_is_small_with_its_control_parameter_is_not_decided() -> None:
    """Four of ten are 10 km from the others: at the mean residuals are a thousand limits, and all weights below 1e-6."""
    assert pulled([5e3] * 6 + [1.5e4] * 4, sigma=1e6).weights.tolist() == [1.0] * 6 + [0.0] * 4


def test_gnc_weights_divide_the_information() -> None:
    """One over the weight of Yang et al. 2020, equation 14, multiplies the covariance; ratios are 0.8 and 25 all along."""
    limit, scales = float(np.sqrt(chi2.ppf(0.999, 3))), list[float]()
    pulled([np.sqrt(0.8) * limit, 5 * limit], scales=scales)
    expected = []
    mu = 1 / (2 * 25 - 1)
    while mu < 4:
        for ratio in (0.8, 25.0):
            weight = np.sqrt(mu * (mu + 1) / ratio) - mu
            if mu / (mu + 1) < ratio < (mu + 1) / mu and 0 < weight <= 0.999:
                expected.append(1 / weight)
        mu *= 2
    assert len(expected) >= 6
    np.testing.assert_allclose([s for s in scales if s != 1.0], expected, rtol=1e-3)


@pytest.mark.parametrize("robust", ["huber", "cauchy"])
def test_an_estimator_bends_where_one_right_residual_in_twenty_lies(robust: str) -> None:
    """Against scipy's minimum of the same cost, written out."""
    bend, sigma, seen = float(np.sqrt(chi2.ppf(0.95, 3))), 2.0, np.array([0.3, -0.4, 3.5, 9.0])

    def cost(x: float) -> float:
        r = np.abs(x - seen)
        huber = np.where(r <= bend, r**2 / 2, bend * (r - bend / 2))
        rho = huber if robust == "huber" else bend**2 / 2 * np.log1p((r / bend) ** 2)
        return float(rho.sum() + (x / sigma) ** 2 / 2)

    best = minimize_scalar(cost, bounds=(-1, 5), method="bounded", options={"xatol": 1e-10}).x
    found = pulled(seen.tolist(), sigma, robust)
    assert found.values.atPoint3(0)[0] == pytest.approx(best, abs=1e-2)
    assert found.weights.tolist() == [1, 1, 1, 0]
    assert found.rounds == 1


@pytest.mark.parametrize("parts", [[1.0], [0.25], [0.6, 0.6]])
@pytest.mark.parametrize(("share", "drifts"), [(0.95, False), (1.05, True)])
def test_a_tilt_that_may_be_chance_is_no_drift(share: float, drifts: bool, parts: list[float]) -> None:
    """Up is seen twice, each time to 5 mrad, and by odometry without an error: the tilt between has two directions.

    A quarter of a measurement has four times the variance; what is seen by more than one of them errs as one does.
    """
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = 10.0 * np.arange(3)
    tilt = share * np.sqrt(chi2.ppf(0.999, 2)) * np.sqrt(1 + max(1 / sum(parts), 1.0)) * 5e-3
    tilted = np.array([np.sin(tilt), 0, np.cos(tilt)])
    ups = [UpDirection(0, np.array([0.0, 0, 1]), 5e-3), *(UpDirection(2, tilted, 5e-3, part) for part in parts)]
    steps = [Constraint(k, k + 1, se3.relative(a, b), 1e-20 * np.eye(6)) for k, (a, b) in enumerate(pairwise(poses))]
    assert (drift_factor(PoseGraph(poses, steps, ups=ups), [], GraphConfig()) > 0) == drifts
