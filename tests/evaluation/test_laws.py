"""Laws against truths with noise, the thesis' own laws, and too few points."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from lslam.core.arrays import Floats
from lslam.core.types.study import LawKind
from lslam.evaluation.curves import band, fit_law, rival

SKIPS = np.arange(1.0, 21.0)
SHARES = np.arange(0.1, 1.01, 0.1)


def grid() -> Floats:
    return np.array([(skip, share) for skip in (1.0, 2.0, 4.0, 8.0) for share in (0.1, 0.3, 0.6, 1.0)])


@pytest.mark.parametrize(
    ("kind", "points", "truth"),
    [
        ("inverse", SKIPS, 46.82 / SKIPS),
        ("linear", SHARES, 36.81 * SHARES + 0.3373),
        ("product", grid(), 152.2 * grid()[:, 1] / grid()[:, 0]),
    ],
)
def test_true_law_lies_in_the_stated_band_as_often_as_stated(kind: LawKind, points: Floats, truth: Floats) -> None:
    draw = np.random.default_rng(5)
    inside = []
    for _ in range(400):
        times = (truth * (1 + 0.05 * draw.standard_normal((3, len(truth))))).mean(0)
        law = fit_law(kind, ("x", "y"), points, times, np.full(len(truth), 3.0), level=0.9)
        assert law is not None
        line, half = band(law, points)
        inside.append(np.abs(line - truth) <= half)
    # 400 draws of a share of 0.9 have a standard deviation of 0.015.
    assert np.mean(inside) == pytest.approx(0.9, abs=0.05)


@pytest.mark.parametrize(
    ("kind", "x", "times", "coefficients"),
    [
        ("inverse", SKIPS, 46.82 / SKIPS, [46.82]),
        ("linear", SHARES, 36.81 * SHARES + 0.3373, [36.81, 0.3373]),
        ("product", grid(), 152.2 * grid()[:, 1] / grid()[:, 0], [152.2]),
    ],
)
def test_laws_of_the_thesis_come_back_exactly(
    kind: LawKind, x: Floats, times: Floats, coefficients: list[float]
) -> None:
    law = fit_law(kind, ("input.skip_frames", "preprocess.random_share"), x, times)
    assert law is not None
    assert law.coefficients == pytest.approx(coefficients)
    assert law.r2 == pytest.approx(1.0)
    assert np.abs(law.residuals).max() < 1e-9


def test_weights_follow_the_runs_behind_a_mean() -> None:
    # Six points on 10 / x and a seventh far off it: a mean over ever more runs pulls the law towards it.
    x = np.array([1.0, 2, 3, 4, 5, 6, 8])
    times = 10 / x
    times[-1] *= 2
    one, many = (fit_law("inverse", ("x",), x, times, np.array([1.0] * 6 + [n])) for n in (1.0, 100.0))
    assert one is not None
    assert many is not None
    # By hand: weighted mean of 10 and 20 under weights n / expected^2, which the fit iterates to.
    assert 10 < one.coefficients[0] < 12.5
    assert many.coefficients[0] > 18


def test_mean_over_four_runs_counts_as_four_means_over_one() -> None:
    draw = np.random.default_rng(2)
    times = (20 * SHARES + 3) * (1 + 0.05 * draw.standard_normal(len(SHARES)))
    runs = np.array([4, 1, 1, 2, 1, 1, 3, 1, 1, 1])
    means = fit_law("linear", ("x",), SHARES, times, runs.astype(float))
    ones = fit_law("linear", ("x",), np.repeat(SHARES, runs), np.repeat(times, runs))
    assert means is not None
    assert ones is not None
    assert means.coefficients == pytest.approx(ones.coefficients)


def test_no_weight_is_above_that_of_the_shortest_time() -> None:
    x, times = np.arange(1.0, 9.0), np.array([0.4, 0.5, 2, 4, 6, 8, 10, 12])
    law = fit_law("linear", ("x",), x, times)
    assert law is not None
    assert law.law_times.min() < 0.9 * times.min()
    # By hand: the law is the fit under the weights that it gives.
    weights = 1 / np.maximum(law.law_times, 0.4)
    columns = np.stack([x, np.ones(8)], 1) * weights[:, None]
    by_hand = np.linalg.solve(columns.T @ columns, columns.T @ (times * weights))
    assert law.coefficients == pytest.approx(by_hand, rel=2e-3)


def test_band_is_that_of_an_independent_fit_by_scipy() -> None:
    from scipy.optimize import curve_fit
    from scipy.stats import t as student

    draw = np.random.default_rng(1)
    times = (20 * SHARES + 3) * (1 + 0.03 * draw.standard_normal(len(SHARES)))
    law = fit_law("linear", ("x",), SHARES, times)
    assert law is not None
    best, covariance = curve_fit(lambda x, a, b: a * x + b, SHARES, times, sigma=law.law_times)
    assert law.coefficients == pytest.approx(best, rel=1e-4)
    margins = student.ppf(0.995, len(times) - 2) * np.sqrt(np.diag(covariance))
    assert law.margins == pytest.approx(margins, rel=1e-3)


@pytest.mark.parametrize("kind", ["linear", "inverse"])
def test_five_points_make_no_law_and_six_do(kind: LawKind) -> None:
    x = np.arange(1.0, 7.0)
    assert fit_law(kind, ("x",), x[:5], 10 / x[:5]) is None
    assert fit_law(kind, ("x",), x, 10 / x) is not None


@pytest.mark.parametrize("spoilt", [np.nan, 0.0])
def test_what_has_no_time_or_is_the_same_point_again_does_not_count(spoilt: float) -> None:
    x = np.arange(1.0, 7.0)
    times = 10 / x
    times[2] = spoilt
    assert fit_law("inverse", ("x",), x, times) is None
    assert fit_law("inverse", ("x",), np.array([1.0, 1, 2, 3, 4, 5]), np.ones(6)) is None


@pytest.mark.parametrize("second", [0.0, 1.0])
def test_points_at_which_a_product_is_zero_do_not_count(second: float) -> None:
    """Six points with y = 0 make no law, and beside six others they change nothing."""
    zero, other = (np.stack([np.arange(1.0, 7.0), np.full(6, y)], 1) for y in (0.0, second))
    law = fit_law("product", ("x", "y"), np.concatenate([zero, other]), np.tile(10 / np.arange(1.0, 7.0), 2))
    if second == 0:
        assert law is None
        return
    assert law is not None
    assert law.coefficients == pytest.approx([10.0])
    assert law.r2 == pytest.approx(1.0)
    assert np.abs(law.residuals).max() < 1e-9


def test_r2_says_when_the_law_is_wrong() -> None:
    rising: dict[str, Any] = {"names": ("x",), "points": SKIPS, "times": 5 + 2 * SKIPS}
    wrong, right = fit_law("inverse", **rising), fit_law("linear", **rising)
    assert wrong is not None
    assert right is not None
    assert wrong.r2 < 0.5 < right.r2
    assert right.text == "T = 2 x + 5"


@pytest.mark.parametrize(
    ("kind", "x", "y", "said"),
    [
        ("product", np.linspace(9.9, 10.1, 8), np.array([1.0, 4, 2, 8, 3, 7, 5, 6]), "a y"),
        ("product", np.array([1.0, 4, 2, 8, 3, 7, 5, 6]), np.linspace(0.99, 1.01, 8), "a / x"),
        ("linear", np.linspace(20, 22, 8), None, "a / x"),
        ("inverse", np.linspace(20, 22, 8), None, "a x + b"),
    ],
)
def test_the_alternative_law_depends_on_the_varied_parameter_alone(
    kind: LawKind, x: np.ndarray, y: np.ndarray | None, said: str
) -> None:
    points = x if y is None else np.column_stack([x, y])
    times = {"product": 3 / x * (1 if y is None else y), "linear": 42 - x, "inverse": 3 / x}[kind]
    law = fit_law(kind, ("x", "y")[: 1 if y is None else 2], points, times)
    assert law is not None
    name, r2 = rival(law)
    assert name == said
    assert 0.97 < r2 < 1.0


@pytest.mark.parametrize("bad", [(np.nan, 0.3), (2.0, np.inf), (np.nan, np.nan)])
def test_points_without_a_value_are_no_observations(bad: tuple[float, float]) -> None:
    points, times = np.vstack([grid(), bad]), np.append(152.2 * grid()[:, 1] / grid()[:, 0], 77.0)
    law = fit_law("product", ("x", "y"), points, times)
    assert law is not None
    assert law.coefficients == pytest.approx([152.2])
    assert len(law.points) == len(grid())
