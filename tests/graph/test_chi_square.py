"""Quantiles against scipy's own distribution."""

from __future__ import annotations

import pytest
from scipy.stats import chi2

from lslam.graph.chi_square import quantile


@pytest.mark.parametrize("dim", [1, 3, 6])
@pytest.mark.parametrize("probability", [0.5, 0.95, 0.999])
def test_quantiles_are_scipys(dim: int, probability: float) -> None:
    assert quantile(probability, dim) == pytest.approx(chi2.ppf(probability, dim), rel=1e-9)
