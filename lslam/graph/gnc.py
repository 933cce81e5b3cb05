"""Solving a graph of which some loops and fixes may be wrong.

Graduated non-convexity with truncated least squares (Yang et al. 2020): the first solution believes everything, the
following ones give those that do not fit less and less weight, until each is in or out. Only loops and fixes are
re-weighted, and a graph in which all fit is solved once. The M-estimators are gtsam's, for comparison.
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
# Weights this near to 0 and 1 are decided; a factor under the first is left out.
OUT, IN = 1e-3, 0.999


@dataclass(frozen=True)
class Doubted:
    """A factor that may be wrong: `make(scale, kernel)` gives it with its covariance times `scale`; dim of its residual."""

    make: Callable[[float, Any], Any]
    dim: int


@dataclass(frozen=True)
class Settled:
    """What the graph is in the end.

    factors : gtsam's graph of all that is believed; values : the solution; weights : (D,) 0..1 per doubted factor
    squared : (D,) whitened squared residuals at the solution; limits : (D,) up to which they are believed
    """

    factors: Any
    values: Any
    weights: Floats
    squared: Floats
    limits: Floats
    rounds: int


def settle(fixed: Any, doubted: Sequence[Doubted], values: Any, config: GraphConfig) -> Settled:
    """Solve, deciding what to believe as `config.robust` says."""
    limits = np.array([quantile(config.probability, d.dim) for d in doubted])
    plain = [d.make(1.0, None) for d in doubted]
    if config.robust == "gnc":
        return _graduated(fixed, doubted, plain, limits, values, config)
    factors = joined(fixed, [d.make(1.0, _kernel(config.robust, d.dim)) for d in doubted])
    values = solve(factors, values, config)
    squared = _squared(plain, values)
    believed = (squared <= limits) | (config.robust == "none")
    return Settled(factors, values, believed.astype(float), squared, limits, 1)


def _graduated(
    fixed: Any, doubted: Sequence[Doubted], plain: list[Any], limits: Floats, values: Any, config: GraphConfig
) -> Settled:
    weights = np.ones(len(plain))
    factors = joined(fixed, plain)
    values = solve(factors, values, config)
    squared = _squared(plain, values)
    rounds = 1
    ratio = float((squared / limits).max()) if len(plain) else 0.0
    if ratio <= 1:
        return Settled(factors, values, weights, squared, limits, rounds)
    mu = 1.0 / (2.0 * ratio - 1.0)
    while rounds < ROUNDS:
        weights = truncated_weights(squared / limits, mu)
        factors = joined(fixed, _weighted(doubted, plain, weights))
        values = solve(factors, values, config)
        squared = _squared(plain, values)
        rounds += 1
        if bool(np.all((weights < OUT) | (weights > IN))):
            break
        mu *= GROWTH
    # The last word: what fits is in, with its own covariance, what does not is out.
    believed = squared <= limits
    weights = believed.astype(float)
    factors = joined(fixed, [f for f, b in zip(plain, believed, strict=True) if b])
    values = solve(factors, values, config)
    return Settled(factors, values, weights, _squared(plain, values), limits, rounds + 1)


def truncated_weights(ratio: Floats, mu: float) -> Floats:
    """Weights of truncated least squares at `mu` (Yang et al. 2020, equation 14), of squared residuals per limit."""
    low, high = mu / (mu + 1), (mu + 1) / mu
    middle = np.sqrt(mu * (mu + 1) / np.maximum(ratio, 1e-12)) - mu
    return np.where(ratio <= low, 1.0, np.where(ratio >= high, 0.0, np.clip(middle, 0.0, 1.0)))


def _weighted(doubted: Sequence[Doubted], plain: list[Any], weights: Floats) -> list[Any]:
    chosen = []
    for item, factor, weight in zip(doubted, plain, weights, strict=True):
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
    """M-estimators whose bend lies where 95 % of right residuals are below."""
    import gtsam

    bend = float(np.sqrt(quantile(0.95, dim)))
    estimators = gtsam.noiseModel.mEstimator
    kernels: dict[str, Any] = {"huber": estimators.Huber, "cauchy": estimators.Cauchy}
    return kernels[name].Create(bend) if name in kernels else None
