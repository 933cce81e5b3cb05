"""A raw IMU stream made usable, or refused: order, units, gaps, and readings beyond the range of the device.

How the latter are told from the data, what they may have been, and how sure that is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from lslam.core.arrays import Bools, Floats, Longs
from lslam.core.types.imu import GRAVITY, ImuStream, WheelStream
from lslam.odometry.kernels.strapdown import overlaps

# Mean specific force over whole seconds, in g: bends and a poor accelerometer's bias included.
PLAUSIBLE_G = (0.8, 1.2)
# s over which a vehicle's heave (1 to 2 Hz) averages out and a straight stretch between bends does not.
CALM_S = 1.0
# A stream slower than this cannot tell how the sensor moves within a sweep of 0.1 s.
LEAST_RATE_HZ = 50.0
# s; time without samples of the IMU, or readings of wheels, beyond which a scan falls back to constant velocity.
IMU_GAP_S, WHEEL_GAP_S = 0.1, 0.2
# Clocks differ by some ppm, and drivers round their periods: nearer to that rate than a twentieth is that rate.
RATE_SLACK_SHARE = 0.05
MOST_BAD_SHARE = 0.1


class ImuFault(StrEnum):
    """Fault of a refused IMU, as a code for programs."""

    UNKNOWN = "unknown"
    GYRO_IN_DEGREES = "gyro-in-degrees"


class ImuRefusedError(Exception):
    """The IMU cannot be used: `what` is wrong, the `way_out`, empty where none is known, and the `fault`."""

    def __init__(self, what: str, way_out: str = "", fault: ImuFault = ImuFault.UNKNOWN) -> None:
        super().__init__(f"{what}: {way_out}" if way_out else what)
        self.what, self.way_out, self.fault = what, way_out, fault


@dataclass(frozen=True)
class CleanStream:
    """A stream in increasing time and SI units, and what was done to it, one sentence each."""

    imu: ImuStream
    notes: list[str]

    @property
    def rate_hz(self) -> float:
        """Samples per second."""
        return rate_of(self.imu)


def clean(imu: ImuStream, first_ns: int, last_ns: int) -> CleanStream:
    """Drop samples that are not finite or go back in time, convert g to m/s2, fill in saturated readings.

    Raises ImuRefusedError for a stream without samples between `first_ns` and `last_ns`, with constant readings, too many bad
    samples, or no gravity.
    """
    notes: list[str] = []
    imu = _sort(imu, notes)
    shared = (imu.stamps_ns >= first_ns) & (imu.stamps_ns <= last_ns)
    if shared.sum() < 2:
        lo, hi = imu.stamps_ns[0] - first_ns, imu.stamps_ns[-1] - first_ns
        raise ImuRefusedError(
            f"its {len(imu)} samples run from {lo * 1e-9:.3f} to {hi * 1e-9:.3f} s after the first scan, the scans to "
            f"{(last_ns - first_ns) * 1e-9:.3f} s",
            "correct its stamps or set imu.time_offset_s",
        )
    for what, values in (("gyroscope", imu.gyro[shared]), ("accelerometer", imu.accel[shared])):
        if not np.ptp(values, axis=0).any():
            raise ImuRefusedError(f"its {what} repeats one reading, {_text(values[0])}, all the time")
    accel = _in_si(imu, notes)
    cleaned = CleanStream(fill_saturation(replace(imu, accel=accel), notes), notes)
    if is_slow(cleaned.rate_hz):
        notes.append(
            f"IMU at {cleaned.rate_hz:.0f} Hz, which degrades what it is good for: it predicts the motion from scan to scan, "
            f"but is too slow to see shaking within a scan ({LEAST_RATE_HZ:.0f} Hz would do)"
        )
    return cleaned


def rate_of(imu: ImuStream) -> float:
    """Samples per second; 0 for a stream whose stamps do not advance."""
    steps = np.diff(imu.stamps_ns)
    forward = steps[steps > 0]
    return 1e9 / float(np.median(forward)) if len(forward) else 0.0


def is_slow(rate_hz: float) -> bool:
    """True if the stream's rate is too low for the motion within a sweep; False for constant stamps."""
    return 0 < rate_hz < (1 - RATE_SLACK_SHARE) * LEAST_RATE_HZ


def gravity_unit(imu: ImuStream) -> tuple[float, str | None]:
    """Norm of the calmest specific force, as measured, and the unit in which that is gravity; None when in none.

    The calmest twentieth decides: long bends add up to more than gravity's tolerance.
    """
    calm = float(np.percentile(np.linalg.norm(mean_forces(imu), axis=1), 5))
    lo, hi = PLAUSIBLE_G
    return calm, "m/s2" if lo <= calm / GRAVITY <= hi else "g" if lo <= calm <= hi else None


