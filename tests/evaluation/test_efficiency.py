"""Efficiency of equations 5.2 and 5.3 on numbers that Girolimetto prints, and intervals over seeds."""

from __future__ import annotations

import numpy as np
import pytest

from lslam.evaluation.curves import efficiency, median_over_seeds, normalise, over_seeds, t_half_width

# Its open flight (tables 4.13 and 5.3): rmse m, angular rmse deg, s of registration per scan (LOAM and map added), s in all.
OPEN = {
    "LOAM map": (0.584, 1.61, 0.100 + 0.083, 21.48),
    "LOAM": (0.844, 1.67, 0.129, 15.97),
    "ICP": (0.843, 2.12, 0.109, 11.15),
    "ICP + IMU": (0.418, 1.55, 0.112, 11.53),
    "LOAM map + IMU": (0.507, 1.57, 0.074 + 0.068, 16.71),
}


def test_efficiencies_of_the_methods_of_the_thesis() -> None:
    translation, angular, registration, total = np.array(list(OPEN.values())).T
    # By hand, equation 5.2: 1 / 0.07256 for ICP + IMU, the largest; then 1 / 0.17206, 0.18182, 0.19480 and 0.11303.
    by_hand = [0.4217, 0.3991, 0.3725, 1.0, 0.6420]
    assert normalise(efficiency(translation, angular, registration)) == pytest.approx(by_hand, abs=1e-4)
    # Equation 5.3: 1 / 7.470; then 1 / 20.196, 22.509, 19.927 and 13.301.
    by_hand = [0.3699, 0.3319, 0.3749, 1.0, 0.5616]
    assert normalise(efficiency(translation, angular, total)) == pytest.approx(by_hand, abs=1e-4)


def test_efficiency_is_unknown_where_a_number_is() -> None:
    values = efficiency([0.5, np.nan, 0.0], [2.0, 1.0, 1.0], [0.1, 1.0, 1.0])
    assert values[0] == pytest.approx(10)
    assert np.isnan(values[1:]).all()
    assert np.isnan(normalise(np.array([0.0, np.nan]))).all()


def test_interval_over_seeds_is_students() -> None:
    over = over_seeds(np.array([[1.0, 2.0, 3.0], [4.0, np.nan, np.nan], [np.nan] * 3]))
    assert over.mean[:2] == pytest.approx([2.0, 4.0])
    assert list(over.n) == [3, 1, 0]
    # t(0.975, 2) = 4.3027 standard errors of 1 / sqrt(3).
    assert over.high[0] == pytest.approx(2 + 4.3027 / np.sqrt(3), abs=1e-4)
    assert np.isnan(over.low[1:]).all()
    assert np.isnan(over.mean[2])


def test_students_quantiles_are_those_of_scipy() -> None:
    from scipy.stats import t as student

    freedom = np.array([1, 2, 3, 10, 1000])
    for level in (0.5, 0.95, 0.99):
        assert t_half_width(level, freedom) == pytest.approx(student.ppf(0.5 + level / 2, freedom), rel=1e-9)


def test_interval_over_seeds_holds_the_truth_as_often_as_it_says() -> None:
    draw = np.random.default_rng(3)
    over = over_seeds(5 + draw.standard_normal((4000, 3)))
    assert np.mean((over.low <= 5) & (over.high >= 5)) == pytest.approx(0.95, abs=0.015)


def test_median_over_seeds_leaves_out_what_is_unknown() -> None:
    medians = median_over_seeds(np.array([[1.0, 9.0, 2.0], [4.0, np.nan, 6.0], [np.nan] * 3]))
    assert medians[:2] == pytest.approx([2.0, 5.0])
    assert np.isnan(medians[2])
