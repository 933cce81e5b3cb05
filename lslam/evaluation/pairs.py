"""Which pairs of poses a relative error compares. The rules for scans and metres are evo's, tie by tie."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Pairs = NDArray[np.int64]
TOLERANCE = 0.1  # of the distance, for pairs that must be as far apart as asked

RULES = {
    ("scan", "consecutive"): "each pose with the one `delta` later, end to end",
    ("scan", "all"): "every pose with the one `delta` later, overlapping",
    ("m", "consecutive"): "end to end, a pair ends where the estimate has travelled `delta` or more",
    ("m", "all"): "every pose with the later one whose distance along the estimate is nearest `delta`, within 10 %",
    ("s", "consecutive"): "end to end, each with the later pose whose stamp is nearest `delta` later, within 10 %",
    ("s", "all"): "every pose with the later one whose stamp is nearest `delta` later, within 10 %",
}


def by_index(count: int, delta: int, all_pairs: bool) -> Pairs:
    """Pairs (M, 2) of poses `delta` indices apart."""
    starts = np.arange(0, max(count - delta, 0), 1 if all_pairs else delta, dtype=np.int64)
    return np.stack([starts, starts + delta], axis=1)


def by_path(positions: NDArray[np.float64], delta: float, all_pairs: bool) -> Pairs:
    """Pairs (M, 2) of poses `delta` metres of path apart, `positions` (N, 3) of the estimate."""
    if all_pairs:
        steps = np.linalg.norm(positions[:-1] - positions[1:], axis=1)
        return _nearest(np.concatenate([[0.0], np.cumsum(steps)]), delta)
    ends, travelled = [0], 0.0
    for i in range(1, len(positions)):
        # One norm at a time and a sum that restarts: the last bit decides pairs on evenly spaced poses.
        travelled += float(np.linalg.norm(positions[i] - positions[i - 1]))
        if travelled >= delta:
            ends.append(i)
            travelled = 0.0
    return np.stack([ends[:-1], ends[1:]], axis=1).astype(np.int64)


def by_time(seconds: NDArray[np.float64], delta: float, all_pairs: bool) -> Pairs:
    """Pairs (M, 2) of poses `delta` seconds apart, `seconds` (N,) increasing."""
    every = _nearest(seconds, delta)
    if all_pairs:
        return every
    end_of = dict(every.tolist())
    chain, i = [], 0
    while i < len(seconds):
        if i in end_of:
            chain.append((i, end_of[i]))
        i = end_of.get(i, i + 1)
    return np.array(chain, np.int64).reshape(-1, 2)


def _nearest(along: NDArray[np.float64], delta: float) -> Pairs:
    """Every i with the first j > i whose `along[j] - along[i]` is nearest `delta`, dropped when off by over 10 %."""
    tolerance = delta * TOLERANCE
    slack = 1e-9 * max(abs(float(along[-1])), delta, 1.0)
    low = np.searchsorted(along, along + (delta - tolerance - slack), side="left")
    high = np.searchsorted(along, along + (delta + tolerance + slack), side="right")
    pairs = []
    for i in range(len(along) - 1):
        first = max(int(low[i]), i + 1)
        if first >= high[i]:
            continue
        off = np.abs(along[first : high[i]] - along[i] - delta)
        best = int(np.argmin(off))
        if off[best] <= tolerance:
            pairs.append((i, first + best))
    return np.array(pairs, np.int64).reshape(-1, 2)
