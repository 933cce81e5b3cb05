"""Robust solution of a factor graph by graduated non-convexity with truncated least squares (Yang et al. 2020).

The first solution gives all outlier candidates full weight, the following ones re-weight them until each is an inlier or an
outlier. A graph without outliers is solved once. The M-estimators are gtsam's, for comparison.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.config.graph import GraphConfig
from lslam.graph.chi_square import quantile
from lslam.graph.solve import solve

Floats = NDArray[np.float64]

# The control parameter's growth per round, and rounds at most (Yang et al. take 1.4 and 100, from far worse starts).
GROWTH, ROUNDS = 2.0, 30
# Weights beyond these are decided; a factor below the first is left out.
OUT, IN = 1e-3, 0.999


@dataclass(frozen=True)
class OutlierCandidate:
    """A factor that may be an outlier: `make(scale, kernel)` gives it with its covariance times `scale`; dim of its residual."""

    make: Callable[[float, Any], Any]
    dim: int


@dataclass(frozen=True)
class GncResult:
    """The solution of a graph.

    factors : gtsam's graph of all inliers; values : the solution; weights : (D,) 0..1 per candidate
    squared : (D,) whitened squared residuals at the solution; limits : (D,) their chi-square quantiles, inliers are below
    rounds : solutions it took
    """

    factors: Any
    values: Any
    weights: Floats
    squared: Floats
    limits: Floats
    rounds: int


def gnc_solve(fixed: Any, candidates: Sequence[OutlierCandidate], values: Any, config: GraphConfig) -> GncResult:
    """Solve, classifying the outlier candidates by the method `config.robust`."""
    limits = np.array([quantile(config.probability, d.dim) for d in candidates])
    plain = [d.make(1.0, None) for d in candidates]
    if config.robust == "gnc":
        return _graduated(fixed, candidates, plain, limits, values, config)
    factors = joined(fixed, [d.make(1.0, _kernel(config.robust, d.dim)) for d in candidates])
    values = solve(factors, values, config)
    squared = _squared(plain, values)
    is_inlier = (squared <= limits) | (config.robust == "none")
    return GncResult(factors, values, is_inlier.astype(float), squared, limits, 1)


def _graduated(
    fixed: Any,
    candidates: Sequence[OutlierCandidate],
    plain: list[Any],
    limits: Floats,
    values: Any,
    config: GraphConfig,
) -> GncResult:
    weights = np.ones(len(plain))
    factors = joined(fixed, plain)
    values = solve(factors, values, config)
    squared = _squared(plain, values)
    rounds = 1
    ratio = float((squared / limits).max()) if len(plain) else 0.0
    if ratio <= 1:
        return GncResult(factors, values, weights, squared, limits, rounds)
    mu = 1.0 / (2.0 * ratio - 1.0)
    while rounds < ROUNDS:
        weights = truncated_weights(squared / limits, mu)
        factors = joined(fixed, _weighted(candidates, plain, weights))
        values = solve(factors, values, config)
        squared = _squared(plain, values)
        rounds += 1
        if bool(np.all((weights < OUT) | (weights > IN))):
            break
        mu *= GROWTH
    # Finally inliers have their own covariance, outliers are left out.
    is_inlier = squared <= limits
    weights = is_inlier.astype(float)
    factors = joined(fixed, [f for f, b in zip(plain, is_inlier, strict=True) if b])
    values = solve(factors, values, config)
    return GncResult(factors, values, weights, _squared(plain, values), limits, rounds + 1)


def truncated_weights(ratio: Floats, mu: float) -> Floats:
    """Weights of truncated least squares at `mu` (Yang et al. 2020, equation 14), of squared residuals per limit."""
    low, high = mu / (mu + 1), (mu + 1) / mu
    middle = np.sqrt(mu * (mu + 1) / np.maximum(ratio, 1e-12)) - mu
    return np.where(ratio <= low, 1.0, np.where(ratio >= high, 0.0, np.clip(middle, 0.0, 1.0)))


def _weighted(candidates: Sequence[OutlierCandidate], plain: list[Any], weights: Floats) -> list[Any]:
    chosen = []
    for item, factor, weight in zip(candidates, plain, weights, strict=True):
        if weight >= OUT:
            chosen.append(factor if weight > IN else item.make(1.0 / weight, None))
    return chosen


def joined(fixed: Any, more: list[Any]) -> Any:
    """The factor graph `fixed` and more factors; `fixed` stays as it is."""
    import gtsam

    factors = gtsam.NonlinearFactorGraph(fixed)
    for factor in more:
        factors.add(factor)
    return factors


def _squared(factors: list[Any], values: Any) -> Floats:
    """(D,) squared whitened residuals. gtsam's `error` is half of that."""
    return np.array([2.0 * factor.error(values) for factor in factors])


def _kernel(name: str, dim: int) -> Any:
    """An M-estimator with its parameter at the 95 % quantile of inlier residuals."""
    import gtsam

    bend = float(np.sqrt(quantile(0.95, dim)))
    estimators = gtsam.noiseModel.mEstimator
    kernels: dict[str, Any] = {"huber": estimators.Huber, "cauchy": estimators.Cauchy}
    return kernels[name].Create(bend) if name in kernels else None
