"""Correlated noise of GNSS fixes: their stated sigma is that of the total error, of which only a part is white.

Orbits, ionosphere and multipath change over minutes: the error is a first-order Gauss-Markov process beside white noise
(Rankin 1994, GPS and differential GPS: an error model for sensor simulation), so that a thousand fixes are hardly more accurate
than one. Odometry's drift looks similar; correlated residuals belong to the fixes up to their stated sigma, and to odometry
beyond.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lslam.graph.chi_square import quantile
from lslam.graph.fix_errors import NO_HEIGHT

Floats = NDArray[np.float64]

# Size of the covariance: more fixes are averaged in groups.
MOST = 100
# Factors on odometry's drift that are tried.
FACTORS = np.concatenate([[0.0], np.geomspace(1e-3, 1e5, 17)])
# Window of the median filter against outliers that the alignment accepts.
AROUND = 7
# Instants of the error in the graph, at most; a fix has that of the nearest.
INSTANTS = 2000
# Least white share of the variance, against singular covariances of perfect fixes.
LEAST_WHITE = 1e-4
# Correlation times tried, up to so many times the duration: beyond, an error is a constant.
TRIED, LONGEST = 24, 10.0


@dataclass(frozen=True)
class GaussMarkovNoise:
    """A Gauss-Markov process at the instants `seconds` (W,), ascending: `sigma` (3,), m, per axis; time constant `memory`, s."""

    seconds: Floats
    sigma: Floats
    memory: float


@dataclass(frozen=True)
class DriftOfFixes:
    """Covariance of odometry at F fixes.

    known, unit : (K, 6, 6) of K keyframes, axes east, north, up, as of `drift.chains`: odometry's own, and drift of factor 1
    places : (K, 3) m, of the keyframes; metre : (6, 6) of the drift over one metre, `drift.drift_covariance`
    keyframes : (F,) from which each fix is seen, ascending
    """

    known: Floats
    unit: Floats
    places: Floats
    metre: Floats
    keyframes: NDArray[np.intp]


def fit_gauss_markov(
    seconds: Floats, residuals: Floats, sigmas: Floats, antenna: Floats, probability: float, drift: DriftOfFixes
) -> tuple[GaussMarkovNoise | None, float]:
    """Correlated noise of the fixes, and the factor on odometry's drift beside it.

    None where fixes scatter by their stated sigmas, so that their errors may be independent.

    Differences of successive fixes contain neither correlated noise nor drift: they give the white share of the stated variance.
    The time constant of the rest and the drift factor maximise the restricted likelihood, since position and heading were
    fitted.

    seconds : (F,) ascending; residuals : (F, 3) m, east, north, up, of fixes minus trajectory, aligned to them
    sigmas : (F, 3) m, stated; antenna : (F, 3) m, east, north, up; probability : of the chi-square test for white noise
    """
    scaled = residuals / sigmas
    good = _near_neighbours(scaled[:, :2], probability)
    seconds, scaled, sigmas, antenna = seconds[good], scaled[good], sigmas[good], antenna[good]
    gaps = np.diff(seconds)
    near = gaps <= 1.5 * np.median(gaps) if len(gaps) else np.zeros(0, bool)
    if not near.any() or gaps.min() <= 0:
        return None, 0.0
    white = float(0.5 * (np.diff(scaled[:, :2], axis=0)[near] ** 2).mean())
    # Adjacent differences share an error, which leaves two of three degrees of freedom. Two axes.
    free = max(round(2 * near.sum() / 1.5), 1)
    if white > quantile(1 - probability, free) / free:
        return None, 0.0
    white = max(white, LEAST_WHITE)
    drift = replace(drift, keyframes=drift.keyframes[good])
    memory, factor = _likeliest(seconds, scaled, sigmas, antenna, white, drift)
    sigma = np.sqrt(1.0 - white) * np.nanmedian(np.where(sigmas < NO_HEIGHT, sigmas, np.nan), axis=0)
    return GaussMarkovNoise(seconds[:: -(-len(seconds) // INSTANTS)], sigma, memory), factor


def _near_neighbours(scaled: Floats, probability: float) -> NDArray[np.bool_]:
    """(F,) inliers of `scaled` (F, 2) residuals about their running median."""
    from scipy.ndimage import median_filter

    off = scaled - median_filter(scaled, size=(AROUND, 1), mode="reflect")
    return np.asarray((off**2).sum(axis=1) <= quantile(probability, 2))


def _likeliest(
    seconds: Floats, scaled: Floats, sigmas: Floats, antenna: Floats, white: float, drift: DriftOfFixes
) -> tuple[float, float]:
    """Time constant, s, of residuals `scaled` (F, 3) of unit variance beside their `white` part, and drift factor.

    Drift is a random walk or a constant rate with equal prior probability and equal variance at the end of the way. It is
    accepted where the likelihood, marginal over time constants, gains more than its one parameter (Akaike 1974).
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
    # Nuisance parameters of the alignment: position, heading and tilt.
    about = a - a.mean(axis=0)
    about /= max(float(np.abs(about).max()), 1e-9)
    fitted = np.concatenate([np.tile(np.eye(3), (len(t), 1, 1)), np.cross(np.eye(3), about[:, None, :])], axis=2)
    axes, moves, _ = np.linalg.svd(weights[:, None] * fitted.reshape(-1, 6), full_matrices=False)
    # Rotations about a straight way are unobservable.
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
    """(3 F, 3 F) m2 of `places` (F, 3), m, under constant rates of drift.

    metre : (6, 6) of a random walk over one metre, with equal variance at the end of the way
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

    sides : (N, 1 + P) residuals, and Jacobians of the nuisance parameters
    """
    from scipy.linalg import solve_triangular

    root = np.linalg.cholesky(base)
    half = solve_triangular(root, unit, lower=True)
    # Along these axes both are diagonal.
    values, axes = np.linalg.eigh(solve_triangular(root, half.T, lower=True))
    turned = axes.T @ solve_triangular(root, sides, lower=True)
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
    The error of the earlier of two is transported to the later.
    """
    number = np.arange(len(places))
    early, late = np.minimum.outer(number, number), np.maximum.outer(number, number)
    moved = np.cross(np.eye(3), (places[late] - places[early])[:, :, None, :])
    shared = chain[early][..., :3, :3] + chain[early][..., :3, 3:] @ moved
    shared = np.where((number[:, None] <= number)[..., None, None], shared, np.swapaxes(shared, -1, -2))
    return np.asarray(shared.transpose(0, 2, 1, 3).reshape(3 * len(number), 3 * len(number)))
