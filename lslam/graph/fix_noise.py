"""What satellite fixes err by together: they state the whole of their error, and scatter by less.

Orbits, ionosphere and multipath change over minutes: most of a fix's error is the next one's as well, a first-order
Gauss-Markov process beside white noise (Rankin 1994, GPS and differential GPS: an error model for sensor simulation). A
thousand such fixes know a place hardly better than one of them does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.graph.chi_square import quantile

Floats = NDArray[np.float64]

# Fixes whose correlation is looked at; of more, means of as many as it takes.
MOST = 200
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


def wander_of(seconds: Floats, residuals: Floats, sigmas: Floats, antenna: Floats, probability: float) -> Wander | None:
    """What fixes err by together; None where they scatter as they state, so that each may have an error of its own.

    The way from one fix to the next is free of what they have in common, and of odometry's drift as well: that tells the
    white part of the variance that is stated. Of what is left, the memory is the likeliest (restricted likelihood, since a
    place and a heading were fitted). Drift of odometry can only shorten it.

    seconds : (F,) ascending; residuals : (F, 3) m, east, north, up, of fixes minus trajectory, aligned to them
    sigmas : (F, 3) m, stated; antenna : (F, 3) m, east, north, up; probability : with which chance scatters more
    """
    scaled = residuals[:, :2] / sigmas[:, :2]
    good = _near_neighbours(scaled, probability)
    seconds, scaled, sigmas, antenna = seconds[good], scaled[good], sigmas[good], antenna[good]
    gaps = np.diff(seconds)
    near = gaps <= 1.5 * np.median(gaps) if len(gaps) else np.zeros(0, bool)
    if not near.any() or gaps.min() <= 0:
        return None
    white = float(0.5 * (np.diff(scaled, axis=0)[near] ** 2).mean())
    # Differences of neighbours share an error: of three of them, two are free. Two axes.
    free = max(round(2 * near.sum() / 1.5), 1)
    if white > quantile(1 - probability, free) / free:
        return None
    white = max(white, LEAST_WHITE)
    memory = _memory(seconds, scaled, antenna[:, :2] / sigmas[:, :2], white, float(np.median(gaps)))
    return Wander(seconds[:: -(-len(seconds) // INSTANTS)], np.sqrt(1.0 - white) * np.median(sigmas, axis=0), memory)


def _near_neighbours(scaled: Floats, probability: float) -> NDArray[np.bool_]:
    """(F,) which of `scaled` (F, 2) residuals are as near to the median of those around as they state to be."""
    from scipy.ndimage import median_filter

    off = scaled - median_filter(scaled, size=(AROUND, 1), mode="reflect")
    return np.asarray((off**2).sum(axis=1) <= quantile(probability, 2))


def _memory(seconds: Floats, scaled: Floats, antenna: Floats, white: float, gap: float) -> float:
    """The likeliest time constant, s, of what residuals `scaled` (F, 2) of unit variance have beside their `white` part."""
    groups = np.array_split(np.arange(len(seconds)), min(len(seconds), MOST))
    t, r, a = (np.stack([values[g].mean(axis=0) for g in groups]) for values in (seconds, scaled, antenna))
    own = white / np.array([len(g) for g in groups])
    a = a - a.mean(axis=0)
    a = a / max(float(np.abs(a).max()), 1e-9)
    one, none = np.ones(len(t)), np.zeros(len(t))
    # Residuals, and what moves them that was fitted: place and heading.
    sides = np.column_stack([r[:, 0], one, none, -a[:, 1], r[:, 1], none, one, a[:, 0]])
    apart = np.abs(t[:, None] - t)
    tried = np.geomspace(gap, LONGEST * max(t[-1] - t[0], gap), TRIED)
    likelihoods = []
    for memory in tried:
        root = np.linalg.cholesky((1 - white) * np.exp(-apart / memory) + np.diag(own))
        east, north = np.split(np.linalg.solve(root, sides), 2, axis=1)
        r_own, k_own = np.append(east[:, 0], north[:, 0]), np.concatenate([east[:, 1:], north[:, 1:]])
        information = k_own.T @ k_own
        fit = np.linalg.solve(information, k_own.T @ r_own)
        squared = float(((r_own - k_own @ fit) ** 2).sum())
        determinant = 4 * np.log(np.diag(root)).sum() + np.linalg.slogdet(information)[1]
        likelihoods.append(-0.5 * (squared + determinant))
    return float(tried[int(np.argmax(likelihoods))])
