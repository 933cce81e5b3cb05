"""Blocks of a covariance matrix from the Bayes net of its elimination (Kaess and Dellaert 2009).

An eliminated unknown is known from its parents, x = -R^-1 S x_P + noise of covariance R^-1 R^-T, and all the parents of one
belong to the first eliminated of them and its own parents. So with the last unknown first, each needs only what the one before
knows: no other block of the inverse is ever computed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from lslam.core.types.arrays import Floats


@dataclass(frozen=True)
class _Family:
    """An unknown and its parents: the rows of each in their joint covariance."""

    rows: dict[int, range]
    covariance: Floats


def selected_inverse(net: Any, wanted: Iterable[int]) -> Iterator[tuple[int, Floats]]:
    """Keys among `wanted` with their (d, d) covariances, in gtsam's order and axes; `net` is of one unknown per conditional."""
    conditionals = [net.at(i) for i in range(net.size())]
    keys = [conditional.keys() for conditional in conditionals]
    place = {own: i for i, (own, *_) in enumerate(keys)}
    chosen = set(wanted)
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


def _family(keys: list[int], above: _Family, own: Floats, cross: Floats, known: Floats) -> _Family:
    """An unknown of covariance `own` (d, d) with its parents of `known` (p, p), `cross` (d, p) between them."""
    begin = len(own)
    rows = {keys[0]: range(begin)}
    for key in keys[1:]:
        rows[key] = range(begin, begin + len(above.rows[key]))
        begin += len(above.rows[key])
    covariance = np.empty((begin, begin))
    covariance[: len(own), : len(own)] = own
    covariance[: len(own), len(own) :] = cross
    covariance[len(own) :, : len(own)] = cross.T
    covariance[len(own) :, len(own) :] = known
    return _Family(rows, covariance)


def _inverses(matrices: list[Floats]) -> list[Floats]:
    """Of square matrices of some sizes, all of one size at once."""
    sizes = np.array([len(matrix) for matrix in matrices])
    inverses = list(matrices)
    for size in np.unique(sizes):
        which = np.flatnonzero(sizes == size).tolist()
        for i, inverse in zip(which, np.linalg.inv(np.stack([matrices[i] for i in which])), strict=True):
            inverses[i] = inverse
    return inverses
