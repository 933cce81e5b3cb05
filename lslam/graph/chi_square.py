"""How large sums of squared, normalised errors are."""

from __future__ import annotations


def quantile(probability: float, dim: int) -> float:
    """The value that a chi-square variable of `dim` degrees of freedom stays below with `probability`.

    As `scipy.stats.chi2.ppf`, whose import takes longer than many a graph.

    >>> round(quantile(0.95, 3), 3)
    7.815
    """
    from scipy.special import gammaincinv

    return float(2.0 * gammaincinv(0.5 * dim, probability))
