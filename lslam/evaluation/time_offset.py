"""The shift between two clocks, from what both trajectories say about the motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError
from lslam.evaluation.associate import LEAST, nearest_one_to_one, time_range
from lslam.geometry import interpolate, so3
from lslam.types.trajectory import Trajectory

Floats = NDArray[np.float64]
LEAST_OVERLAP = 0.6  # of the shorter trajectory
LEAST_SCORE = 0.8
SAME_STAMPS_NS = 1_000_000
WINDOW = 5
AMBIGUOUS = 1.2


def estimate_offset(estimate: Trajectory, truth: Trajectory) -> tuple[int, float]:
    """Shift in ns to add to the estimate's stamps, and the correlation (0..1) that speaks for it.

    Speed and rotation rate, which no frame changes, are correlated over all shifts in which at least 60 % of the shorter
    trajectory overlaps; the best one is refined between samples. When the stamps then agree up to one constant to 1 ms,
    that constant is the answer.

    Raises
    ------
    InputError when a trajectory has no stamps or fewer than 3 poses, or when the motion does not determine the shift.
    """
    for which, t in (("estimate", estimate), ("ground truth", truth)):
        if not t.has_stamps or len(t) < LEAST:
            raise InputError(f"--time-offset auto: {which} {t.source} has no stamps or fewer than {LEAST} poses")
    step = _step(estimate, truth)
    a, b = _rates(estimate, step), _rates(truth, step)
    if min(len(a), len(b)) < 10:
        raise InputError(f"--time-offset auto: the trajectories are shorter than 15 samples of {step / 1e9:.2f} s")
    scores, lags = _correlation(a, b)
    if not len(scores) or scores.max() < LEAST_SCORE:
        highest = f"{scores.max():.2f}" if len(scores) else "none"
        raise InputError(
            f"--time-offset auto: the speeds and turns of both trajectories fit nowhere (best correlation {highest}, "
            f"{LEAST_SCORE} needed; estimate {time_range(estimate)}, ground truth {time_range(truth)}); "
            "give the offset in seconds"
        )
    zero = int(truth.stamps_ns[0]) - int(estimate.stamps_ns[0])
    peaks = _peaks(scores, lags)
    refined = [(_refine(estimate, truth, zero + int(lags[p]) * step, step), p) for p in peaks]
    (cost, offset, best), *others = sorted((cost, offset, p) for (offset, cost), p in refined)
    if others and others[0][0] <= AMBIGUOUS * cost + 1e-9:
        raise InputError(
            f"--time-offset auto: {offset / 1e9:.3f} s and {others[0][1] / 1e9:.3f} s fit alike; give the offset in seconds"
        )
    return _snap(estimate, truth, offset, step), float(scores[best])


def _peaks(scores: Floats, lags: NDArray[np.int64]) -> list[int]:
    """Indices of the best scores that are neither poor nor neighbours of a better one, at most 20."""
    chosen: list[int] = []
    for k in np.argsort(-scores, kind="stable")[:2000].tolist():
        if scores[k] < LEAST_SCORE or len(chosen) == 20:
            break
        if all(abs(int(lags[k] - lags[c])) > 2 * WINDOW for c in chosen):
            chosen.append(k)
    return chosen


def _step(estimate: Trajectory, truth: Trajectory) -> int:
    """Sample distance, ns: the coarser of both, so that noise between dense poses averages out."""
    slow = max(float(np.median(np.diff(t.stamps_ns))) for t in (estimate, truth))
    return int(np.clip(slow, 50_000_000, 1_000_000_000))


def _rates(t: Trajectory, step: int, first: int | None = None, count: int | None = None) -> Floats:
    """(M, 2) speed m/s and rotation rate rad/s, a sample every `step` ns, each over WINDOW samples against pose noise."""
    first = int(t.stamps_ns[0]) if first is None else first
    if count is None:
        count = int((t.stamps_ns[-1] - t.stamps_ns[0]) // step) + 1
    if count <= WINDOW:
        return np.zeros((0, 2))
    poses = interpolate.poses_at(t.stamps_ns, t.poses, first + step * np.arange(count))
    start, end = poses[:-WINDOW], poses[WINDOW:]
    speed = np.linalg.norm(end[:, :3, 3] - start[:, :3, 3], axis=1)
    turn = so3.angle(np.swapaxes(start[:, :3, :3], -1, -2) @ end[:, :3, :3])
    return np.stack([speed, turn], axis=1) * (1e9 / (WINDOW * step))


def _correlation(a: Floats, b: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Pearson correlation of a shifted by lag against b, mean of the channels that vary, and the lags."""
    from scipy.signal import correlate

    n, m = len(a), len(b)
    lags = np.arange(-(n - 1), m)
    overlap = np.rint(correlate(np.ones(m), np.ones(n), method="fft"))
    allowed = overlap >= max(LEAST_OVERLAP * min(n, m), 10)
    total = np.zeros(len(lags))
    channels = 0
    for k in range(a.shape[1]):
        x, y = a[:, k] - a[:, k].mean(), b[:, k] - b[:, k].mean()
        spread = min(float(x.std()), float(y.std()))
        if spread < (0.02, 0.002)[k]:
            continue
        sx, sy = correlate(np.ones(m), x, method="fft"), correlate(y, np.ones(n), method="fft")
        sxx, syy = correlate(np.ones(m), x * x, method="fft"), correlate(y * y, np.ones(n), method="fft")
        count = np.maximum(overlap, 1)
        cov = correlate(y, x, method="fft") - sx * sy / count
        var_x, var_y = sxx - sx * sx / count, syy - sy * sy / count
        # A stretch that hardly varies correlates with anything: such shifts count as no evidence.
        floor = 0.05 * count
        enough = (var_x > floor * x.var()) & (var_y > floor * y.var())
        total += np.where(enough, cov / np.sqrt(np.where(enough, var_x * var_y, 1.0)), 0.0)
        channels += 1
    if channels == 0:
        return np.zeros(0), np.zeros(0, np.int64)
    return total[allowed] / channels, lags[allowed]


def _refine(estimate: Trajectory, truth: Trajectory, start: int, step: int) -> tuple[int, float]:
    """The shift within one sample of `start` at which the rates differ least, and by how much (0..1)."""
    from scipy.optimize import minimize_scalar

    low = max(int(estimate.stamps_ns[0]), int(truth.stamps_ns[0]) - start + step)
    high = min(int(estimate.stamps_ns[-1]), int(truth.stamps_ns[-1]) - start - step)
    count = (high - low) // step + 1
    if count < WINDOW + 3:
        return start, 1.0
    own = _rates(estimate, step, low, count)
    scale = own.std(axis=0) + np.array([0.02, 0.002])

    def cost(shift: float) -> float:
        other = _rates(truth, step, low + start + round(shift), count)
        return float(np.mean(np.minimum(np.abs(own - other) / scale, 1.0) ** 2))

    best = minimize_scalar(cost, bounds=(-step, step), method="bounded", options={"xatol": 1e4})
    return start + round(float(best.x)), float(best.fun)


def _snap(estimate: Trajectory, truth: Trajectory, offset: int, step: int) -> int:
    """The exact constant when both files carry the same stamps on two clocks."""
    stamps = estimate.stamps_ns + offset
    i, j = nearest_one_to_one(stamps, truth.stamps_ns, step // 2)
    if len(i) < LEAST:
        return offset
    rest = truth.stamps_ns[j] - stamps[i]
    middle = int(np.median(rest))
    is_constant = float(np.mean(np.abs(rest - middle) <= SAME_STAMPS_NS)) >= 0.9
    return offset + middle if is_constant else offset
