"""Errors of GNSS fixes that their sigmas do not state: a wrong clock, more noise than stated, heights of another datum.

Over a second odometry is far better than a receiver, whatever it drifts over a kilometre. Displacements over that time tell
the offset between both clocks, and differences of successive residuals the white noise of each axis.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Bools, Floats
from lslam.core.geometry import se2
from lslam.core.geometry.noise import quantile

# s; offsets that are tried, their step, and the time over which displacements are compared.
LARGEST_S, STEP_S, LAG_S = 2.5, 0.05, 1.0
# Gain of the squared residuals that an offset must bring, in units of their noise, and its size in its own sigmas.
LEAST_GAIN, LEAST_SIGMAS = 30.0, 5.0
# s; a smaller offset is one of the stamps' resolution. Displacements below are too few.
LEAST_OFFSET_S, FEWEST = 0.03, 8
# Of a normal distribution, to its median absolute deviation. Shares of outliers that are tried.
MAD, OUTLIERS = 1.4826, (1e-3, 0.03, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
# s; in a window the scatter of fixes is theirs, and odometry's drift little.
WINDOW_S = 30.0
# m; sigma of a height that is left out. Sigmas of heights within which they agree.
NO_HEIGHT, WITHIN = 1e4, 3.3


@dataclass(frozen=True)
class ClockOffset:
    """`seconds` to be added to the stamps of fixes, one sigma of it, and the gain of squared residuals in units of noise."""

    seconds: float
    sigma: float
    gain: float

    @property
    def is_clear(self) -> bool:
        """Whether the stamps of fixes are off."""
        return (
            self.gain > LEAST_GAIN
            and abs(self.seconds) > max(LEAST_SIGMAS * self.sigma, LEAST_OFFSET_S)
            and abs(self.seconds) < LARGEST_S - STEP_S
        )


def clock_offset(seconds: Floats, positions: Floats, antenna_at: Callable[[Floats], Floats]) -> ClockOffset | None:
    """The offset at which displacements of fixes fit those of odometry best; None where too few of them move.

    seconds : (F,) ascending; positions : (F, 3) m, east, north, up
    antenna_at : (N, 3) m of odometry, level, at (N,) s, NaN outside of the run
    """
    gaps = np.diff(seconds)
    if len(seconds) < FEWEST or gaps.min() <= 0:
        return None
    first, last = _pairs(seconds)
    moved = (positions[last] - positions[first])[:, :2]
    moved[~np.isfinite(moved).all(1)] = 1e9

    def off(offset: float) -> Floats:
        """(P, 2) residuals after the best turn."""
        there = antenna_at(seconds + offset)[:, :2]
        own = there[last] - there[first]
        return np.asarray(moved - (se2.rotation(_turn(own, moved)) @ own.T).T)

    offsets = np.arange(-LARGEST_S, LARGEST_S + 0.5 * STEP_S, STEP_S)
    sizes = np.stack([np.linalg.norm(off(float(offset)), axis=1) for offset in offsets])
    inside = np.isfinite(sizes)
    costs = np.array(
        [
            np.median(row[ok]) if ok.sum() >= max(FEWEST, 0.6 * len(first)) else np.inf
            for row, ok in zip(sizes, inside, strict=True)
        ]
    )
    best = int(np.argmin(costs))
    both = inside[best] & np.isfinite(unmoved := np.linalg.norm(off(0.0), axis=1))
    if not np.isfinite(costs[best]) or not both.any():
        return None
    # Displacements that share a second share their errors.
    shared = max(float(np.median(last - first)), 1.0)
    noise = _robust_sigma(off(float(offsets[best]))[both])
    at, sigma, is_curved = float(offsets[best]), 2.0 * STEP_S, False
    for _ in range(4):
        around = at + 4.0 * max(sigma, 1e-3) * np.linspace(-1.0, 1.0, 17)
        there = [off(float(offset)) for offset in around]
        sums = np.array([_sum_of_squares(np.linalg.norm(one, axis=1)[both] / noise) / shared for one in there])
        curve, slope, _ = np.polyfit(around, sums, 2)
        is_curved = curve > 0
        if not is_curved:
            sigma *= 2.0
            continue
        at = float(np.clip(-slope / (2 * curve), around[0], around[-1]))
        sigma = float(1.0 / np.sqrt(curve))
        noise = _robust_sigma(there[int(np.argmin(sums))][both])
    if not is_curved:
        return None
    reached = _sum_of_squares(np.linalg.norm(off(at), axis=1)[both] / noise) / shared
    return ClockOffset(at, sigma, _sum_of_squares(unmoved[both] / noise) / shared - reached)


def _pairs(seconds: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First and last fixes of pairs about a second apart."""
    lag = max(LAG_S, 0.999 * float(np.median(np.diff(seconds))))
    last = np.searchsorted(seconds, seconds + lag)
    first = np.flatnonzero(last < len(seconds))
    near = seconds[last[first]] - seconds[first] < 3.0 * lag
    return first[near], last[first][near]


