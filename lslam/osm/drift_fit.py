"""Likelihood of odometry's drift given sightings of a map's walls: one linear Gaussian model of all unknowns.

Each of the many sightings involves one keyframe and one wall, so only sums over these are formed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.graph.problem import PoseGraph

Floats = NDArray[np.float64]

# Degrees of freedom of the residuals (Student's t), against walls matched wrongly.
FREEDOM = 3.0


@dataclass(frozen=True)
class WallSightings:
    """Sightings of a map's walls, one row per wall and keyframe.

    keyframes, walls : (N,) numbers; normals : (N, 2) of the walls on the map
    places : (N, 2) m, the middle of what was seen, as the graph has it; offsets : (N,) m, along the normal, from the wall
    share : 0..1, weight of each, since those from neighbouring keyframes have correlated errors
    """

    keyframes: NDArray[np.int64]
    walls: NDArray[np.int64]
    normals: Floats
    places: Floats
    offsets: Floats
    share: float


@dataclass(frozen=True)
class Sizes:
    """Hyperparameters.

    noise : scale of the configured sigma of a sighting; root : (P, P) square root of the prior covariance of the rates
    """

    noise: float
    root: Floats


class DriftFit:
    """Start, shift of the map and rates at knots, given sightings; the error of each wall on the map is eliminated.

    effects : (K, 3, 5 + P) Jacobians of planar poses; taken : (P,) rates that the poses are corrected by already
    seen_sigma, map_sigma : m, of a sighting and of a wall of the map; given : (5,) m, rad, prior sigmas of start and shift
    """

    def __init__(
        self, graph: PoseGraph, seen: WallSightings, effects: Floats, taken: Floats, seen_sigma: float, map_sigma: float,
        given: Floats,
    ) -> None:  # fmt: skip
        about = seen.places - graph.poses[seen.keyframes, :2, 3]
        turned = seen.normals[:, 1] * about[:, 0] - seen.normals[:, 0] * about[:, 1]
        self._axes = np.column_stack([seen.normals, turned])
        self._keyframes, self._wall = seen.keyframes, np.unique(seen.walls, return_inverse=True)[1]
        self._effects, self._seen, self._map, self._given = effects, seen_sigma**2, map_sigma**2, given
        self._offsets = seen.offsets - self._along(np.append(np.zeros(len(given)), taken))
        self._rows = float(len(seen.walls))
        self._set_weights(np.ones(len(seen.walls)))

    def negative_log_likelihood(self, noise: float, root: Floats, sizes: tuple[float, ...]) -> Floats:
        """(len(sizes),) twice the negative log-likelihood, up to a constant, with `root` times each of `sizes`."""
        from scipy.linalg import cho_factor, cho_solve

        variance, n = noise**2 * self._seen, len(self._given)
        normal, pull, squared = self._reduced(variance)
        whole = self._root(root)
        system, right = whole.T @ normal @ whole, whole.T @ pull
        free = self._rows * np.log(variance) + np.log1p(self._map / variance * self._weight).sum() + squared
        found = []
        for size in sizes:
            scale = np.append(np.ones(n), np.full(len(root), size))
            factor = cho_factor(np.eye(len(system)) + scale[:, None] * system * scale, lower=True)
            gain = (scale * right) @ cho_solve(factor, scale * right)
            found.append(free + 2.0 * np.log(np.diag(factor[0])).sum() - gain)
        return np.array(found)

    def rates(self, sizes: Sizes) -> tuple[Floats, Floats]:
        """(P,) at the knots, three each, and their covariance (P, P)."""
        found, covariance = self._solved(sizes)
        n = len(self._given)
        return found[n:], covariance[n:, n:]

    def reweight(self, sizes: Sizes) -> None:
        """Reweight the sightings by Student's t of their residuals (IRLS)."""
        variance = sizes.noise**2 * self._seen
        away = self._offsets + self._along(self._solved(sizes)[0])
        pulls = np.bincount(self._wall, self._weights * away)
        away -= (pulls / (self._weight + variance / self._map))[self._wall]
        self._set_weights((FREEDOM + 1.0) / (FREEDOM + away**2 / variance))

    def count_less(self, share: float) -> None:
        """Scale the information of all sightings by `share`."""
        self._rows *= share
        self._set_weights(share * self._weights)

    def _along(self, unknown: Floats) -> Floats:
        """(N,) m by which `unknown` moves the sightings along the normals."""
        return np.asarray(np.einsum("ni,ni->n", self._axes, (self._effects @ unknown)[self._keyframes]))

    def _set_weights(self, weights: Floats) -> None:
        """Sums over the sightings of each keyframe and of each wall."""
        from scipy.sparse import csr_array

        count, width = len(self._effects), self._effects.shape[2]
        flat = self._effects.reshape(3 * count, width)
        self._weights, self._weight = weights, np.bincount(self._wall, weights)
        weighted = weights[:, None] * self._axes
        squares, pulls = np.zeros((count, 3, 3)), np.zeros((count, 3))
        np.add.at(squares, self._keyframes, weighted[:, :, None] * self._axes[:, None])
        np.add.at(pulls, self._keyframes, weighted * self._offsets[:, None])
        self._normal, self._pull = flat.T @ (squares @ self._effects).reshape(-1, width), flat.T @ pulls.ravel()
        self._squared = float(weights @ self._offsets**2)
        columns = 3 * self._keyframes[:, None] + np.arange(3)
        by_wall = csr_array(
            (weighted.ravel(), (np.repeat(self._wall, 3), columns.ravel())), (len(self._weight), 3 * count)
        )
        self._by_wall, self._wall_offsets = by_wall @ flat, np.bincount(self._wall, weights * self._offsets)
        self._known: dict[float, tuple[Floats, Floats, float]] = {}

    def _reduced(self, variance: float) -> tuple[Floats, Floats, float]:
        """Normal matrix, right side and squared length of the offsets, with the errors of the map eliminated."""
        if variance not in self._known:
            share = 1.0 / np.sqrt(self._weight + variance / self._map)
            walls, offsets = share[:, None] * self._by_wall, share * self._wall_offsets
            normal, pull = self._normal - walls.T @ walls, walls.T @ offsets - self._pull
            self._known[variance] = (
                normal / variance,
                pull / variance,
                (self._squared - float(offsets @ offsets)) / variance,
            )
        return self._known[variance]

    def _root(self, rates: Floats) -> Floats:
        n = len(self._given)
        whole = np.zeros((n + len(rates), n + len(rates)))
        whole[:n, :n], whole[n:, n:] = np.diag(self._given), rates
        return whole

    def _solved(self, sizes: Sizes) -> tuple[Floats, Floats]:
        """Posterior mean and covariance of the unknowns, without the inverse of the prior, which may be singular."""
        normal, pull, _ = self._reduced(sizes.noise**2 * self._seen)
        root = self._root(sizes.root)
        covariance = root @ np.linalg.solve(np.eye(len(root)) + root.T @ normal @ root, root.T)
        return np.asarray(covariance @ pull), np.asarray(covariance)
