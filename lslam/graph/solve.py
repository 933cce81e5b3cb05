"""gtsam's optimisers, with their exceptions as sentences, and marginal covariances."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.config.graph import GraphConfig
from lslam.errors import GraphError
from lslam.geometry import noise
from lslam.graph.factors import FIX_NOISE
from lslam.stopping import check_stop, checking

Floats = NDArray[np.float64]

# Keyframes that iSAM2 takes in per update.
BATCH = 10


def solve(factors: Any, values: Any, config: GraphConfig) -> Any:
    """The values at which `factors` fit best, from `values` on.

    Raises GraphError when the graph is singular or the solution is not finite, InterruptedRunError as `check_stop`.
    """
    import gtsam

    check_stop()
    try:
        is_dogleg = config.optimizer == "dogleg"
        params: Any = gtsam.DoglegParams() if is_dogleg else gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(config.max_iterations)
        params.iterationHook = lambda iteration, before, after: check_stop()
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
    for i in range(factors.size()):
        factor = factors.at(i)
        names = factor.keys()
        due[max((key for key in names if key < count), default=0)].append(factor)
    params = gtsam.ISAM2Params()
    params.relinearizeSkip = 1
    together = [key for key in map(int, values.keys()) if key >= FIX_NOISE]
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
        raise GraphError(f"the pose graph cannot be optimised: {_first_line(failure)}") from None


def marginals(factors: Any, values: Any, poses: Floats) -> Floats:
    """(K, 6, 6) covariances of the poses with the keys 0..K-1, t' = t + d[:3], R' = exp(d[3:]) R in world axes, m2 and rad2.

    Raises GraphError when the graph is singular.
    """
    bodies = marginal_blocks(factors, values, range(len(poses)))
    world = noise.from_body(bodies, poses)
    # d of this house is in the parent's axes: the world's.
    return 0.5 * (world + np.swapaxes(world, -1, -2))


def marginal_blocks(factors: Any, values: Any, keys: Iterable[int]) -> Floats:
    """(K, 6, 6) covariances of the poses with these keys, in gtsam's order and axes.

    Raises GraphError when the graph is singular.
    """
    import gtsam

    wanted = list(keys)
    try:
        known = gtsam.Marginals(factors, values)
        return np.stack([known.marginalCovariance(key) for key in checking(wanted)])
    except RuntimeError:
        # It gives up where neighbouring unknowns are known very differently well, as the roll of a straight path is.
        return scaled_blocks(factors, values, wanted)


def scaled_blocks(factors: Any, values: Any, keys: list[int]) -> Floats:
    """What `marginal_blocks` gives, by normal equations scaled so that each unknown counts alike."""
    from scipy.sparse import csc_array, diags_array
    from scipy.sparse.linalg import splu

    # The columns of the Jacobian are in the order of the keys; a floor has less than six.
    sizes = dict(sorted(values.dims().items()))
    begins = dict(zip(sizes, np.cumsum([0, *sizes.values()]).tolist(), strict=False))
    columns = values.dim()
    rows, cols, entries = factors.linearize(values).sparseJacobian_()
    A = csc_array((entries, (rows.astype(np.intp) - 1, cols.astype(np.intp) - 1)))[:, :columns]
    H = (A.T @ A).tocsc()
    scale = 1.0 / np.sqrt(H.diagonal())
    try:
        factor = splu((diags_array(scale) @ H @ diags_array(scale)).tocsc())
    except RuntimeError as failure:
        raise GraphError(f"the pose graph has no covariances: {_first_line(failure)}") from None
    blocks = []
    for key in checking(keys):
        begin = begins[key]
        units = np.zeros((columns, 6))
        units[begin : begin + 6] = np.diag(scale[begin : begin + 6])
        blocks.append(scale[begin : begin + 6, None] * factor.solve(units)[begin : begin + 6])
    return np.stack(blocks)


def _first_line(failure: RuntimeError) -> str:
    text = str(failure).strip()
    return text.splitlines()[0] if text else type(failure).__name__