def _turn(own: Floats, displacements: Floats) -> float:
    """Rotation, rad, that aligns displacements `own` (P, 2) of odometry with `displacements` (P, 2) of fixes.

    Pairs without odometry or too long are ignored.
    """
    ok = np.isfinite(own).all(1)
    turn, weights = 0.0, ok.astype(float)
    for _ in range(4):
        a, b, w = own[ok], displacements[ok], weights[ok]
        turn = heading_change(a, b, w)
        off = np.linalg.norm(displacements - (se2.rotation(turn) @ np.nan_to_num(own).T).T, axis=1)
        scale = max(float(np.median(off[ok])) if ok.any() else 1.0, 1e-4)
        weights = ok / (1.0 + (off / (2.0 * scale)) ** 2)
    return turn


def heading_change(a: Floats, b: Floats, weights: Floats) -> float:
    """rad, by which vectors `a` (P, 2 or 3) are turned about z to fit `b`: least squares with the `weights` (P,)."""
    across = weights @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    return float(np.arctan2(across, weights @ (a[:, :2] * b[:, :2]).sum(1)))


def _robust_sigma(residuals: Floats) -> float:
    """Sigma, m, of residuals (N, 2), m, by their median; 0.1 mm at least, and 1 m where none is finite."""
    ok = np.isfinite(residuals).all(1)
    return max(float(MAD * np.median(np.abs(residuals[ok]))), 1e-4) if ok.any() else 1.0


def _sum_of_squares(sizes: Floats) -> float:
    """Robust sum of squares of residuals in sigmas: each counts as five at most, and a NaN as the mean of the others."""
    ok = np.isfinite(sizes)
    return float((np.minimum(sizes[ok], 5.0) ** 2).sum() * len(sizes) / max(ok.sum(), 1))


