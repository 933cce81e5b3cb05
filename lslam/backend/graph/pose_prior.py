"""What a solved graph knows of its poses beside LiDAR: fixes, control points, buildings, gravity, the IMU."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from lslam.core.errors import GraphError
from lslam.core.geometry import noise, se3
from lslam.core.types.arrays import Floats


@dataclass(frozen=True)
class PosePrior:
    """Poses with the joint information of measurements that agree on them.

    poses : (K, 4, 4) of the keyframes
    product : of (K, 6) changes of them, t' = t + d[:3], R' = exp(d[3:]) R, with their information matrix
    blocks : (K, 6, 6) on the diagonal of that matrix, before other unknowns are eliminated
    """

    poses: Floats
    product: Callable[[Floats], Floats]
    blocks: Floats


def pose_prior(factors: Any, values: Any, count: int) -> PosePrior:
    """Information that gtsam's `factors` give of the poses with the keys 0..count-1 at `values`; other unknowns are eliminated.

    Raises GraphError where the factors do not determine the other unknowns.
    """
    from scipy.sparse import csc_array, diags_array
    from scipy.sparse.linalg import splu

    poses = se3.normalise(np.stack([values.atPose3(k).matrix() for k in range(count)]))
    # The columns of the Jacobian are in the order of the keys of the factors.
    sizes = dict(sorted(values.dims().items()))
    used = {int(key) for i in range(factors.size()) for key in list(factors.at(i).keys())}
    begins, width = {}, 0
    for key in sorted(used):
        begins[key], width = width, width + sizes[key]
    rows, cols, entries = factors.linearize(values).sparseJacobian_()
    A = csc_array((entries, (rows.astype(np.intp) - 1, cols.astype(np.intp) - 1)))[:, :width]
    H = (A.T @ A).tocsc()
    own = np.array([k for k in range(count) if k in begins], np.intp)
    mine = (np.array([begins[k] for k in own.tolist()], np.intp)[:, None] + np.arange(6)).ravel()
    rest = np.setdiff1d(np.arange(width), mine)
    inside, beside = H[mine][:, mine], H[mine][:, rest]
    scale = 1.0 / np.sqrt(np.maximum(H.diagonal()[rest], np.finfo(float).tiny))
    try:
        solver = splu((diags_array(scale) @ H[rest][:, rest] @ diags_array(scale)).tocsc()) if len(rest) else None
    except RuntimeError:
        raise GraphError("the measurements beside LiDAR do not determine each other") from None
    J = noise.into_body(poses[own])

    def product(changes: Floats) -> Floats:
        body = np.einsum("kij,kj->ki", J, changes[own]).ravel()
        force = inside @ body
        if solver is not None:
            force = force - beside @ (scale * solver.solve(scale * (beside.T @ body)))
        out = np.zeros((count, 6))
        out[own] = np.einsum("kji,kj->ki", J, force.reshape(-1, 6))
        return out

    blocks = np.zeros((count, 6, 6))
    at = np.arange(len(mine)).reshape(-1, 6)
    diagonal = np.stack([inside[i][:, i].toarray() for i in at]) if len(at) else np.zeros((0, 6, 6))
    blocks[own] = np.swapaxes(J, -1, -2) @ diagonal @ J
    return PosePrior(poses, product, blocks)
