"""Correlated noise of GNSS fixes: their stated sigma is that of the total error, of which only a part is white.

Orbits, ionosphere and multipath change over minutes: the error is a first-order Gauss-Markov process beside white noise
(Rankin 1994, GPS and differential GPS: an error model for sensor simulation), so that a thousand fixes are hardly more accurate
than one. Odometry's drift looks similar; correlated residuals belong to the fixes up to their stated sigma, and to odometry
beyond. Fixes that scatter by more than they state have told nothing of the correlated part either: it is as large as it fits
best, and only what no such process explains is odometry's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.graph.chi_square import quantile
from lslam.graph.fix_errors import NO_HEIGHT

Floats = NDArray[np.float64]

# Size of the covariance: more fixes are averaged in groups.
MOST = 60
# Factors on odometry's drift that are tried, and refined.
FACTORS = np.geomspace(1e-3, 1e5, 9)
# Gain of the likelihood that pays for the one parameter of drift (Akaike 1974), where fixes are believed.
AKAIKE = 1.0
# Window of the median filter against outliers that the alignment accepts.
AROUND = 7
# Instants of the error in the graph, at most; a fix has that of the nearest.
INSTANTS = 2000
# Least white share of the variance, against singular covariances of perfect fixes.
LEAST_WHITE = 1e-4
# Correlation times that are tried, up to so many times the duration: beyond, an error is a constant. Variances likewise, from
# a share of the white one, where they are unknown.
MEMORIES, LONGEST, VARIANCES, LEAST_SLOW = 8, 10.0, 7, 0.01


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
    seconds: Floats, residuals: Floats, sigmas: Floats, antenna: Floats, probability: float, drift: DriftOfFixes,
    largest: float | None = None,
) -> tuple[GaussMarkovNoise | None, float]:  # fmt: skip
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


def _near_neighbours(scaled: Floats, probability: float) -> NDArray[np.bool_]:
    """(F,) inliers of `scaled` (F, 2) residuals about their running median."""
    from scipy.ndimage import median_filter

    off = scaled - median_filter(scaled, size=(AROUND, 1), mode="reflect")
    return np.asarray((off**2).sum(axis=1) <= quantile(probability, 2))


def _likeliest(
    seconds: Floats, scaled: Floats, sigmas: Floats, antenna: Floats, white: float, slow: Floats, drift: DriftOfFixes,
    least_gain: float,
) -> tuple[float, float, float]:  # fmt: skip
    """Time constant, s, and variance of what residuals `scaled` (F, 3) have beside their `white` part, and drift factor.

    slow : (V,) variances that are tried; a single one is known
    least_gain : logarithm of the likelihood that drift must gain
    Drift is a random walk, or a constant rate of equal variance at the end of the way. It is accepted where the likelihood,
    marginal over time constants, gains enough.
    """
    groups = np.array_split(np.arange(len(seconds)), min(len(seconds), MOST))
    t, r, a, s = (np.stack([values[g].mean(axis=0) for g in groups]) for values in (seconds, scaled, antenna, sigmas))
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

    def likelihood(unit: Floats, memory: float, variance: float, factor: float) -> float:
        correlated = np.kron(variance * np.exp(-apart / memory), np.eye(3))
        return _log_likelihood(known + correlated + factor * unit, sides)

    nothing, *drifts = (
        _Tried.over(partial(likelihood, unit), (memories, slow, factors))
        for unit, factors in ((walk, np.zeros(1)), (walk, FACTORS), (rate, FACTORS))
    )
    # Both drifts are as probable, and so are all time constants.
    beside = np.logaddexp(*(one.marginal for one in drifts)) - np.log(2.0)
    best = max(drifts, key=lambda one: one.likelihoods.max())
    memory, variance, factor = (best if beside.max() - nothing.marginal.max() > least_gain else nothing).refined()
    return memory, variance, factor


@dataclass(frozen=True)
class _Tried:
    """Logarithms of a likelihood of positive numbers, time constants first, at all combinations of the values `tried`."""

    of: Callable[..., float]
    tried: tuple[Floats, ...]
    likelihoods: Floats

    @classmethod
    def over(cls, of: Callable[..., float], tried: tuple[Floats, ...]) -> _Tried:
        """All of them."""
        values = np.array([of(*at) for at in product(*tried)])
        return cls(of, tried, values.reshape([len(one) for one in tried]))

    @property
    def marginal(self) -> Floats:
        """The likelihood over time constants, of each combination of the others."""
        return np.asarray(np.logaddexp.reduce(self.likelihoods, axis=0))

    def refined(self) -> list[float]:
        """The numbers at the maximum; those of which several were tried lie between them."""
        from scipy.optimize import minimize

        place = np.unravel_index(int(np.argmax(self.likelihoods)), self.likelihoods.shape)
        best = [float(values[i]) for values, i in zip(self.tried, place, strict=True)]
        free = [i for i, values in enumerate(self.tried) if len(values) > 1]

        def at(logarithms: Floats) -> list[float]:
            moved = list(best)
            for i, logarithm in zip(free, logarithms, strict=True):
                moved[i] = float(np.exp(np.clip(logarithm, np.log(self.tried[i][0]), np.log(self.tried[i][-1]))))
            return moved

        if not free:
            return best
        options: Any = {"xatol": 0.05, "fatol": 0.05, "maxfev": 150}

        def cost(logarithms: Floats) -> float:
            return -self.of(*at(logarithms))

        found = minimize(cost, np.log([best[i] for i in free]), method="Nelder-Mead", options=options)
        # Rounded, so that another machine's last bits do not show.
        return at(np.round(found.x, 2))


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


def _log_likelihood(covariance: Floats, sides: Floats) -> float:
    """Logarithm of the restricted likelihood of a covariance (N, N).

    sides : (N, 1 + P) residuals, and Jacobians of the nuisance parameters
    """
    from scipy.linalg import solve_triangular

    root = np.linalg.cholesky(covariance)
    whitened = solve_triangular(root, sides, lower=True)
    r, k = whitened[:, 0], whitened[:, 1:]
    information, right = k.T @ k, k.T @ r
    squared = float(r @ r - right @ np.linalg.solve(information, right))
    return float(-0.5 * (squared + np.linalg.slogdet(information)[1]) - np.log(np.diag(root)).sum())


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