def actual_sigmas(seconds: Floats, residuals: Floats, sigmas: Floats, probability: float) -> Floats | None:
    """(3,) ratios of the actual to the stated sigma per axis, at least 1; None where the statement holds for all.

    seconds : (F,) ascending; residuals : (F, 3) m, fixes minus trajectory, roughly aligned; sigmas : (F, 3) m, stated
    probability : of the test, below 1

    Differences of successive fixes contain no drift of odometry: if they scatter by more than is stated, the statement is
    wrong, and the sigma is that of the scatter within half a minute.
    """
    gaps = np.diff(seconds)
    near = (gaps > 0) & (gaps <= 1.5 * np.median(gaps)) if len(gaps) else np.zeros(0, bool)
    if near.sum() < FEWEST:
        return None
    scaled = residuals / sigmas
    steps = np.diff(scaled, axis=0)[near]
    white = np.array([_noise_beside_outliers(axis, probability) for axis in steps.T])
    wrong = white > 1.0
    if not wrong.any():
        return None
    number = ((seconds - seconds[0]) // WINDOW_S).astype(np.intp)
    parts = [scaled[number == n] for n in np.unique(number)]
    scatter = [MAD * np.median(np.abs(p - np.median(p, axis=0)), axis=0) for p in parts if len(p) >= FEWEST]
    total = np.maximum(np.median(scatter, axis=0) if scatter else 0.0, white)
    return np.asarray(np.where(wrong, np.maximum(total, 1.0), 1.0))


def _noise_beside_outliers(steps: Floats, probability: float) -> float:
    """Maximum-likelihood sigma of the fixes' differences, in stated sigmas; 1 unless that is significantly too small.

    steps : (N,) normalised differences of two fixes. Some are outliers, log-uniform in size, so that a third of wrong fixes
    does not count as scatter.
    """
    sizes = np.abs(steps - np.median(steps))
    wide = 1.0 / (np.maximum(sizes, 1.0) * 2.0 * (1.0 + np.log(max(float(sizes.max()), 2.0))))
    factors = np.concatenate([[1.0], np.geomspace(1.05, max(float(sizes.max()), 1.1), 80)])
    fits = []
    for factor in factors:
        narrow = np.exp(-0.25 * (sizes / factor) ** 2) / (factor * np.sqrt(4.0 * np.pi))
        fits.append(max(float(np.log((1 - share) * narrow + share * wide).sum()) for share in OUTLIERS))
    best = int(np.argmax(fits))
    # Adjacent differences share an error.
    gain = 2.0 * (fits[best] - fits[0]) / 1.5
    return float(factors[best]) if gain > quantile(probability, 1) else 1.0


def rough_residuals(seconds: Floats, antenna: Floats, positions: Floats) -> Floats:
    """Residuals (F, 3), m: fixes `positions` (F, 3) minus level `antenna` (F, 3) after a robust fit of heading and translation.

    seconds : (F,). The initial heading is that of displacements, which a jump of all fixes does not change.
    """
    far = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    first, last = _pairs(seconds)
    R = np.eye(3)
    own, moved = ((places[last] - places[first])[:, :2] for places in (antenna, positions))
    R[:2, :2] = se2.rotation(_turn(own, moved))
    off = positions - antenna @ R.T
    for _ in range(20):
        off = off - np.median(off, axis=0)
        size = np.linalg.norm(off[:, :2], axis=1)
        scale = max(float(np.median(size)), 1e-3)
        weights = (far < 1e5) / (1.0 + (size / (2.0 * scale)) ** 2)
        w = weights / weights.sum()
        a, b = antenna - w @ antenna, positions - w @ positions
        R[:2, :2] = se2.rotation(heading_change(a, b, w))
        off = b - a @ R.T
    return off - np.median(off, axis=0)


def agreeing_heights(off: Floats, sigmas: Floats) -> Bools:
    """(F,) whether the height of each fix belongs to the majority's level; off : (F,) m, of fixes minus trajectory."""
    order = np.argsort(off, kind="stable")
    values, reach = off[order], WITHIN * sigmas[order]
    counts = np.searchsorted(values, values + reach, side="right") - np.searchsorted(values, values - reach)
    level = values[int(np.argmax(counts))]
    near = np.abs(off - level) <= WITHIN * sigmas
    return np.asarray(np.abs(off - np.median(off[near])) <= WITHIN * sigmas)


def height_levels(off: Floats, sigmas: Floats) -> Floats:
    """(F,) m, level of each height above that of the first ones: the sum of the jumps between successive fixes before it.

    off : (F,) m, of fixes minus trajectory, in order of time; sigmas : (F,) m

    Medians before and after a fix differ by a jump, while a tilt and odometry's drift change them little. A jump exceeds
    the sigma of a height, and the scatter of such differences elsewhere.
    """
    levels = np.zeros(len(off))
    if len(off) < 2 * FEWEST:
        return levels
    medians = np.median(np.lib.stride_tricks.sliding_window_view(off, FEWEST), axis=1)
    steps = medians[FEWEST:] - medians[:-FEWEST]
    usual = MAD * float(np.median(np.abs(steps - np.median(steps))))
    least = WITHIN * np.maximum(sigmas[FEWEST : FEWEST + len(steps)], 1.5 * usual)
    sizes = np.abs(steps) * (np.abs(steps) > least)
    while sizes.any():
        at = int(np.argmax(sizes))
        near, before, after = off[at : at + 2 * FEWEST], medians[at], medians[at + FEWEST]
        first = at + int(np.argmax(np.cumsum((near - after) ** 2 - (near - before) ** 2))) + 1
        levels[first:] += steps[at]
        sizes[max(at - FEWEST + 1, 0) : at + FEWEST] = 0.0
    return levels
