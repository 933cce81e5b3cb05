"""Information about the poses of a solved graph: their marginal covariances, and what all but LiDAR tells of them.

Blocks of a covariance matrix come from the Bayes net of its elimination (Kaess and Dellaert 2009). An eliminated unknown is
known from its parents, x = -R^-1 S x_P + noise of covariance R^-1 R^-T, and all the parents of one belong to the first
eliminated of them and its own parents. So with the last unknown first, each needs only what the one before knows: no other
block of the inverse is ever computed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.errors import GraphError
from lslam.core.geometry import noise, se3
from lslam.core.stopping import checking


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
    """Information of gtsam's `factors` about the poses with keys 0..count-1, linearised at `values`, other unknowns eliminated.

    Raises GraphError where the factors do not determine the other unknowns.
    """
    poses = se3.normalise(np.stack([values.atPose3(k).matrix() for k in range(count)]))
    H, begins = _normal_matrix(
        factors, values, {int(key) for i in range(factors.size()) for key in list(factors.at(i).keys())}
    )
    own = np.array([k for k in range(count) if k in begins], np.intp)
    mine = (np.array([begins[k] for k in own.tolist()], np.intp)[:, None] + np.arange(6)).ravel()
    rest = np.setdiff1d(np.arange(H.shape[0]), mine)
    inside, beside = H[mine][:, mine], H[mine][:, rest]
    try:
        solve = _scaled_solver(H[rest][:, rest]) if len(rest) else None
    except RuntimeError:
        raise GraphError("the measurements beside LiDAR do not determine each other") from None
    J = noise.into_body(poses[own])

    def product(changes: Floats) -> Floats:
        body = np.einsum("kij,kj->ki", J, changes[own]).ravel()
        force = inside @ body
        if solve is not None:
            force = force - beside @ solve(beside.T @ body)
        out = np.zeros((count, 6))
        out[own] = np.einsum("kji,kj->ki", J, force.reshape(-1, 6))
        return out

    blocks = np.zeros((count, 6, 6))
    at = np.arange(len(mine)).reshape(-1, 6)
    diagonal = np.stack([inside[i][:, i].toarray() for i in at]) if len(at) else np.zeros((0, 6, 6))
    blocks[own] = np.swapaxes(J, -1, -2) @ diagonal @ J
    return PosePrior(poses, product, blocks)


def marginals(factors: Any, values: Any, poses: Floats) -> Floats:
    """(K, 6, 6) covariances of the poses with the keys 0..K-1, t' = t + d[:3], R' = exp(d[3:]) R in world axes, m2 and rad2.

    Raises GraphError when the graph is singular.
    """
    bodies = marginal_blocks(factors, values, range(len(poses)))
    world = noise.from_body(bodies, poses)
    # d of this house is in the parent's axes: the world's.
    return 0.5 * (world + np.swapaxes(world, -1, -2))


def marginal_blocks(factors: Any, values: Any, keys: Iterable[int]) -> Floats:
    """(K, 6, 6) covariances of poses, gtsam's order (rotation first), body axes. Raises GraphError for a singular graph."""
    import gtsam

    needed = list(keys)
    try:
        net = factors.linearize(values).eliminateSequential(gtsam.Ordering.OrderingType.COLAMD)
        blocks = dict(checking(selected_inverse(net, needed)))
        return np.stack([blocks[key] for key in needed])
    except RuntimeError:
        # It gives up where neighbouring unknowns are known very differently well, as the roll of a straight path is.
        return scaled_blocks(factors, values, needed)


def scaled_blocks(factors: Any, values: Any, keys: list[int]) -> Floats:
    """(K, 6, 6) covariances of the poses with these keys, like `marginal_blocks`, by normal equations of scaled unknowns.

    The scaling keeps precision where variances differ by many orders. Raises GraphError when the graph is singular.
    """
    H, begins = _normal_matrix(factors, values, map(int, values.dims()))
    try:
        solve = _scaled_solver(H)
    except RuntimeError as failure:
        raise GraphError(f"the pose graph has no covariances: {first_line(failure)}") from None
    blocks = []
    for key in checking(keys):
        own = slice(begins[key], begins[key] + 6)
        units = np.zeros((H.shape[0], 6))
        units[own] = np.eye(6)
        blocks.append(solve(units)[own])
    return np.stack(blocks)


