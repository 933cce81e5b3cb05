"""Readings beyond the range of an IMU: how they are told from the data, what they may have been, and how sure that is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lslam.types.imu import ImuStream

Floats = NDArray[np.float64]

# The narrowest ranges sold: a device of less than 2 g cannot hold gravity and a push, one of 125 deg/s is made for cars.
LEAST_FORCE, LEAST_RATE = 13.0, np.deg2rad(100)
# So many samples in a row at one and the same extreme are its end: noise alone repeats no extreme.
ROW = 3
# What is hidden is between the end of the range and as much again: half of that in the mean, and at the most.
HIDDEN = 0.5
# s from an edge of a cut until nothing of it tells how far beyond the range a reading is: vehicles and arms do not follow
# faster, flights turn over in a few tenths.
FORGOTTEN = 0.2


def with_hidden(imu: ImuStream, notes: list[str]) -> ImuStream:
    """The stream with what its range cut off filled in, and one sigma of that as `hidden`; the same where nothing was.

    Over a cut the reading goes on with the slopes it has at the edges and flattens towards its top, yet not beyond `HIDDEN`
    of the range; its sigma is what was added, and more the farther the edges are.
    """
    if imu.hidden is not None:
        # Filled before: what it was filled with is no range.
        return imu
    seconds = (imu.stamps_ns - imu.stamps_ns[0]) * 1e-9 if len(imu) else np.zeros(0)
    parts, hidden, said = [], [], []  # readings, sigmas, words
    for values, least, unit, name in (
        (imu.accel, LEAST_FORCE, "m/s2", "accelerometer"), (imu.gyro, LEAST_RATE, "rad/s", "gyroscope")
    ):  # fmt: skip
        limit = float(np.abs(values).max(initial=0.0))
        cut = _cuts(values, limit) if limit >= least else np.zeros(values.shape, bool)
        filled = np.stack([_excess(seconds, values[:, k], cut[:, k], HIDDEN * limit) for k in range(3)], axis=-1)
        parts.append(values + np.sign(values) * filled[0])
        hidden.append(filled[1])
        if cut.any():
            said.append(f"{int(cut.any(axis=1).sum())} at the {limit:.4g} {unit} of its {name}")
    if not said:
        return imu
    notes.append(
        f"IMU: of {len(imu)} samples {' and '.join(said)}, the end of the range: what is beyond is filled in smoothly, and "
        "trusted the less"
    )
    return replace(imu, accel=parts[0], gyro=parts[1], hidden=np.hstack(hidden))


def _cuts(values: Floats, limit: float) -> NDArray[np.bool_]:
    """(M, 3) where readings (M, 3) sit at either end of the range, and have done so `ROW` times in a row on some axis."""
    at = np.abs(values) >= limit * (1 - 1e-9)
    same = at[1:] & at[:-1] & (np.sign(values[1:]) == np.sign(values[:-1]))
    rows = (
        np.lib.stride_tricks.sliding_window_view(same, ROW - 1, axis=0) if len(same) >= ROW - 1 else same[:0, :, None]
    )
    return at if rows.all(axis=-1).any() else np.zeros(values.shape, bool)


def _excess(seconds: Floats, values: Floats, cut: NDArray[np.bool_], most: float) -> Floats:
    """(2, M) by how much readings (M,) at the end of the range were likely beyond it, and one sigma of that."""
    beyond = np.zeros((2, len(values)))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], cut, [False]]).astype(np.int8)))
    for first, end in edges.reshape(-1, 2).tolist():
        size = np.abs(values)
        rise = max(_slope(seconds, size, first - 2, first - 1), 0.0)
        fall = max(-_slope(seconds, size, end, end + 1), 0.0)
        t = seconds[first:end]
        since = rise * (t - seconds[max(first - 1, 0)])
        until = fall * (seconds[end] - t) if end < len(values) else np.full(len(t), np.inf)
        # Between the lines through both edges, flattening towards half of where they meet: there a cubic would have its top.
        line = np.minimum(since, until)
        top = max(min(0.5 * float(line.max()), most), 1e-12)
        line = np.minimum(line, 2 * top)
        beyond[0, first:end] = line * (1 - line / (4 * top))
        away = np.minimum(t - seconds[max(first - 1, 0)], (seconds[end] if end < len(values) else np.inf) - t)
        beyond[1, first:end] = np.maximum(beyond[0, first:end], most * np.minimum(away / FORGOTTEN, 1.0))
    return beyond


def _slope(seconds: Floats, values: Floats, i: int, j: int) -> float:
    if i < 0 or j >= len(values):
        return 0.0
    return float((values[j] - values[i]) / max(seconds[j] - seconds[i], 1e-9))
