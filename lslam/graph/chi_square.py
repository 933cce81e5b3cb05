"""Quantiles of the chi-square distribution."""

from __future__ import annotations


def quantile(probability: float, dim: int) -> float:
    """The value that a chi-square variable of `dim` degrees of freedom stays below with `probability`.

    As `scipy.stats.chi2.ppf`, whose import takes longer than many a graph.

    >>> round(quantile(0.95, 3), 3)
    7.815
    """
    from scipy.special import gammaincinv

    return float(2.0 * gammaincinv(0.5 * dim, probability))


def chance_of_median(median: float, dim: int, count: int) -> float:
    """The probability that the median of `count` chi-square variables of `dim` degrees of freedom stays below `median`.

    >>> round(chance_of_median(quantile(0.95, 3), 3, 1), 3)
    0.95
    >>> round(chance_of_median(quantile(0.5, 3), 3, 33), 3)
    0.5
    """
    from scipy.special import betainc, gammainc

    rank = 0.5 * (count + 1)
    return float(betainc(rank, rank, gammainc(0.5 * dim, 0.5 * median)))