def _normal_matrix(factors: Any, values: Any, keys: Iterable[int]) -> tuple[Any, dict[int, int]]:
    """Sparse normal matrix of the factors at `values`, of the unknowns with these keys in order, and where each begins."""
    from scipy.sparse import csc_array

    sizes, begins, width = dict(values.dims().items()), dict[int, int](), 0
    for key in sorted(keys):
        begins[key], width = width, width + sizes[key]
    rows, cols, entries = factors.linearize(values).sparseJacobian_()
    A = csc_array((entries, (rows.astype(np.intp) - 1, cols.astype(np.intp) - 1)))[:, :width]
    return (A.T @ A).tocsc(), begins


def _scaled_solver(H: Any) -> Callable[[Floats], Floats]:
    """Solver of the sparse normal equations `H` (N, N), scaled to a unit diagonal. Raises RuntimeError where H is singular."""
    from scipy.sparse import diags_array
    from scipy.sparse.linalg import splu

    scale = 1.0 / np.sqrt(np.maximum(H.diagonal(), np.finfo(float).tiny))
    factor = splu((diags_array(scale) @ H @ diags_array(scale)).tocsc())
    return lambda right: np.asarray((scale * factor.solve((scale * right.T).T).T).T)


def first_line(failure: RuntimeError) -> str:
    """The first line of gtsam's message, or the kind of the failure."""
    text = str(failure).strip()
    return text.splitlines()[0] if text else type(failure).__name__


@dataclass(frozen=True)
class _Family:
    """An unknown and its parents: the rows of each in their joint covariance."""

    rows: dict[int, range]
    covariance: Floats


def selected_inverse(net: Any, targets: Iterable[int]) -> Iterator[tuple[int, Floats]]:
    """Keys among `targets` with their (d, d) covariances, in gtsam's order and axes; `net` is of one unknown per conditional."""
    conditionals = [net.at(i) for i in range(net.size())]
    keys = [conditional.keys() for conditional in conditionals]
    place = {own: i for i, (own, *_) in enumerate(keys)}
    chosen = set(targets)
    is_needed = [own in chosen for own, *_ in keys]
    below: list[list[int]] = [[] for _ in keys]
    todo: list[tuple[int, _Family]] = []
    for i, (_, *parents) in enumerate(keys):  # parents come after
        if is_needed[i] and parents:
            first = min([place[key] for key in parents])
            is_needed[first] = True
            below[first].append(i)
        elif is_needed[i]:
            todo.append((i, _Family({}, np.zeros((0, 0)))))
    roots = _inverses([conditional.R() for conditional in conditionals])
    # Depth first, so that few families are held at a time.
    while todo:
        i, above = todo.pop()
        own, *parents = keys[i]
        index = np.array([row for key in parents for row in above.rows[key]], np.intp)
        root, known = roots[i], above.covariance[index[:, None], index]
        gain = root @ conditionals[i].S() if parents else np.zeros((len(root), 0))
        cross = -gain @ known
        covariance = root @ root.T - cross @ gain.T
        if below[i]:
            family = _family(keys[i], above, covariance, cross, known)
            todo.extend((child, family) for child in below[i])
        if own in chosen:
            yield own, covariance


def _family(keys: list[int], above: _Family, own: Floats, cross: Floats, parents: Floats) -> _Family:
    """Family of an unknown and its parents (`keys`, its own first); covariances own (d, d), parents (p, p), cross (d, p)."""
    begin = len(own)
    rows = {keys[0]: range(begin)}
    for key in keys[1:]:
        rows[key] = range(begin, begin + len(above.rows[key]))
        begin += len(above.rows[key])
    covariance = np.empty((begin, begin))
    covariance[: len(own), : len(own)] = own
    covariance[: len(own), len(own) :] = cross
    covariance[len(own) :, : len(own)] = cross.T
    covariance[len(own) :, len(own) :] = parents
    return _Family(rows, covariance)


def _inverses(matrices: list[Floats]) -> list[Floats]:
    """Inverses of square matrices of different sizes, in their order; all of one size are inverted at once."""
    sizes = np.array([len(matrix) for matrix in matrices])
    inverses = list(matrices)
    for size in np.unique(sizes):
        which = np.flatnonzero(sizes == size).tolist()
        for i, inverse in zip(which, np.linalg.inv(np.stack([matrices[i] for i in which])), strict=True):
            inverses[i] = inverse
    return inverses
