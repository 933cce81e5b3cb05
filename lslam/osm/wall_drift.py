"""Drift of odometry, estimated from sightings of a map's walls and corrected before the graph is solved.

Systematic errors (calibration, slip) rotate and shift a trajectory at a constant rate; other errors outside the covariances give
a varying rate. Model selection is by likelihood: constant rates fit a varying drift badly, and would extrapolate it where no
wall is seen.
The error of a wall on the map is far larger than that of odometry between keyframes, but it is the same in all sightings. So the
apparent motion of a wall, while the sensor passes it, observes a rate independently of the map's accuracy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lslam.backend.graph.drift import MEMORY_M, SIZES, correct_drift, linear_basis, mean_rates, rate_roots, walk_root
from lslam.backend.graph.factors import PLANAR
from lslam.backend.graph.problem import EstimatedDrift, PoseGraph
from lslam.core.arrays import Floats, Longs
from lslam.core.config.backend import GraphConfig
from lslam.core.geometry.noise import RIGHT_PROBABILITY, quantile
from lslam.core.stopping import checking

# Degrees of freedom of the residuals (Student's t), against walls matched wrongly.
FREEDOM = 3.0
# Scales of the configured sigma of a sighting that are compared. Sightings at long range and grazing angles have errors of
# centimetres that are correlated over many keyframes, so that smaller sigmas are excluded.
SCALES = (0.25, 0.5, 1.0)
# Level of significance for a larger constant share, which extrapolates farther where no wall is seen.
SELDOM = 0.95
# Hyperparameters of drift, degrees of freedom of the likelihood ratio test: scale and constant share. Rates are marginalised.
DRIFT_PARAMETERS = 2
REWEIGHTINGS = 6
# m between knots of varying rates, and the largest number of knots.
KNOTS_APART_M, MOST = 20.0, 40
MOST_CHANGE_SHARE = 0.1  # of the expected squared Mahalanobis length of the rates


@dataclass(frozen=True)
class WallSightings:
    """Sightings of a map's walls, one row per wall and keyframe.

    keyframes, walls : (N,) numbers; normals : (N, 2) of the walls on the map
    places : (N, 2) m, middle of each sighting with the keyframes at the poses of the graph, map frame
    offsets : (N,) m, distance of the sighting from the wall along the normal
    share : 0..1, weight of a sighting, since errors of neighbouring keyframes are correlated
    """

    keyframes: Longs
    walls: Longs
    normals: Floats
    places: Floats
    offsets: Floats
    share: float


@dataclass(frozen=True)
class Sizes:
    """Hyperparameters: noise : scale of the configured sigma; root : (P, P) square root of the rates' prior covariance."""

    noise: float
    root: Floats