def mean_forces(imu: ImuStream) -> Floats:
    """(W, 3) specific force averaged over `CALM_S` each, W >= 1: what shakes does not look like more or less gravity."""
    step = float(np.median(np.diff(imu.stamps_ns))) * 1e-9
    width = min(max(round(CALM_S / step), 1) if step > 0 else 1, len(imu))
    return np.asarray(imu.accel[: len(imu) // width * width].reshape(-1, width, 3).mean(axis=1))


def gaps(imu: ImuStream | WheelStream, longest_s: float) -> Longs:
    """(G, 2) ns: begin and end of every stretch without samples, before the first and after the last included.

    A pause is a gap if it exceeds `longest_s` and 1.5 times the median step; half of that limit next to each sample does not
    count as gap, so that short and long pauses are treated alike.
    """
    steps = np.diff(imu.stamps_ns)
    limit = max(1e9 * longest_s, 1.5 * float(np.median(steps)))
    pauses = np.flatnonzero(steps > limit)
    far, slack, half = np.iinfo(np.int64), int(limit), int(limit / 2)
    inner = np.stack([imu.stamps_ns[pauses] + half, imu.stamps_ns[pauses + 1] - half], axis=1)
    before = np.array([[far.min, imu.stamps_ns[0] - slack]])
    after = np.array([[imu.stamps_ns[-1] + slack, far.max]])
    return np.concatenate([before, inner, after])


def covers(silent: Longs, begin_ns: int, end_ns: int) -> bool:
    """Whether there are samples all the way from one instant to the other; silent : (G, 2) ns, the stream's `gaps`."""
    return not overlaps(silent, begin_ns, end_ns)


def _sort(imu: ImuStream, notes: list[str]) -> ImuStream:
    """Finite samples in increasing time; raises ImuRefusedError if too many of them are bad, or fewer than two remain."""
    finite = np.isfinite(imu.accel).all(axis=1) & np.isfinite(imu.gyro).all(axis=1)
    latest = np.maximum.accumulate(imu.stamps_ns) if len(imu) else imu.stamps_ns
    ahead = np.ones(len(imu), bool)
    ahead[1:] = imu.stamps_ns[1:] > latest[:-1]
    for bad, what in ((~finite, "are not finite"), (~ahead, "repeat a time or go back")):
        if bad.sum() > MOST_BAD_SHARE * len(imu):
            raise ImuRefusedError(f"{int(bad.sum())} of its {len(imu)} samples {what}")
        if bad.any():
            notes.append(f"IMU: {int(bad.sum())} of {len(imu)} samples {what} and are left out")
    good = finite & ahead
    if good.sum() < 2:
        raise ImuRefusedError(f"it has {int(good.sum())} usable samples")
    hidden = None if imu.clipping_sigma is None else imu.clipping_sigma[good]
    return ImuStream(imu.stamps_ns[good], imu.accel[good], imu.gyro[good], hidden)


def _in_si(imu: ImuStream, notes: list[str]) -> Floats:
    """Accelerations in m/s2, converted where the mean magnitude is in g; raises ImuRefusedError where it is neither."""
    norm, unit = gravity_unit(imu)
    if unit is None:
        raise ImuRefusedError(
            f"its mean specific force is {norm:.3g}, which is gravity neither in m/s2 (9.81) nor in g (1)",
            "check its unit, and that gravity was not taken off",
        )
    if unit == "g":
        notes.append(f"IMU: a mean specific force of {norm:.3f} is in g, converted to m/s2")
        return imu.accel * GRAVITY
    return imu.accel


def _text(values: Floats) -> str:
    """The values as a tuple in text, for messages."""
    return "(" + ", ".join(f"{v:.4g}" for v in values) + ")"


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


def fill_saturation(imu: ImuStream, notes: list[str]) -> ImuStream:
    """The stream with readings beyond its range estimated, and their sigmas as `clipping_sigma`; unchanged without such.

    Over a cut the reading continues with the slopes at its edges and flattens towards the top, within `HIDDEN_RANGE_SHARE`
    of the range; its sigma is the amount added, and more the farther the edges are.
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
        at_limit = _cuts(values, least)
        filled = np.stack([_excess(seconds, values[:, k], at_limit[:, k]) for k in range(3)], axis=-1)
        parts.append(values + np.sign(values) * filled[0])
        hidden.append(filled[1])
        if at_limit.any():
            limit = float(np.abs(values).max())
            words.append(f"{int(at_limit.any(axis=1).sum())} at the {limit:.4g} {unit} of its {name}")
    if not words:
        return imu
    notes.append(
        f"IMU: of {len(imu)} samples {' and '.join(words)}, the end of the range: what is beyond is filled in smoothly, and "
        "trusted the less"
    )
    return replace(imu, accel=parts[0], gyro=parts[1], clipping_sigma=np.hstack(hidden))


def _cuts(values: Floats, least: float) -> Bools:
    """(M, 3) whether each reading (M, 3) is at an end of the device's range, which is at least `least`.

    Every axis has an upper and a lower end of its own: 16 bits read from -32768 to +32767, and scales differ. An extreme is
    an end if it repeats in a row, piles up (`PILED_RATIO`), or is within a bit of such an end; not if other axes read far beyond.
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


def _excess(seconds: Floats, values: Floats, at_limit: Bools) -> Floats:
    """(2, M) estimated amount by which the readings (M,) at an end of the range exceeded it, and its sigma."""
    beyond = np.zeros((2, len(values)))
    size = np.abs(values)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], at_limit, [False]]).astype(np.int8)))
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
    """Slope of the readings between samples i and j, per s; 0 at an end of the stream."""
    if i < 0 or j >= len(values):
        return 0.0
    return float((values[j] - values[i]) / max(seconds[j] - seconds[i], 1e-9))
