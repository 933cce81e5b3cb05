"""Readings beyond the range of an IMU: how they are told from the data, what they may have been, and how sure that is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lslam.core.types.arrays import Bools, Floats
from lslam.core.types.imu import ImuStream

# The narrowest ranges sold: a device of less than 2 g cannot hold gravity and a push, one of 125 deg/s is made for cars.
LEAST_FORCE, LEAST_RATE = 13.0, np.deg2rad(100)
# So many samples in a row at one and the same extreme are its end: noise alone repeats no extreme.
ROW_SAMPLES = 3
# And more of them than times as many as on the next reading: a smooth top that ends within its highest bit stands on that at
# most sqrt(2) + 1 times as long as on the one below.
PILED_RATIO = 2.42
# A device has one range. Its two ends differ by a bit of 12 or more (5e-4), and from axis to axis by scales and offsets, which
# are some per cent.
BIT, ALIKE = 1e-3, 0.9
# What is hidden is between the end of the range and as much again: half of that in the mean, and at the most.
HIDDEN_RANGE_SHARE = 0.5
# s from an edge of a cut until nothing of it tells how far beyond the range a reading is: vehicles and arms do not follow
# faster, flights turn over in a few tenths.
FORGOTTEN_S = 0.2


def with_hidden(imu: ImuStream, notes: list[str]) -> ImuStream:
    """The stream with what its range cut off filled in, and one sigma of that as `hidden`; the same where nothing was.

    Over a cut the reading goes on with the slopes it has at the edges and flattens towards its top, yet not beyond
    `HIDDEN_RANGE_SHARE` of the range; its sigma is what was added, and more the farther the edges are.
    """
    if imu.clipping_sigma is not None:
        # Filled before: what it was filled with is no range.
        return imu
    seconds = (imu.stamps_ns - imu.stamps_ns[0]) * 1e-9 if len(imu) else np.zeros(0)
    parts, hidden, words = [], [], []  # readings, sigmas, words
    for values, least, unit, name in (
        (imu.accel, LEAST_FORCE, "m/s2", "accelerometer"),
        (imu.gyro, LEAST_RATE, "rad/s", "gyroscope"),
    ):
        cut = _cuts(values, least)
        filled = np.stack([_excess(seconds, values[:, k], cut[:, k]) for k in range(3)], axis=-1)
        parts.append(values + np.sign(values) * filled[0])
        hidden.append(filled[1])
        if cut.any():
            limit = float(np.abs(values).max())
            words.append(f"{int(cut.any(axis=1).sum())} at the {limit:.4g} {unit} of its {name}")
    if not words:
        return imu
    notes.append(
        f"IMU: of {len(imu)} samples {' and '.join(words)}, the end of the range: what is beyond is filled in smoothly, and "
        "trusted the less"
    )
    return replace(imu, accel=parts[0], gyro=parts[1], clipping_sigma=np.hstack(hidden))


def _cuts(values: Floats, least: float) -> Bools:
    """(M, 3) where readings (M, 3) sit at an end of the range, which is `least` or more either way.

    Every axis has an upper and a lower end of its own: 16 bits read from -32768 to +32767, and scales differ. An extreme is
    an end where it stands in a row, `PILED_RATIO`, or is within a bit of one that does; not where others of the device go far
    beyond.
    """
    if len(values) < ROW_SAMPLES:
        return np.zeros(values.shape, bool)
    # (M, 6): upwards and downwards.
    sizes = np.hstack([values, -values])
    extremes = sizes.max(axis=0)
    at = sizes >= extremes * (1 - 1e-9)
    may_be = extremes >= max(least, ALIKE * float(extremes.max()))
    stands = may_be & np.lib.stride_tricks.sliding_window_view(at, ROW_SAMPLES, axis=0).all(axis=-1).any(axis=0)
    below = np.where(at, -np.inf, sizes).max(axis=0)
    stands &= at.sum(axis=0) > PILED_RATIO * (sizes == below).sum(axis=0)
    alike = np.abs(extremes[:, None] - extremes[stands]) <= BIT * extremes[stands]
    at &= may_be & alike.any(axis=1)
    return np.asarray(at[:, :3] | at[:, 3:])


def _excess(seconds: Floats, values: Floats, cut: Bools) -> Floats:
    """(2, M) by how much readings (M,) at an end of the range were likely beyond it, and one sigma of that."""
    beyond = np.zeros((2, len(values)))
    size = np.abs(values)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], cut, [False]]).astype(np.int8)))
    for first, end in edges.reshape(-1, 2).tolist():
        most = HIDDEN_RANGE_SHARE * float(size[first])
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
        beyond[1, first:end] = np.maximum(beyond[0, first:end], most * np.minimum(away / FORGOTTEN_S, 1.0))
    return beyond


def _slope(seconds: Floats, values: Floats, i: int, j: int) -> float:
    if i < 0 or j >= len(values):
        return 0.0
    return float((values[j] - values[i]) / max(seconds[j] - seconds[i], 1e-9))
