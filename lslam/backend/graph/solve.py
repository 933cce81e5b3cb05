"""gtsam's optimisers, with their exceptions as sentences."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lslam.backend.graph.factors import BIAS_KEY, FIX_NOISE, SPEED_KEY, keyframe_of
from lslam.backend.graph.marginals import first_line
from lslam.core.arrays import Floats
from lslam.core.config.backend import GraphConfig
from lslam.core.errors import GraphError
from lslam.core.geometry.noise import RIGHT_PROBABILITY, quantile
from lslam.core.stopping import check_stop

# Keyframes that iSAM2 takes in per update.
BATCH = 10
# Of the optimiser, per solution.
MAX_ITERATIONS = 100
# The control parameter's growth per round, and rounds at most (Yang et al. take 1.4 and 100, from far worse starts).
GROWTH, ROUNDS = 2.0, 30
# A weight beyond is decided, as one of 0 is; other small weights are not: with the control parameter all of them are small.
IN = 0.999


def solve(factors: Any, values: Any, config: GraphConfig) -> Any:
    """The values that minimise the error of `factors`, from the initial `values`.

    Raises GraphError when the graph is singular or the solution is not finite, InterruptedRunError as `check_stop`.
    """
    import gtsam

    check_stop()
    try:
        is_dogleg = config.optimizer == "dogleg"
        params: Any = gtsam.DoglegParams() if is_dogleg else gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(MAX_ITERATIONS)
        params.iterationHook = lambda iteration, before, after: check_stop()
        optimizer: Any = gtsam.DoglegOptimizer if is_dogleg else gtsam.LevenbergMarquardtOptimizer
        solution = optimizer(factors, values, params).optimize()
        error = float(factors.error(solution))
    except RuntimeError as failure:
        raise GraphError(f"the pose graph cannot be optimised: {first_line(failure)}") from None
    if not np.isfinite(error):
        raise GraphError("the pose graph cannot be optimised: its error is not finite")
    return solution


def refine(factors: Any, values: Any, config: GraphConfig) -> Any:
    """The values that minimise the error of `factors`, by Gauss-Newton from `values` close to them.

    It falls back to `solve` where a step does not lower the cost, and raises its errors. A step's linear cost predicts the cost
    after it. If the prediction holds within the optimiser's tolerance, the next step would gain no more, and is omitted.
    """
    import gtsam

    params = gtsam.NonlinearOptimizerParams()
    for _ in range(MAX_ITERATIONS):
        check_stop()
        try:
            linear = factors.linearize(values)
            step = linear.eliminateSequential(gtsam.Ordering.OrderingType.COLAMD).optimize()
            moved = values.retract(step)
            reached = factors.error(moved)
            if abs(reached - linear.error(step)) <= max(
                params.getAbsoluteErrorTol(), params.getRelativeErrorTol() * reached
            ):
                return moved
            if not reached < factors.error(values):
                break
        except RuntimeError:
            break
        values = moved
    return solve(factors, values, config)


def solve_incrementally(factors: Any, values: Any, count: int) -> Any:
    """Solve by iSAM2, adding keyframes 0, 1, ... `count` - 1 in turn: each factor enters with the last of its keyframes.

    Raises GraphError as `solve` does.
    """
    import gtsam

    due: list[list[Any]] = [[] for _ in range(count)]
    for i in range(factors.size()):
        factor = factors.at(i)
        due[max((k for k in map(keyframe_of, factor.keys()) if k < count), default=0)].append(factor)
    params = gtsam.ISAM2Params()
    params.relinearizeSkip = 1
    together = [key for key in map(int, values.keys()) if FIX_NOISE <= key < SPEED_KEY]
    if together:
        # Beside odometry of a centimetre the information of correlated noise of a metre is lost in the normal equations.
        params.setFactorization("QR")
    solver = gtsam.ISAM2(params)
    try:
        for begin in range(0, count, BATCH):
            check_stop()
            part, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
            for k in range(begin, min(begin + BATCH, count)):
                start.insert(k, values.atPose3(k))
                if values.exists(SPEED_KEY + k):
                    start.insert(SPEED_KEY + k, values.atPoint3(SPEED_KEY + k))
                    start.insert(BIAS_KEY + k, values.atConstantBias(BIAS_KEY + k))
                for factor in due[k]:
                    part.add(factor)
            if begin == 0 and values.exists(count + 1):
                start.insert(count + 1, values.atPose3(count + 1))
            if begin == 0:
                for key in together:
                    start.insert(key, values.atPoint3(key))
            if begin == 0 and values.exists(count):
                floor = values.atOrientedPlane3(count)
                start.insert(count, floor)
                loose = gtsam.noiseModel.Isotropic.Sigma(2, 3.0)
                part.add(gtsam.OrientedPlane3DirectionPrior(count, floor.planeCoefficients(), loose))
            solver.update(part, start)
        return solver.calculateBestEstimate()
    except RuntimeError as failure:
        raise GraphError(f"the pose graph cannot be optimised: {first_line(failure)}") from None


@dataclass(frozen=True)
class OutlierCandidate:
    """A factor that may be an outlier; dim : of its residual.

    make : function of a scale and gtsam's noise kernel that gives the factor with its covariance times the scale
    """

    make: Callable[[float, Any], Any]
    dim: int


@dataclass(frozen=True)
class GncResult:
    """The solution of a graph.

    factors : gtsam's graph of all inliers; values : the solution; weights : (D,) 0..1 per candidate
    squared_residuals : (D,) whitened, at the solution; limits : (D,) their chi-square quantiles, inliers are below
    rounds : solutions it took
    """

    factors: Any
    values: Any
    weights: Floats
    squared_residuals: Floats
    limits: Floats
    rounds: int


def gnc_solve(base: Any, candidates: Sequence[OutlierCandidate], values: Any, config: GraphConfig) -> GncResult:
    """Solve, classifying the outlier candidates by the method `config.robust`."""
    limits = np.array([quantile(RIGHT_PROBABILITY, d.dim) for d in candidates])
    plain = [d.make(1.0, None) for d in candidates]
    if config.robust == "gnc":
        return _solve_gnc(base, candidates, plain, limits, values, config)
    factors = join_factors(base, [d.make(1.0, _kernel(config.robust, d.dim)) for d in candidates])
    values = solve(factors, values, config)
    squared = _squared_residuals(plain, values)
    is_inlier = (squared <= limits) | (config.robust == "none")
    return GncResult(factors, values, is_inlier.astype(float), squared, limits, 1)


def _solve_gnc(
    base: Any,
    candidates: Sequence[OutlierCandidate],
    plain: list[Any],
    limits: Floats,
    values: Any,
    config: GraphConfig,
) -> GncResult:
    """Graduated non-convexity with truncated least squares; plain : the candidates' factors, limits : of squared residuals."""
    weights = np.ones(len(plain))
    factors = join_factors(base, plain)
    values = solve(factors, values, config)
    squared = _squared_residuals(plain, values)
    rounds = 1
    ratio = float((squared / limits).max()) if len(plain) else 0.0
    if ratio <= 1:
        return GncResult(factors, values, weights, squared, limits, rounds)
    mu = 1.0 / (2.0 * ratio - 1.0)
    while rounds < ROUNDS:
        weights = truncated_weights(squared / limits, mu)
        factors = join_factors(base, _weight(candidates, plain, weights))
        values = refine(factors, values, config)
        squared = _squared_residuals(plain, values)
        rounds += 1
        if are_binary(weights):
            break
        mu *= GROWTH
    # Finally inliers have their own covariance, outliers are left out.
    is_inlier = squared <= limits
    if are_binary(weights) and np.array_equal(is_inlier, weights > IN):
        return GncResult(factors, values, is_inlier.astype(float), squared, limits, rounds)
    weights = is_inlier.astype(float)
    factors = join_factors(base, [f for f, b in zip(plain, is_inlier, strict=True) if b])
    values = solve(factors, values, config)
    return GncResult(factors, values, weights, _squared_residuals(plain, values), limits, rounds + 1)


