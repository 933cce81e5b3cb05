"""A raw IMU stream made usable, or refused: order, units, gaps."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from lslam.core.types.arrays import Floats, Longs
from lslam.core.types.imu import GRAVITY, ImuStream, WheelStream
from lslam.odometry.inertial.saturation import with_hidden
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
    """What is wrong with an IMU that is refused, where a program can tell."""

    UNKNOWN = "unknown"
    GYRO_IN_DEGREES = "gyro-in-degrees"


class ImuRefusedError(Exception):
    """The IMU cannot be used: `what` is wrong, the `way_out`, empty where none is known, and the `fault`."""

    def __init__(self, what: str, way_out: str = "", fault: ImuFault = ImuFault.UNKNOWN) -> None:
        super().__init__(f"{what}: {way_out}" if way_out else what)
        self.what, self.way_out, self.fault = what, way_out, fault


@dataclass(frozen=True)
class Cleaned:
    """A stream in increasing time and SI units, and what was done to it, one sentence each."""

    imu: ImuStream
    notes: list[str]

    @property
    def rate_hz(self) -> float:
        """Samples per second."""
        return rate_of(self.imu)


def clean(imu: ImuStream, first_ns: int, last_ns: int) -> Cleaned:
    """Drop what is not finite or goes back in time, convert g to m/s2.

    Raises ImuRefusedError for a stream that says nothing about the time from `first_ns` to `last_ns`, stands still, has too
    many bad samples, or measures no gravity.
    """
    notes: list[str] = []
    imu = _ordered(imu, notes)
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
    cleaned = Cleaned(with_hidden(replace(imu, accel=accel), notes), notes)
    if is_slow(cleaned.rate_hz):
        notes.append(
            f"IMU at {cleaned.rate_hz:.0f} Hz, which degrades what it is good for: it predicts the motion from scan to scan, "
            f"but is too slow to see shaking within a scan ({LEAST_RATE_HZ:.0f} Hz would do)"
        )
    return cleaned


def rate_of(imu: ImuStream) -> float:
    """Samples per second; 0 for a stream whose time stands."""
    steps = np.diff(imu.stamps_ns)
    forward = steps[steps > 0]
    return 1e9 / float(np.median(forward)) if len(forward) else 0.0


def is_slow(rate_hz: float) -> bool:
    """Whether a stream of that rate cannot tell how the sensor moves within a sweep; nothing is said of time that stands."""
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
    """(G, 2) ns: begin and end of every stretch that no sample tells of, before and after all included.

    In a pause longer than `longest_s` half of that after the last sample and before the next is still known as well as in
    one that is no longer. Pauses of a slow stream are not gaps: half a step more than usual is.
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


def _ordered(imu: ImuStream, notes: list[str]) -> ImuStream:
    """Finite samples in increasing time."""
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
    return "(" + ", ".join(f"{v:.4g}" for v in values) + ")"
