"""Odometry that runs away, as the buildings of a map reveal it, and that is set straight before the graph is solved.

What makes every scan wrong alike (a bent calibration, a wheel that slips) turns and shifts a trajectory at a rate that lasts;
what else a registration does not know of its own errors makes it wander. Either is told by what was seen with it: rates that
last explain what wanders badly, and would lead where no wall is seen.
A map has each wall wrong by far more than odometry errs from keyframe to keyframe, but wrong by the same from wherever it is
seen: that a wall moves while the run passes it tells a rate, whatever the map is worth, and a rate bends no step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.config.graph import GraphConfig
from lslam.graph.chi_square import quantile
from lslam.graph.factors import PLANAR
from lslam.graph.problem import DriftClaim, PoseGraph
from lslam.graph.rates import MEMORY, SIZES, hats, rate_roots, set_straight, walk_root
from lslam.osm.drift_fit import DriftFit, Sizes, WallSightings
from lslam.stopping import checking

Floats = NDArray[np.float64]

# Times the errors of what is seen that the configuration believes in: the likeliest are taken. From far and at a grazing angle
# a wall is seen elsewhere than from near, by some centimetres for many keyframes: none is seen better.
SCALES = (0.25, 0.5, 1.0)
# The more lasts, the farther drift is believed to go on where no wall is seen, so more is believed only of what is likelier by
# so much that chance seldom explains it.
SELDOM = 0.95
# What is fitted with drift and not without: how large it is and how it lasts. The rates themselves are averaged over.
FITTED = 2
ROUNDS = 6
# m between knots of rates that wander, or so many knots, where rates last no longer than from one to the next.
APART, MOST = 20.0, 40
SETTLED = 0.1  # of the squared length that chance would give rates


@dataclass(frozen=True)
class WallDrift:
    """What odometry has to be set right by: rates that last, or those that wander.

    knots : (n, 3) rates at knots along the way, with all that was found before
    rates : (K-1, 3) per m of the way from each keyframe to the next: m along x and y of the world, rad of heading; beside
        what was found before
    spread : (K, 6, 6) by how much each pose is unsure for that the rates are, as the covariances of `Solution`
    claim : the drift that odometry has, with what was found before
    is_settled : the rates are well below what they are unsure by
    """

    knots: Floats
    rates: Floats
    spread: Floats
    claim: DriftClaim
    is_settled: bool

    @property
    def is_sure(self) -> bool:
        """Whether chance does not explain as much."""
        return self.claim.gain > self.claim.chance


def find_wall_drift(
    graph: PoseGraph, seen: WallSightings, seen_sigma: float, map_sigma: float, config: GraphConfig,
    before: WallDrift | None = None,
) -> WallDrift | None:  # fmt: skip
    """The rates at which odometry has to be set right to see walls stand still; None where nothing tells any.

    Rates at knots along the way and the errors of what is seen are random, of sizes that are unknown: each is given that with
    which what was seen is likeliest (empirical Bayes), and drift is what this is likelier with than chance would have it;
    drift that wanders, what is likelier still with that.

    graph : in the frame of the map, held by `start_sigma`, with `distances`
    seen_sigma, map_sigma : m, of a wall that is seen, and of one of the map beside the shift of the whole
    before : what the graph was set right by already; where no wall is seen, what is left of the same drift is no smaller one
    """
    if not len(seen.walls) or graph.start_sigma is None or graph.distances[-1] <= 0:
        return None

    def told(does_wander: bool) -> WallDrift:
        return _found(graph, seen, (seen_sigma, map_sigma), config, before, does_wander)

    if before is not None:
        return told(before.claim.does_wander)
    lasting, wandering = told(does_wander=False), told(does_wander=True)
    return wandering if wandering.is_sure and wandering.claim.gain > lasting.claim.gain else lasting


def _found(
    graph: PoseGraph, seen: WallSightings, sigmas: tuple[float, float], config: GraphConfig, before: WallDrift | None,
    does_wander: bool,
) -> WallDrift:  # fmt: skip
    """Drift of one kind, as `find_wall_drift`."""
    assert graph.start_sigma is not None
    length = float(graph.distances[-1])
    apart = min(max(APART, length / MOST), MEMORY) if does_wander else MEMORY
    at_knots = hats(graph.distances, apart)
    effects = _effects(graph, at_knots)
    taken = np.zeros(3 * at_knots.shape[1]) if before is None else before.knots.ravel()
    fit = DriftFit(graph, seen, effects, taken, *sigmas, np.append(graph.start_sigma, [graph.shift_sigma] * 2))
    roots = [walk_root(length, config, PLANAR, apart)] if does_wander else rate_roots(length, config, PLANAR)
    sizes = _likeliest(fit, roots)
    for _ in range(ROUNDS):
        fit.doubt(sizes)
        sizes = _likeliest(fit, roots)
    found, _ = fit.rates(sizes)
    # What is found is the same when less of it counts, and not how sure it is.
    fit.count_less(seen.share)
    _, covariance = fit.rates(sizes)
    without = min(float(fit.unlikeliness(noise, sizes.root, (0.0,))[0]) for noise in SCALES)
    gain = without - float(fit.unlikeliness(sizes.noise, sizes.root, (1.0,))[0])
    new = found - taken
    shares = np.diff(graph.distances) / np.ptp(graph.distances)
    mean = np.kron(shares @ at_knots, np.eye(3))
    sigma = np.sqrt(np.diag(mean @ covariance @ mean.T))
    rms = np.sqrt(shares @ (at_knots @ found.reshape(-1, 3)) ** 2) if does_wander else None
    moves = effects[:, :, 5:]
    spread = np.zeros((len(graph), 6, 6))
    spread[:, np.array(PLANAR)[:, None], PLANAR] = moves @ covariance @ np.swapaxes(moves, -1, -2)
    return WallDrift(
        found.reshape(-1, 3), np.asarray(at_knots @ new.reshape(-1, 3)), spread,
        DriftClaim(-(mean @ found), sigma, gain, quantile(config.probability, FITTED), rms),
        is_settled=float(new @ np.linalg.solve(covariance, new)) <= SETTLED * len(found),
    )  # fmt: skip


def _likeliest(fit: DriftFit, roots: Sequence[Floats]) -> Sizes:
    """The sizes with which what was seen is likeliest."""
    best, least = Sizes(SCALES[0], roots[0]), np.inf
    for root in checking(roots):
        found = np.array([fit.unlikeliness(noise, root, SIZES) for noise in SCALES])
        noise, size = divmod(int(found.argmin()), len(SIZES))
        if found.min() < least - quantile(SELDOM, 1):
            best, least = Sizes(SCALES[noise], SIZES[size] * root), float(found.min())
    return best


def without_drift(graph: PoseGraph, rates: NDArray[np.float64]) -> PoseGraph:
    """The graph with poses and odometry set right by `rates` of `find_wall_drift`."""
    whole = np.zeros((len(rates), 6))
    whole[:, PLANAR] = rates
    return set_straight(graph, whole)


def _effects(graph: PoseGraph, at_knots: Floats) -> Floats:
    """(K, 3, 5 + 3 n) what start, shift of the map, and rates at the knots do to planar poses, as seen from the map.

    at_knots : (K-1, n) of `hats`
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
    """Where a small turn moves what lies `away` (..., 2), per rad."""
    return np.stack([-away[..., 1], away[..., 0]], axis=-1)
