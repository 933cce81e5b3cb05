"""Quantiles against scipy's own distribution."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from lslam.core.geometry.noise import chance_of_median, quantile


@pytest.mark.parametrize("dim", [1, 3, 6])
@pytest.mark.parametrize("probability", [0.5, 0.95, 0.999])
def test_quantiles_are_scipys(dim: int, probability: float) -> None:
    assert quantile(probability, dim) == pytest.approx(chi2.ppf(probability, dim), rel=1e-9)


@pytest.mark.parametrize(("dim", "count"), [(2, 1), (3, 5), (3, 33)])
def test_medians_stay_below_as_often_as_drawn_ones(dim: int, count: int) -> None:
    medians = np.median(np.random.default_rng(0).chisquare(dim, (20000, count)), axis=1)
    for share in (0.1, 0.5, 0.95):
        assert chance_of_median(float(np.quantile(medians, share)), dim, count) == pytest.approx(share, abs=0.015)