class DriftFit:
    """Least squares for start, shift of the map and drift rates at knots; the error of each wall of the map is marginalised.

    effects : (K, 3, 5 + P) Jacobians of the planar poses; rates_before : (P,) rates that the poses are corrected by already
    seen_sigma, map_sigma : m, of a sighting and of a wall on the map; prior_sigmas : (5,) m, rad, of start and shift
    """

    def __init__(
        self,
        graph: PoseGraph,
        sightings: WallSightings,
        effects: Floats,
        rates_before: Floats,
        seen_sigma: float,
        map_sigma: float,
        prior_sigmas: Floats,
    ) -> None:
        about = sightings.places - graph.poses[sightings.keyframes, :2, 3]
        turned = sightings.normals[:, 1] * about[:, 0] - sightings.normals[:, 0] * about[:, 1]
        self._axes = np.column_stack([sightings.normals, turned])
        self._keyframes, self._wall = sightings.keyframes, np.unique(sightings.walls, return_inverse=True)[1]
        self._effects, self._seen, self._map, self._given = effects, seen_sigma**2, map_sigma**2, prior_sigmas
        self._offsets = sightings.offsets - self._along(np.append(np.zeros(len(prior_sigmas)), rates_before))
        self._rows = float(len(sightings.walls))
        self._set_weights(np.ones(len(sightings.walls)))

    def negative_log_likelihood(self, noise: float, root: Floats, sizes: tuple[float, ...]) -> Floats:
        """Twice the negative log-likelihood (len(sizes),), up to a constant, for `root` times each of `sizes`.

        noise, root : as in `Sizes`
        """
        from scipy.linalg import cho_factor, cho_solve

        variance, n = noise**2 * self._seen, len(self._given)
        normal, pull, squared = self._without_walls(variance)
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
        """Rates (P,) at the knots, three each, and their covariance (P, P)."""
        found, covariance = self._solve(sizes)
        n = len(self._given)
        return found[n:], covariance[n:, n:]

    def reweight(self, sizes: Sizes) -> None:
        """Reweight the sightings by Student's t of their residuals (IRLS)."""
        variance = sizes.noise**2 * self._seen
        away = self._offsets + self._along(self._solve(sizes)[0])
        pulls = np.bincount(self._wall, self._weights * away)
        away -= (pulls / (self._weight + variance / self._map))[self._wall]
        self._set_weights((FREEDOM + 1.0) / (FREEDOM + away**2 / variance))

    def count_less(self, share: float) -> None:
        """Scale the information of all sightings by `share`."""
        self._rows *= share
        self._set_weights(share * self._weights)

    def _along(self, unknown: Floats) -> Floats:
        """Displacement (N,), m, of the sightings along the normals, by the parameters `unknown` (5 + P,)."""
        return np.asarray(np.einsum("ni,ni->n", self._axes, (self._effects @ unknown)[self._keyframes]))

    def _set_weights(self, weights: Floats) -> None:
        """Normal equations with `weights` (N,): sums over the sightings of each keyframe and of each wall."""
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

    def _without_walls(self, variance: float) -> tuple[Floats, Floats, float]:
        """Normal matrix, right side and squared norm of the offsets, with the errors of the walls marginalised."""
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
        """Square root of the prior covariance of all parameters: of start and shift, and `rates` (P, P) of the rates."""
        n = len(self._given)
        whole = np.zeros((n + len(rates), n + len(rates)))
        whole[:n, :n], whole[n:, n:] = np.diag(self._given), rates
        return whole

    def _solve(self, sizes: Sizes) -> tuple[Floats, Floats]:
        """Posterior mean and covariance of the parameters, without the inverse of the prior, which may be singular."""
        normal, pull, _ = self._without_walls(sizes.noise**2 * self._seen)
        root = self._root(sizes.root)
        covariance = root @ np.linalg.solve(np.eye(len(root)) + root.T @ normal @ root, root.T)
        return np.asarray(covariance @ pull), np.asarray(covariance)


@dataclass(frozen=True)
class WallDrift:
    """Correction of odometry by constant or varying rates of drift.

    knots : (n, 3) total rates at knots along the distance travelled
    rates : (K-1, 3) per m from each keyframe to the next: m along x and y of the world, rad of heading; in addition to those
        of earlier iterations
    spread : (K, 6, 6) covariance of the poses due to that of the rates, as the covariances of `Solution`
    estimated_drift : the total drift
    is_final : whether the iteration has converged: the additional rates are well below their sigmas
    """

    knots: Floats
    rates: Floats
    spread: Floats
    estimated_drift: EstimatedDrift
    is_final: bool

    @property
    def is_sure(self) -> bool:
        """Whether the likelihood ratio test rejects the null hypothesis of no drift."""
        return self.estimated_drift.gain > self.estimated_drift.chance


def find_wall_drift(
    graph: PoseGraph,
    sightings: WallSightings,
    seen_sigma: float,
    map_sigma: float,
    config: GraphConfig,
    before: WallDrift | None = None,
) -> WallDrift | None:
    """The rates of drift for which the sightings of each wall agree; None without sightings.

    Rates at knots and errors of sightings are random, with hyperparameters that maximise the marginal likelihood (empirical
    Bayes). A likelihood ratio test decides whether there is drift, and the likelihood whether it is constant or varying.

    graph : in the frame of the map, with a prior `start_sigma` on the first pose, and with `distances`
    seen_sigma, map_sigma : m, of a sighting, and of a wall of the map beside the common shift
    before : the correction applied already; the prior is on the total drift
    """
    if not len(sightings.walls) or graph.start_sigma is None or graph.distances[-1] <= 0:
        return None

    def fit_rates(is_varying: bool) -> WallDrift:
        return _fit_rates(graph, sightings, (seen_sigma, map_sigma), config, before, is_varying)

    if before is not None:
        return fit_rates(before.estimated_drift.is_varying)
    constant, varying = fit_rates(is_varying=False), fit_rates(is_varying=True)
    return varying if varying.is_sure and varying.estimated_drift.gain > constant.estimated_drift.gain else constant