def truncated_weights(ratio: Floats, mu: float) -> Floats:
    """Weights of truncated least squares at `mu` (Yang et al. 2020, equation 14), of squared residuals per limit."""
    low, high = mu / (mu + 1), (mu + 1) / mu
    middle = np.sqrt(mu * (mu + 1) / np.maximum(ratio, 1e-12)) - mu
    return np.where(ratio <= low, 1.0, np.where(ratio >= high, 0.0, np.clip(middle, 0.0, 1.0)))


def are_binary(weights: Floats) -> bool:
    """Whether every candidate counts in full or not at all."""
    return bool(np.all((weights == 0) | (weights > IN)))


def _weight(candidates: Sequence[OutlierCandidate], plain: list[Any], weights: Floats) -> list[Any]:
    """Factors of the candidates with positive weight, their covariances divided by the weights."""
    chosen = []
    for item, factor, weight in zip(candidates, plain, weights, strict=True):
        if weight > 0:
            chosen.append(factor if weight > IN else item.make(1.0 / weight, None))
    return chosen


def join_factors(base: Any, more: list[Any]) -> Any:
    """A copy of the factor graph `base` with more factors."""
    import gtsam

    factors = gtsam.NonlinearFactorGraph(base)
    for factor in more:
        factors.add(factor)
    return factors


def _squared_residuals(factors: list[Any], values: Any) -> Floats:
    """(D,) squared whitened residuals. gtsam's `error` is half of that."""
    return np.array([2.0 * factor.error(values) for factor in factors])


def _kernel(name: str, dim: int) -> Any:
    """An M-estimator with its parameter at the 95 % quantile of inlier residuals."""
    import gtsam

    bend = float(np.sqrt(quantile(0.95, dim)))
    estimators = gtsam.noiseModel.mEstimator
    kernels: dict[str, Any] = {"huber": estimators.Huber, "cauchy": estimators.Cauchy}
    return kernels[name].Create(bend) if name in kernels else None
