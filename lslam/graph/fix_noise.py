"""What satellite fixes err by together: they state the whole of their error, and scatter by less.

Orbits, ionosphere and multipath change over minutes: most of a fix's error is the next one's as well, a first-order
Gauss-Markov process beside white noise (Rankin 1994, GPS and differential GPS: an error model for sensor simulation). A
thousand such fixes know a place hardly better than one of them does. What odometry drifts by looks much like that; it is the
fixes' up to what they state, and odometry's beyond.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lslam.graph.chi_square import quantile

Floats = NDArray[np.float64]

# Fixes whose correlation is looked at; of more, means of as many as it takes.
MOST = 100
# Factors tried on the drift of odometry.
FACTORS = np.concatenate([[0.0], np.geomspace(1e-3, 1e5, 17)])
# Fixes in a row of which the most are right: an alignment forgives what drift and tilt may explain.
AROUND = 7
# Instants at which a graph has the error; between them it is that of the nearest.
INSTANTS = 2000
# Of the variance: what no fix is better than, so that likelihoods can be had of perfect ones.
LEAST_WHITE = 1e-4
# Memories tried, of the time between two fixes up to so many times all of it: beyond, an error is a constant.
TRIED, LONGEST = 24, 10.0


@dataclass(frozen=True)
class Wander:
    """An error that wanders, at the instants `seconds` (W,), ascending: `sigma` (3,), m, of each axis, and `memory`, s."""

    seconds: Floats
    sigma: Floats
    memory: float


@dataclass(frozen=True)
class DriftOfFixes:
    """What odometry may err by at F fixes.

    known, unit : (K, 6, 6) of K keyframes, axes east, north, up, as of `drift.chains`: as odometry says, and drift of factor 1
    places : (K, 3) m, of the keyframes; metre : (6, 6) of the drift over one metre, `drift.drift_covariance`
    keyframes : (F,) from which each fix is seen, ascending
    """

    known: Floats
    unit: Floats
    places: Floats
    metre: Floats
    keyframes: NDArray[np.intp]


def wander_of(
    seconds: Floats, residuals: Floats, sigmas: Floats, antenna: Floats, probability: float, drift: DriftOfFixes
) -> tuple[Wander | None, float]:
    """What fixes err by together, and the factor on the drift of odometry beside it.

    No wander where fixes scatter as they state, so that each may have an error of its own.

    The way from one fix to the next is free of what they have in common, and of odometry's drift as well: that tells the
    white part of the variance that is stated. The rest is the fixes' up to that variance, for as long as their memory, and
    odometry's beyond: memory and drift are the likeliest (restricted likelihood, since a place and a heading were fitted).

    seconds : (F,) ascending; residuals : (F, 3) m, east, north, up, of fixes minus trajectory, aligned to them
    sigmas : (F, 3) m, stated; antenna : (F, 3) m, east, north, up; probability : with which chance scatters more
    """
    scaled = residuals / sigmas
    good = _near_neighbours(scaled[:, :2], probability)
    seconds, scaled, sigmas, antenna = seconds[good], scaled[good], sigmas[good], antenna[good]
    gaps = np.diff(seconds)
    near = gaps <= 1.5 * np.median(gaps) if len(gaps) else np.zeros(0, bool)
    if not near.any() or gaps.min() <= 0:
        return None, 0.0
    white = float(0.5 * (np.diff(scaled[:, :2], axis=0)[near] ** 2).mean())
    # Differences of neighbours share an error: of three of them, two are free. Two axes.
    free = max(round(2 * near.sum() / 1.5), 1)
    if white > quantile(1 - probability, free) / free:
        return None, 0.0
    white = max(white, LEAST_WHITE)
    drift = replace(drift, keyframes=drift.keyframes[good])
    memory, factor = _likeliest(seconds, scaled, sigmas, antenna, white, drift)
    sigma = np.sqrt(1.0 - white) * np.median(sigmas, axis=0)
    return Wander(seconds[:: -(-len(seconds) // INSTANTS)], sigma, memory), factor


def _near_neighbours(scaled: Floats, probability: float) -> NDArray[np.bool_]:
    """(F,) which of `scaled` (F, 2) residuals are as near to the median of those around as they state to be."""
    from scipy.ndimage import median_filter

    off = scaled - median_filter(scaled, size=(AROUND, 1), mode="reflect")
    return np.asarray((off**2).sum(axis=1) <= quantile(probability, 2))


def _likeliest(
    seconds: Floats, scaled: Floats, sigmas: Floats, antenna: Floats, white: float, drift: DriftOfFixes
) -> tuple[float, float]:
    """Time constant, s, of what residuals `scaled` (F, 3) of unit variance have beside their `white` part, and drift factor.

    Drift is a walk or lasts, either as likely; by the end of the way both come to the same. There is some where it is likelier
    than none by more than the one number that it is (Akaike 1974), on the mean of all memories, which nobody asks for.
    """
    groups = np.array_split(np.arange(len(seconds)), min(len(seconds), MOST))
    t, r, a, s = (np.stack([values[g].mean(axis=0) for g in groups]) for values in (seconds, scaled, antenna, sigmas))
    own = np.repeat([white / len(group) for group in groups], 3)
    keyframes = drift.keyframes[[group[len(group) // 2] for group in groups]]
    places, weights = drift.places[keyframes], (1.0 / s).ravel()
    known, walk, rate = (
        part * np.outer(weights, weights)
        for part in (
            _shared(drift.known[keyframes], places),
            _shared(drift.unit[keyframes], places),
            _lasting(drift.metre, a),
        )
    )
    # What was fitted moves them: place and heading, and tilt.
    about = a - a.mean(axis=0)
    about /= max(float(np.abs(about).max()), 1e-9)
    fitted = np.concatenate([np.tile(np.eye(3), (len(t), 1, 1)), np.cross(np.eye(3), about[:, None, :])], axis=2)
    axes, moves, _ = np.linalg.svd(weights[:, None] * fitted.reshape(-1, 6), full_matrices=False)
    # About a straight way no turn moves anything.
    sides = np.column_stack([r.ravel(), axes[:, moves > 1e-9 * moves[0]]])
    gap = float(np.median(np.diff(seconds)))
    tried = np.geomspace(gap, LONGEST * max(t[-1] - t[0], gap), TRIED)
    apart = np.abs(t[:, None] - t)
    bases = [np.kron((1 - white) * np.exp(-apart / memory), np.eye(3)) + np.diag(own) + known for memory in tried]
    likelihoods = np.logaddexp(
        *(np.stack([_likelihoods(base, unit, sides) for base in bases], axis=1) for unit in (walk, rate))
    )
    of_factor = np.logaddexp.reduce(likelihoods, axis=1)
    best = int(np.argmax(of_factor))
    best = best if of_factor[best] - of_factor[0] > 1.0 else 0
    return float(tried[int(np.argmax(likelihoods[best]))]), float(FACTORS[best])


def _lasting(metre: Floats, places: Floats) -> Floats:
    """(3 F, 3 F) m2 of `places` (F, 3), m, under rates of drift that last all the way.

    metre : (6, 6) of a walk over one metre, which comes to the same at the end of the way
    """
    steps = np.diff(places, axis=0)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps, axis=1))])
    middle = 0.5 * (way[1:] + way[:-1])
    turned = np.cumsum(middle[:, None, None] * -np.cross(np.eye(3), steps[:, None, :]), axis=0)
    turned = np.concatenate([np.zeros((1, 3, 3)), turned])
    moved = way[:, None, None] * np.eye(3)
    effects = np.concatenate([moved, turned], axis=2).reshape(-1, 6)
    return np.asarray(effects @ metre @ effects.T / max(way[-1], 1e-9))


def _likelihoods(base: Floats, unit: Floats, sides: Floats) -> Floats:
    """(len(FACTORS),) logarithms of the restricted likelihood of `base` + factor x `unit` (N, N), both covariances.

    sides : (N, 1 + P) residuals, and what moves them that was fitted
    """
    root = np.linalg.cholesky(base)
    half = np.linalg.solve(root, unit)
    # Along these axes both are diagonal: each factor costs a row.
    values, axes = np.linalg.eigh(np.linalg.solve(root, half.T))
    turned = axes.T @ np.linalg.solve(root, sides)
    out = np.empty(len(FACTORS))
    for i, factor in enumerate(FACTORS):
        spread = 1.0 + factor * np.maximum(values, 0.0)
        r, k = turned[:, 0], turned[:, 1:]
        information = k.T @ (k / spread[:, None])
        right = k.T @ (r / spread)
        squared = float(r @ (r / spread) - right @ np.linalg.solve(information, right))
        out[i] = -0.5 * (squared + np.log(spread).sum() + np.linalg.slogdet(information)[1])
    return np.asarray(out - np.log(np.diag(root)).sum())


def _shared(chain: Floats, places: Floats) -> Floats:
    """(3 F, 3 F) m2 of F poses at `places` (F, 3), m, world axes, one after the other.

    chain : (F, 6, 6) of each pose, world axes, as of `drift.chains`
    What the earlier of two errs by, the later errs by as well, turned about it.
    """
    number = np.arange(len(places))
    early, late = np.minimum.outer(number, number), np.maximum.outer(number, number)
    moved = np.cross(np.eye(3), (places[late] - places[early])[:, :, None, :])
    shared = chain[early][..., :3, :3] + chain[early][..., :3, 3:] @ moved
    shared = np.where((number[:, None] <= number)[..., None, None], shared, np.swapaxes(shared, -1, -2))
    return np.asarray(shared.transpose(0, 2, 1, 3).reshape(3 * len(number), 3 * len(number)))
