"""Odometry that runs away steadily, as the buildings of a map reveal it, and that is set straight before the graph is solved.

What makes every scan wrong alike (a bent calibration, a wheel that slips) turns and shifts a trajectory at a rate that lasts.
A map has each wall wrong by far more than odometry errs from keyframe to keyframe, but wrong by the same from wherever it is
seen: that a wall moves while the run passes it tells a rate, whatever the map is worth, and a rate bends no step.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lslam.config.graph import GraphConfig
from lslam.geometry import se3, so3
from lslam.graph.chi_square import quantile
from lslam.graph.factors import PLANAR
from lslam.graph.problem import DriftClaim, PoseGraph

Floats = NDArray[np.float64]

# m over which a rate is about one and the same, and the share of its variance that is so for the whole run: a calibration.
MEMORY, LASTING = 100.0, 0.5
# Times the errors of what is seen, and times the drift, that the configuration believes in: the likeliest are taken. From far
# and at a grazing angle a wall is seen elsewhere than from near, by some centimetres for many keyframes: none is seen better.
SCALES, SIZES = (0.25, 0.5, 1.0), (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
ROUNDS = 6
SETTLED = 0.1  # of the squared length that chance would give rates
# Degrees of freedom of what is seen (Student's t): among many walls some are taken for others.
FREEDOM = 3.0


@dataclass(frozen=True)
class WallSightings:
    """Walls of a map that were seen, one row per wall and keyframe.

    keyframes, walls : (N,) numbers; normals : (N, 2) of the walls on the map
    places : (N, 2) m, the middle of what was seen, as the graph has it; offsets : (N,) m, along the normal, from the wall
    share : 0..1, what each counts: those from neighbouring keyframes are of the same scans and make the same error
    """

    keyframes: NDArray[np.int64]
    walls: NDArray[np.int64]
    normals: Floats
    places: Floats
    offsets: Floats
    share: float


@dataclass(frozen=True)
class SteadyDrift:
    """What odometry has to be set right by.

    rates : (K-1, 3) per m of the way from each keyframe to the next: m along x and y of the world, rad of heading
    spread : (K, 6, 6) by how much each pose is unsure for that the rates are, as the covariances of `Solution`
    claim : the drift that these rates take out
    is_settled : the rates are well below what they are unsure by
    """

    rates: Floats
    spread: Floats
    claim: DriftClaim
    is_settled: bool

    @property
    def is_sure(self) -> bool:
        """Whether chance does not explain as much."""
        return self.claim.gain > self.claim.chance


def find_steady_drift(
    graph: PoseGraph, seen: WallSightings, seen_sigma: float, map_sigma: float, config: GraphConfig
) -> SteadyDrift | None:
    """The rates at which odometry has to be set right to see walls stand still; None where nothing tells any.

    Rates at knots along the way and the errors of what is seen are random, of sizes that are unknown: each is given that with
    which what was seen is likeliest (empirical Bayes), and drift is what this is likelier with than chance would have it.

    graph : in the frame of the map, held by `start_sigma`, with `distances`
    seen_sigma, map_sigma : m, of a wall that is seen, and of one of the map beside the shift of the whole
    """
    if not len(seen.walls) or graph.start_sigma is None or graph.distances[-1] <= 0:
        return None
    effects = _effects(graph)
    given = np.append(graph.start_sigma, np.full(2, graph.shift_sigma)) ** 2
    fit = _Fit(seen, _rows(graph, seen, effects), seen_sigma, map_sigma, given, _belief(graph.distances[-1], config))
    scale, size = fit.likeliest()
    for _ in range(ROUNDS):
        fit.doubt(scale, size)
        scale, size = fit.likeliest()
    found, _ = fit.rates(scale, size)
    # What is found is the same when less of it counts, and not how sure it is.
    fit.count_less(seen.share)
    _, covariance = fit.rates(scale, size)
    gain = min(fit.unlikeliness(s, 0.0) for s in SCALES) - fit.unlikeliness(scale, size)
    hats, share = _hats(graph.distances), np.diff(graph.distances) / np.ptp(graph.distances)
    rates = hats @ found.reshape(-1, 3)
    mean = np.kron(share @ hats, np.eye(3))
    sigma = np.sqrt(np.diag(mean @ covariance @ mean.T))
    moves = effects[:, :, 5:]
    spread = np.zeros((len(graph), 6, 6))
    spread[:, np.array(PLANAR)[:, None], PLANAR] = moves @ covariance @ np.swapaxes(moves, -1, -2)
    return SteadyDrift(
        np.asarray(rates), spread,
        DriftClaim(-(mean @ found), sigma, gain, quantile(config.probability, fit.count)),
        is_settled=float(found @ np.linalg.solve(covariance, found)) <= SETTLED * fit.count,
    )  # fmt: skip


class _Fit:
    """Start and shift of the map with variances `given` (5,), rates with the covariance `believed` (P, P), on what was seen.

    rows (N, 5 + P) : what they do to the offsets. What each wall is off by on the map is eliminated.
    """

    def __init__(
        self, seen: WallSightings, rows: Floats, seen_sigma: float, map_sigma: float, given: Floats, believed: Floats
    ) -> None:
        self.count = len(believed)
        self._wall = np.unique(seen.walls, return_inverse=True)[1]
        self._columns = np.column_stack([rows, seen.offsets])
        self._seen, self._map, self._given, self._believed = seen_sigma**2, map_sigma**2, given, believed
        self._rows = float(len(rows))
        self._believe(np.ones(len(rows)))

    def likeliest(self) -> tuple[float, float]:
        """The scale and size with which what was seen is likeliest."""
        return min(((scale, size) for scale in SCALES for size in SIZES), key=lambda chosen: self.unlikeliness(*chosen))

    def unlikeliness(self, scale: float, size: float) -> float:
        """Minus twice the logarithm of the likelihood, but for a constant, with noise and rates so many times as large."""
        noise, prior = scale**2 * self._seen, self._prior(size)
        normal, pull, squared = self._reduced(noise)
        system = np.eye(len(normal)) + prior @ normal
        found = np.linalg.solve(system, prior @ pull)
        spread = np.linalg.slogdet(system)[1] + np.log1p(self._map / noise * self._weight).sum()
        return float(self._rows * np.log(noise) + spread + squared - pull @ found)

    def rates(self, scale: float, size: float) -> tuple[Floats, Floats]:
        """(P,) at the knots, three each, and their covariance (P, P)."""
        found, covariance = self._solved(scale, size)
        n = len(self._given)
        return found[n:], covariance[n:, n:]

    def doubt(self, scale: float, size: float) -> None:
        """Believe what lies far from where all the rest has it less."""
        noise = scale**2 * self._seen
        away = self._columns @ np.append(self._solved(scale, size)[0], 1.0)
        pulls = np.bincount(self._wall, self._weights * away)
        away -= (pulls / (self._weight + noise / self._map))[self._wall]
        self._believe((FREEDOM + 1.0) / (FREEDOM + away**2 / noise))

    def count_less(self, share: float) -> None:
        """Take only so much of what was seen as new."""
        self._rows *= share
        self._believe(share * self._weights)

    def _believe(self, weights: Floats) -> None:
        self._weights, self._weight = weights, np.bincount(self._wall, weights)
        weighted = weights[:, None] * self._columns
        self._whole = self._columns.T @ weighted
        self._by_wall = np.zeros((len(self._weight), self._columns.shape[1]))
        np.add.at(self._by_wall, self._wall, weighted)

    def _reduced(self, noise: float) -> tuple[Floats, Floats, float]:
        """Normal matrix, right side and squared length of the offsets, with the errors of the map eliminated."""
        shares = self._by_wall / (self._weight + noise / self._map)[:, None]
        whole = (self._whole - self._by_wall.T @ shares) / noise
        return whole[:-1, :-1], -whole[:-1, -1], float(whole[-1, -1])

    def _prior(self, size: float) -> Floats:
        n = len(self._given)
        prior = np.zeros((n + self.count, n + self.count))
        prior[:n, :n], prior[n:, n:] = np.diag(self._given), size**2 * self._believed
        return prior

    def _solved(self, scale: float, size: float) -> tuple[Floats, Floats]:
        """What all that is unknown is found to be, and its covariance; not by the inverse of the prior, which may be none."""
        prior, (normal, pull, _) = self._prior(size), self._reduced(scale**2 * self._seen)
        covariance = np.linalg.solve(np.eye(len(normal)) + prior @ normal, prior)
        return np.asarray(covariance @ pull), np.asarray(covariance)


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


def _rows(graph: PoseGraph, seen: WallSightings, effects: Floats) -> Floats:
    """(N, 5 + 3 n) what start, shift and rates do to the offsets of what was seen."""
    about = seen.places - graph.poses[seen.keyframes, :2, 3]
    axes = np.column_stack([seen.normals, np.einsum("ni,ni->n", seen.normals, _across(about))])
    # One by one: all effects of all sightings at once would be three times what comes of them.
    return np.stack([axis @ effects[k] for axis, k in zip(axes, seen.keyframes, strict=True)])


def _effects(graph: PoseGraph) -> Floats:
    """(K, 3, 5 + 3 n) what start, shift of the map, and rates at the knots do to planar poses, as seen from the map."""
    place, way = graph.poses[:, :2, 3], np.diff(graph.distances)
    middle, hats = 0.5 * (place[1:] + place[:-1]), _hats(graph.distances)
    start, rates = np.zeros((len(place), 3, 5)), np.zeros((len(place), 3, hats.shape[1], 3))
    for k in range(len(place)):
        start[k, :2, 2] = _across(place[k] - place[0])
        start[k, :, :3] += np.eye(3)
        start[k, :2, 3:] = -np.eye(2)
        passed = hats[:k] * way[:k, None]
        rates[k] = np.eye(3)[:, None] * passed.sum(axis=0)[:, None]
        rates[k, :2, :, 2] = _across(place[k] - middle[:k]).T @ passed
    return np.concatenate([start, rates.reshape(len(place), 3, -1)], axis=2)


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
    alike = LASTING + (1.0 - LASTING) * np.exp(-0.5 * ((knots[:, None] - knots) / MEMORY) ** 2)
    percent, turn = 0.01 * config.drift_percent, np.radians(config.drift_deg_per_100m) / 100
    return np.asarray(np.kron(alike, np.diag(np.array([percent, percent, turn]) ** 2)), np.float64)
