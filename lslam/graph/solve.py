"""gtsam's optimisers, with their exceptions as sentences, and marginal covariances."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.config.graph import GraphConfig
from lslam.errors import GraphError
from lslam.geometry import noise

Floats = NDArray[np.float64]

# Keyframes that iSAM2 takes in per update.
BATCH = 10


def solve(factors: Any, values: Any, config: GraphConfig) -> Any:
    """The values at which `factors` fit best, from `values` on.

    Raises GraphError when the graph is singular or the solution is not finite.
    """
    import gtsam

    try:
        is_dogleg = config.optimizer == "dogleg"
        params: Any = gtsam.DoglegParams() if is_dogleg else gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(config.max_iterations)
        optimizer: Any = gtsam.DoglegOptimizer if is_dogleg else gtsam.LevenbergMarquardtOptimizer
        found = optimizer(factors, values, params).optimize()
        error = float(factors.error(found))
    except RuntimeError as failure:
        raise GraphError(f"the pose graph cannot be optimised: {_first_line(failure)}") from None
    if not np.isfinite(error):
        raise GraphError("the pose graph cannot be optimised: its error is not finite")
    return found


def solve_incrementally(factors: Any, values: Any, count: int) -> Any:
    """The same by iSAM2, keyframes 0, 1, ... in turn: each factor enters with the last of its keyframes.

    Raises GraphError as `solve` does.
    """
    import gtsam

    due: list[list[Any]] = [[] for _ in range(count)]
    names = values.keys()
    landmarks = [key for key in names if key >= count]
    for i in range(factors.size()):
        factor = factors.at(i)
        names = factor.keys()
        due[max(key for key in names if key < count)].append(factor)
    params = gtsam.ISAM2Params()
    params.relinearizeSkip = 1
    solver = gtsam.ISAM2(params)
    try:
        for begin in range(0, count, BATCH):
            part, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
            for k in range(begin, min(begin + BATCH, count)):
                start.insert(k, values.atPose3(k))
                for factor in due[k]:
                    part.add(factor)
            for key in landmarks if begin == 0 else ():
                start.insert(key, values.atOrientedPlane3(key))
                part.add(gtsam.OrientedPlane3DirectionPrior(
                    key, values.atOrientedPlane3(key).planeCoefficients(), gtsam.noiseModel.Isotropic.Sigma(2, 3.0)
                ))  # fmt: skip
            solver.update(part, start)
        return solver.calculateBestEstimate()
    except RuntimeError as failure:
        raise GraphError(f"the pose graph cannot be optimised: {_first_line(failure)}") from None


def marginals(factors: Any, values: Any, poses: Floats) -> Floats:
    """(K, 6, 6) covariances of all poses, t' = t + d[:3], R' = exp(d[3:]) R in world axes, m2 and rad2.

    Raises GraphError when the graph is singular.
    """
    import gtsam

    try:
        known = gtsam.Marginals(factors, values)
        bodies = np.stack([known.marginalCovariance(k) for k in range(len(poses))])
    except RuntimeError as failure:
        raise GraphError(f"the pose graph has no covariances: {_first_line(failure)}") from None
    world = noise.from_body(bodies, poses)
    # d of this house is in the parent's axes: the world's.
    return 0.5 * (world + np.swapaxes(world, -1, -2))


def _first_line(failure: RuntimeError) -> str:
    text = str(failure).strip()
    return text.splitlines()[0] if text else type(failure).__name__
