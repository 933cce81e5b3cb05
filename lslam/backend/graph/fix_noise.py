"""Correlated noise of GNSS fixes: their stated sigma is that of the total error, of which only a part is white.

Orbits, ionosphere and multipath change over minutes: the error is a first-order Gauss-Markov process beside white noise
(Rankin 1994, GPS and differential GPS: an error model for sensor simulation), so that a thousand fixes are hardly more accurate
than one. Odometry's drift looks similar; correlated residuals belong to the fixes up to their stated sigma, and to odometry
beyond. Fixes that scatter by more than they state have told nothing of the correlated part either: it is as large as it fits
best, and only what no such process explains is odometry's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lslam.backend.graph.fix_errors import NO_HEIGHT
from lslam.core.arrays import Bools, Floats
from lslam.core.geometry.noise import quantile

# Size of the covariance: more fixes are averaged in groups.
MOST = 60
# Step of logarithms: finer than any of these numbers can be estimated.
LOG_STEP = 0.1
# Factors on odometry's drift.
FACTORS = np.concatenate([[0.0], np.exp(np.arange(np.log(1e-3), np.log(1e5), LOG_STEP))])
# Gain of the likelihood that pays for the one parameter of drift (Akaike 1974), where fixes are believed.
AKAIKE = 1.0
# Window of the median filter against outliers that the alignment accepts.
SMOOTHED_FIXES = 7
# Instants of the error in the graph, at most; a fix has that of the nearest.
INSTANTS = 2000
# Least white share of the variance, against singular covariances of perfect fixes.
LEAST_WHITE = 1e-4
# Correlation times that are tried, up to so many times the duration: beyond, an error is a constant. Variances likewise, from
# a share of the white one, where they are unknown. Between them the logarithm of the likelihood is a spline, which is right
# to 0.1 over an hour; its exponential is too narrow to be summed at so few.
MEMORIES, LONGEST, VARIANCES, LEAST_SLOW = 12, 10.0, 13, 0.01


@dataclass(frozen=True)
class GaussMarkovNoise:
    """A Gauss-Markov process at the instants `seconds` (W,), ascending: `sigma` (3,), m, per axis; time constant `memory`, s."""

    seconds: Floats
    sigma: Floats
    memory: float


@dataclass(frozen=True)
class DriftOfFixes:
    """Covariance of odometry at F fixes.

    odometry, unit : (K, 6, 6) of K keyframes, axes east, north, up, as of `drift.chains`: odometry's own, and drift of factor 1
    places : (K, 3) m, of the keyframes; metre : (6, 6) of the drift over one metre, `drift.drift_covariance`
    keyframes : (F,) from which each fix is seen, ascending
    """

    odometry: Floats
    unit: Floats
    places: Floats
    metre: Floats
    keyframes: NDArray[np.intp]


def fit_gauss_markov(
    seconds: Floats,
    residuals: Floats,
    sigmas: Floats,
    antenna: Floats,
    probability: float,
    drift: DriftOfFixes,
    largest: float | None = None,
) -> tuple[GaussMarkovNoise | None, float]:
    """Correlated noise of the fixes, and the factor on odometry's drift beside it.

    None where fixes scatter by their stated sigmas, so that their errors may be independent.

    Differences of successive fixes contain neither correlated noise nor drift: they give the white share of the stated variance.
    The time constant of the rest and the drift factor maximise the restricted likelihood, since position and heading were
    fitted. Where the statement is refuted the variance of the correlated part is estimated as well, and fixes are the first
    to be suspected: drift must be significant.

    seconds : (F,) ascending; residuals : (F, 3) m, east, north, up, of fixes minus trajectory, aligned to them
    sigmas : (F, 3) m, stated; antenna : (F, 3) m, east, north, up; probability : of the chi-square test for white noise
    largest : m, of the correlated part where `sigmas` are of the scatter, as the statement is refuted; None where it is believed
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
    if largest is None and white > quantile(1 - probability, free) / free:
        return None, 0.0
    white = max(white, LEAST_WHITE)
    typical = np.nanmedian(np.where(sigmas < NO_HEIGHT, sigmas, np.nan), axis=0)
    slow = np.array([1.0 - white])
    if largest is not None:
        slow = np.geomspace(LEAST_SLOW * white, max((largest / typical[:2].max()) ** 2, 4 * white), VARIANCES)
    drift = replace(drift, keyframes=drift.keyframes[good])
    least_gain = AKAIKE if largest is None else 0.5 * quantile(probability, 1)
    memory, variance, factor = _likeliest(seconds, scaled, sigmas, antenna, white, slow, drift, least_gain)
    if variance * len(seconds) < white:
        return None, factor
    return GaussMarkovNoise(seconds[:: -(-len(seconds) // INSTANTS)], np.sqrt(variance) * typical, memory), factor


def _near_neighbours(ratios: Floats, probability: float) -> Bools:
    """(F,) inliers of `ratios` (F, 2) residuals about their running median."""
    from scipy.ndimage import median_filter

    off = ratios - median_filter(ratios, size=(SMOOTHED_FIXES, 1), mode="reflect")
    return np.asarray((off**2).sum(axis=1) <= quantile(probability, 2))


def _likeliest(
    seconds: Floats,
    ratios: Floats,
    sigmas: Floats,
    antenna: Floats,
    white: float,
    slow: Floats,
    drift: DriftOfFixes,
    least_gain: float,
) -> tuple[float, float, float]:
    """Time constant, s, and variance of the correlated part of `ratios` (F, 3), and drift factor, of maximum likelihood.

    ratios : residuals in stated sigmas; white : variance of their white part
    slow : (V,) candidate variances; least_gain : log-likelihood that drift must gain
    Drift is a random walk, or a constant rate of equal variance at the end of the way. It is accepted where the likelihood,
    marginal over time constants, gains enough.
    """
    groups = np.array_split(np.arange(len(seconds)), min(len(seconds), MOST))
    t, r, a, s = (np.stack([values[g].mean(axis=0) for g in groups]) for values in (seconds, ratios, antenna, sigmas))
    keyframes = drift.keyframes[[group[len(group) // 2] for group in groups]]
    places, weights = drift.places[keyframes], (1.0 / s).ravel()
    known, walk, rate = (
        part * np.outer(weights, weights)
        for part in (
            _joint_covariance(drift.odometry[keyframes], places),
            _joint_covariance(drift.unit[keyframes], places),
            _lasting(drift.metre, a),
        )
    )
    known += np.diag(np.repeat([white / len(group) for group in groups], 3))
    # Nuisance parameters of the alignment: position, heading and tilt.
    about = a - a.mean(axis=0)
    about /= max(float(np.abs(about).max()), 1e-9)
    fitted = np.concatenate([np.tile(np.eye(3), (len(t), 1, 1)), np.cross(np.eye(3), about[:, None, :])], axis=2)
    axes, moves, _ = np.linalg.svd(weights[:, None] * fitted.reshape(-1, 6), full_matrices=False)
    # Rotations about a straight way are unobservable.
    sides = np.column_stack([r.ravel(), axes[:, moves > 1e-9 * moves[0]]])
    apart = np.abs(t[:, None] - t)
    gap = float(np.median(np.diff(seconds)))
    memories = np.geomspace(gap, LONGEST * max(t[-1] - t[0], gap), MEMORIES)
    # Six rates: the rank of their covariance.
    values, axes = np.linalg.eigh(rate)
    root = axes[:, -6:] * np.sqrt(np.maximum(values[-6:], 0.0))
    tried = np.array(
        [
            [_log_likelihoods(known + variance * exponential, walk, root, sides) for variance in slow]
            for exponential in (np.kron(np.exp(-apart / memory), np.eye(3)) for memory in memories)
        ]
    )
    memories, likelihoods = _interpolate(memories, tried, 0)
    slow, likelihoods = _interpolate(slow, likelihoods, 1)
    # Both drifts are as probable, and so are all time constants.
    marginal = np.logaddexp.reduce(likelihoods, axis=(0, 2))
    has_drift = marginal[:, 1:].max() - marginal[:, 0].max() > least_gain
    possible = slice(1, None) if has_drift else slice(1)
    considered = likelihoods[..., possible]
    m, v, _, f = np.unravel_index(int(np.argmax(considered)), considered.shape)
    return float(memories[m]), float(slow[v]), float(FACTORS[possible][f])


def _interpolate(grid: Floats, likelihoods: Floats, axis: int) -> tuple[Floats, Floats]:
    """`grid` refined, and the log-likelihoods along `axis` at it by a cubic spline in the logarithm of the grid."""
    from scipy.interpolate import CubicSpline

    if len(grid) == 1:
        return grid, likelihoods
    dense = np.geomspace(grid[0], grid[-1], 1 + round(float(np.log(grid[-1] / grid[0])) / LOG_STEP))
    return dense, np.asarray(CubicSpline(np.log(grid), likelihoods, axis=axis)(np.log(dense)))


def _lasting(metre: Floats, places: Floats) -> Floats:
    """Covariance (3 F, 3 F), m2, of positions `places` (F, 3), m, under constant rates of drift.

    metre : (6, 6) covariance of a random walk over one metre, whose variance at the end of the way is the same
    """
    steps = np.diff(places, axis=0)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps, axis=1))])
    middle = 0.5 * (way[1:] + way[:-1])
    turned = np.cumsum(middle[:, None, None] * -np.cross(np.eye(3), steps[:, None, :]), axis=0)
    turned = np.concatenate([np.zeros((1, 3, 3)), turned])
    moved = way[:, None, None] * np.eye(3)
    effects = np.concatenate([moved, turned], axis=2).reshape(-1, 6)
    return np.asarray(effects @ metre @ effects.T / max(way[-1], 1e-9))


def _log_likelihoods(base: Floats, walk: Floats, rates: Floats, sides: Floats) -> Floats:
    """(2, len(FACTORS)) logarithms of the restricted likelihood of `base` + factor x drift, covariances (N, N).

    Drift is `walk` (N, N), or has the square root `rates` (N, R).
    sides : (N, 1 + P) residuals, and Jacobians of the nuisance parameters
    """
    from scipy.linalg import solve_triangular

    root = np.linalg.cholesky(base)
    whitened, rates, half = (solve_triangular(root, right, lower=True) for right in (sides, rates, walk))
    # Along these axes base and drift are diagonal.
    values, axes = np.linalg.eigh(solve_triangular(root, half.T, lower=True))
    few, roots, _ = np.linalg.svd(rates, full_matrices=False)
    drifts = ((np.maximum(values, 0.0), axes), (roots**2, few))
    of_drifts = np.stack([_beside_white(variances, along, whitened) for variances, along in drifts])
    return np.asarray(of_drifts - np.log(np.diag(root)).sum())


def _beside_white(values: Floats, axes: Floats, sides: Floats) -> Floats:
    """`_log_likelihoods` for the covariance factor x `values` (R,) along the `axes` (N, R) plus the identity."""
    along, spread = axes.T @ sides, 1.0 + FACTORS[:, None] * values
    rest = sides - axes @ along
    products = (along[:, :, None] * along[:, None, :]).reshape(len(along), -1)
    squares = rest.T @ rest + (1.0 / spread @ products).reshape(len(FACTORS), *2 * sides.shape[1:])
    right, information = squares[:, 1:, :1], squares[:, 1:, 1:]
    squared = squares[:, 0, 0] - (right * np.linalg.solve(information, right)).sum(axis=(1, 2))
    return np.asarray(-0.5 * (squared + np.log(spread).sum(axis=1) + np.linalg.slogdet(information)[1]))


def _joint_covariance(chain: Floats, places: Floats) -> Floats:
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
