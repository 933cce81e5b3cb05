"""Odometry that runs away steadily, as the buildings of a map reveal it, and that is set straight before the graph is solved.

What makes every scan wrong alike (a bent calibration, a wheel that slips) turns and shifts a trajectory at a rate that lasts.
The map errs about each place by far more than odometry does from keyframe to keyframe: a walk that may follow the one follows
the other too, at the cost of every step, while a rate is told by all keyframes together and bends no step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lslam.config.graph import GraphConfig
from lslam.geometry import se2, se3, so3
from lslam.graph.chi_square import quantile
from lslam.graph.problem import PlanarPrior, PoseGraph

Floats = NDArray[np.float64]

# m over which a rate is about one and the same, and planar priors that are asked, evenly spread.
MEMORY, MOST = 100.0, 100
# Times the drift, and times the errors of the map, that the configuration believes in: those are taken that are likeliest.
SIZES, SCALES = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0), (0.25, 0.5, 1.0, 2.0)
# Directions with less than this share of the largest information are free.
FREE = 1e-9


def find_steady_drift(
    graph: PoseGraph, shared: NDArray[np.float64], map_sigma: NDArray[np.float64], config: GraphConfig
) -> Floats | None:
    """The rates at which odometry has to be set right to lie on the map; None when chance explains the map as well.

    Rates at knots along the way and the errors of the map are both random, of sizes that are unknown: each is given that with
    which what was seen is likeliest (empirical Bayes), and drift is what the map is likelier with than chance would have it.

    graph : in the frame of the map, held by `start_sigma`, with `distances`
    shared : (M, M) 0..1, how much two of its planar priors look at the same part of the map, so that they err alike
    map_sigma : (3,) m, m, rad, of what stands about one place of the map

    Returns (K-1, 3) per m of the way from each keyframe to the next: m along x and y of the world, rad of heading.
    """
    chosen = np.unique(np.linspace(0, len(graph.map_priors) - 1, MOST).round().astype(int))
    priors = [graph.map_priors[i] for i in chosen]
    if len(priors) < 2 or graph.start_sigma is None or graph.distances[-1] <= 0:
        return None
    error, noise = _seen(graph, priors, shared[np.ix_(chosen, chosen)], map_sigma)
    effects = _rows(_directions(priors), _effects(graph, [p.keyframe for p in priors]))
    given = np.append(graph.start_sigma, np.full(2, graph.shift_sigma)) ** 2
    fit = _Fit(error, noise, effects, given, _belief(graph.distances[-1], config))
    steady, scale, size = min((fit.unlikeliness(scale, size), scale, size) for scale in SCALES for size in SIZES)
    if min(fit.unlikeliness(scale, 0.0) for scale in SCALES) - steady <= quantile(config.probability, fit.count):
        return None
    return np.asarray(_hats(graph.distances) @ fit.rates(scale, size))


class _Fit:
    """Start and map with variances `given` (5,), and rates with the covariance `believed` (P, P), on what was seen.

    error (N,) with the covariance `noise` (N, N) comes of them by `effects` (N, 5 + P). All is brought to noise of unit size
    once, so that other sizes of noise and rates cost next to nothing.
    """

    def __init__(self, error: Floats, noise: Floats, effects: Floats, given: Floats, believed: Floats) -> None:
        self.count = len(believed)
        whitened = np.linalg.solve(np.linalg.cholesky(noise), np.column_stack([effects, error]))
        self._rows, self._squared = len(error), float(whitened[:, -1] @ whitened[:, -1])
        self._normal, self._pull = whitened[:, :-1].T @ whitened[:, :-1], whitened[:, :-1].T @ whitened[:, -1]
        self._given, self._believed = given, believed

    def unlikeliness(self, scale: float, size: float) -> float:
        """Minus twice the logarithm of the likelihood, but for a constant, with noise and rates so many times as large."""
        prior, found = self._solved(scale, size)
        spread = np.linalg.slogdet(np.eye(len(prior)) + prior @ self._normal / scale**2)[1]
        rest = (self._squared - self._pull @ found) / scale**2
        return float(2 * self._rows * np.log(scale) + spread + rest)

    def rates(self, scale: float, size: float) -> Floats:
        """(P / 3, 3) at the knots."""
        return self._solved(scale, size)[1][len(self._given) :].reshape(-1, 3)

    def _solved(self, scale: float, size: float) -> tuple[Floats, Floats]:
        """The covariance of everything unknown, and what it is found to be."""
        n = len(self._given)
        prior = np.zeros((n + self.count, n + self.count))
        prior[:n, :n], prior[n:, n:] = np.diag(self._given), size**2 * self._believed
        # Not by the inverse of the prior: without rates there is none.
        found = np.linalg.solve(scale**2 * np.eye(len(prior)) + prior @ self._normal, prior @ self._pull)
        return prior, np.asarray(found)


def without_drift(graph: PoseGraph, rates: NDArray[np.float64]) -> PoseGraph:
    """The graph with poses and odometry set right by `rates` of `find_steady_drift`."""
    steps = se3.relative(graph.poses[:-1], graph.poses[1:])
    poses = [graph.poses[0]]
    for step, way, rate in zip(steps, np.diff(graph.distances), rates, strict=True):
        pose = poses[-1] @ step
        pose[:3, :3] = so3.exp(np.array([0.0, 0.0, rate[2] * way])) @ pose[:3, :3]
        pose[:2, 3] += rate[:2] * way
        poses.append(pose)
    moved = se3.normalise(np.stack(poses))
    odometry = [
        replace(
            c, T_a_b=se3.relative(moved[c.a], graph.poses[c.a] @ c.T_a_b @ se3.relative(graph.poses[c.b], moved[c.b]))
        )
        for c in graph.odometry
    ]
    return replace(graph, poses=moved, odometry=odometry)


def _directions(priors: Sequence[PlanarPrior]) -> list[Floats]:
    """Per prior (rank, 3), what it fixes."""
    found = []
    for prior in priors:
        values, axes = np.linalg.eigh(prior.information)
        found.append(axes[:, values > FREE * values[-1]].T)
    return found


def _rows(directions: list[Floats], blocks: Floats) -> Floats:
    """(N, P) of (M, 3, P): only what the priors fix."""
    return np.concatenate([axes @ block for axes, block in zip(directions, blocks, strict=True)])


def _seen(graph: PoseGraph, priors: list[PlanarPrior], shared: Floats, map_sigma: Floats) -> tuple[Floats, Floats]:
    """(N,) how far each prior lies from odometry along what it fixes, and the covariance (N, N) of that."""
    directions = _directions(priors)
    away = np.stack([p.pose for p in priors]) - se2.of_se3(graph.poses[[p.keyframe for p in priors]])
    away[:, 2] = se2.wrapped(away[:, 2])
    owners = np.repeat(np.arange(len(priors)), [len(axes) for axes in directions])
    H = np.concatenate(directions)
    own = np.concatenate(
        [1.0 / np.einsum("ri,ij,rj->r", axes, p.information, axes) for axes, p in zip(directions, priors, strict=True)]
    )
    together = (H * map_sigma**2) @ H.T * shared[np.ix_(owners, owners)]
    return np.einsum("ni,ni->n", H, away[owners]), together + np.diag(own)


def _effects(graph: PoseGraph, keyframes: list[int]) -> Floats:
    """(M, 3, 5 + 3 n) what start, shift of the map, and rates at the knots do to the planar poses of `keyframes`."""
    place, way = graph.poses[:, :2, 3], np.diff(graph.distances)
    middle, hats = 0.5 * (place[1:] + place[:-1]), _hats(graph.distances)
    start, rates = np.zeros((len(keyframes), 3, 5)), np.zeros((len(keyframes), 3, hats.shape[1], 3))
    for row, k in enumerate(keyframes):
        start[row, :2, 2] = _across(place[k] - place[0])
        start[row, :, :3] += np.eye(3)
        start[row, :2, 3:] = -np.eye(2)
        passed = hats[:k] * way[:k, None]
        rates[row] = np.eye(3)[:, None] * passed.sum(axis=0)[:, None]
        rates[row, :2, :, 2] = _across(place[k] - middle[:k]).T @ passed
    return np.concatenate([start, rates.reshape(len(keyframes), 3, -1)], axis=2)


def _across(away: Floats) -> Floats:
    """Where a small turn moves what lies `away` (..., 2), per rad."""
    return np.stack([-away[..., 1], away[..., 0]], axis=-1)


def _knots(length: float) -> Floats:
    return np.linspace(0.0, length, int(np.ceil(length / MEMORY)) + 1)


def _hats(distances: Floats) -> Floats:
    """(K-1, n) how much each knot counts halfway between two keyframes."""
    middle, knots = 0.5 * (distances[1:] + distances[:-1]), _knots(distances[-1])
    return np.column_stack([np.interp(middle, knots, unit) for unit in np.eye(len(knots))])


def _belief(length: float, config: GraphConfig) -> Floats:
    """(3 n, 3 n) covariance of the rates at the knots before the map is asked."""
    knots = _knots(length)
    alike = np.exp(-0.5 * ((knots[:, None] - knots) / MEMORY) ** 2)
    percent, turn = 0.01 * config.drift_percent, np.radians(config.drift_deg_per_100m) / 100
    return np.asarray(np.kron(alike, np.diag(np.array([percent, percent, turn]) ** 2)), np.float64)