def _fit_rates(
    graph: PoseGraph,
    sightings: WallSightings,
    sigmas: tuple[float, float],
    config: GraphConfig,
    before: WallDrift | None,
    is_varying: bool,
) -> WallDrift:
    """`find_wall_drift` beyond the drift `before`, at knots if `is_varying`, else constant; sigmas : seen_sigma, map_sigma, m."""
    assert graph.start_sigma is not None
    length = float(graph.distances[-1])
    apart = min(max(KNOTS_APART_M, length / MOST), MEMORY_M) if is_varying else MEMORY_M
    at_knots = linear_basis(graph.distances, apart)
    effects = _effects(graph, at_knots)
    taken = np.zeros(3 * at_knots.shape[1]) if before is None else before.knots.ravel()
    fit = DriftFit(graph, sightings, effects, taken, *sigmas, np.append(graph.start_sigma, [graph.shift_sigma] * 2))
    roots = [walk_root(length, config, PLANAR, apart)] if is_varying else rate_roots(length, config, PLANAR)
    sizes = _likeliest(fit, roots)
    for _ in range(REWEIGHTINGS):
        fit.reweight(sizes)
        sizes = _likeliest(fit, roots)
    found, _ = fit.rates(sizes)
    # The correlation of sightings is in the covariance alone, not in the estimate.
    fit.count_less(sightings.share)
    _, covariance = fit.rates(sizes)
    without = min(float(fit.negative_log_likelihood(noise, sizes.root, (0.0,))[0]) for noise in SCALES)
    gain = without - float(fit.negative_log_likelihood(sizes.noise, sizes.root, (1.0,))[0])
    new = found - taken
    mean, sigma = mean_rates(graph.distances, at_knots, found, covariance)
    shares = np.diff(graph.distances) / np.ptp(graph.distances)
    rms = np.sqrt(shares @ (at_knots @ found.reshape(-1, 3)) ** 2) if is_varying else None
    moves = effects[:, :, 5:]
    spread = np.zeros((len(graph), 6, 6))
    spread[:, np.array(PLANAR)[:, None], PLANAR] = moves @ covariance @ np.swapaxes(moves, -1, -2)
    return WallDrift(
        found.reshape(-1, 3),
        np.asarray(at_knots @ new.reshape(-1, 3)),
        spread,
        EstimatedDrift(-mean, sigma, gain, quantile(RIGHT_PROBABILITY, DRIFT_PARAMETERS), rms),
        is_final=float(new @ np.linalg.solve(covariance, new)) <= MOST_CHANGE_SHARE * len(found),
    )


def _likeliest(fit: DriftFit, roots: Sequence[Floats]) -> Sizes:
    """The noise and drift hyperparameters of maximum likelihood; a later one of `roots` must be significantly better."""
    best, least = Sizes(SCALES[0], roots[0]), np.inf
    for root in checking(roots):
        found = np.array([fit.negative_log_likelihood(noise, root, SIZES) for noise in SCALES])
        noise, size = divmod(int(found.argmin()), len(SIZES))
        if found.min() < least - quantile(SELDOM, 1):
            best, least = Sizes(SCALES[noise], SIZES[size] * root), float(found.min())
    return best


def without_drift(graph: PoseGraph, rates: Floats) -> PoseGraph:
    """The graph with poses and odometry corrected by `rates` of `find_wall_drift`."""
    whole = np.zeros((len(rates), 6))
    whole[:, PLANAR] = rates
    return correct_drift(graph, whole)


def _effects(graph: PoseGraph, at_knots: Floats) -> Floats:
    """Jacobians (K, 3, 5 + 3 n) of the planar poses, map frame, by start, shift of the map, and rates at the knots.

    at_knots : (K-1, n) of `linear_basis`
    """
    place, way = graph.poses[:, :2, 3], np.diff(graph.distances)
    passed = way[:, None] * at_knots
    about = _across(0.5 * (place[1:] + place[:-1]))[:, :, None] * passed[:, None]
    behind, turned = (np.concatenate([0 * part[:1], np.cumsum(part, axis=0)]) for part in (passed, about))
    effects = np.zeros((len(place), 3, 5 + 3 * at_knots.shape[1]))
    effects[:, :, :3] = np.eye(3)
    effects[:, :2, 2] = _across(place - place[0])
    effects[:, :2, 3:5] = -np.eye(2)
    for axis in range(3):
        effects[:, axis, 5 + axis :: 3] = behind
    effects[:, :2, 7::3] = _across(place)[:, :, None] * behind[:, None] - turned
    return effects


def _across(away: Floats) -> Floats:
    """Derivative (..., 2), m per rad, of a point at `away` (..., 2), m, by a small rotation about the origin."""
    return np.stack([-away[..., 1], away[..., 0]], axis=-1)
