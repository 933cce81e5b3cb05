"""The noise of a recording's IMU: by Allan deviation where it stands long enough, else by differences of readings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.doctor.findings import Facts
from lslam.inertial.imu_cleaning import GRAVITY, gravity_unit, rate_of
from lslam.inertial.initialise import STILL_FORCE, STILL_RATE
from lslam.types.imu import ImuStream

Floats = NDArray[np.float64]

# s of standing: white noise is read off the Allan deviation from the first on, where that has its least from the second.
_WHITE_S, _STABLE_S = 10.0, 120.0
# The Allan deviation over a time is known to a tenth or so where that fits nine times into the record (IEEE Std 952).
_FITS = 9
# m/s2 and rad/s per sqrt(Hz): no device is as quiet, so what is below is a simulated or a silent one.
_LEAST = 1e-8
# Flicker noise of bias instability B has the Allan deviation B sqrt(2 ln 2 / pi).
_FLAT = float(np.sqrt(2 * np.log(2) / np.pi))
# Variance of the third difference of white noise, over that of the noise: 1 + 9 + 9 + 1.
_THIRD = 20.0
# Median of the absolute value of a normal variable of sigma one.
_MEDIAN = 0.6745


@dataclass(frozen=True)
class Noise:
    """Of three axes of one kind, the root of their mean square.

    density : per sqrt(Hz); instability : of the bias, None where the sensor does not stand long enough; walk : of the bias,
        per sqrt(s), likewise, and where the Allan deviation rises at the end
    """

    density: float
    instability: float | None = None
    walk: float | None = None


def examine_noise(imu: ImuStream) -> Facts | None:
    """How noisy the IMU is and by which `method`; None for a stream of less than half a second or whose unit is unknown."""
    rate = rate_of(imu)
    if len(imu) < max(8, 0.5 * rate) or rate <= 0:
        return None
    unit = gravity_unit(imu)[1]
    if unit is None:
        return None
    accel = imu.accel * (GRAVITY if unit == "g" else 1.0)
    still = _longest_still(accel, imu.gyro, rate)
    seconds = (still.stop - still.start) / rate
    by_allan = seconds >= _WHITE_S
    kinds = []
    for values in (accel, imu.gyro):
        kinds.append(_by_allan(values[still], rate) if by_allan else Noise(_by_differences(values, rate)))
    return {
        "method": "allan" if by_allan else "differences",
        "standing_s": seconds,
        "rate_hz": rate,
        **{f"accel_{name}": value for name, value in vars(kinds[0]).items()},
        **{f"gyro_{name}": value for name, value in vars(kinds[1]).items()},
    }


def _longest_still(accel: Floats, gyro: Floats, rate: float) -> slice:
    """The longest stretch of whole seconds in which, and from one of which to the next, rates and forces hardly vary."""
    width = max(round(rate), 2)
    count = len(gyro) // width
    if not count:
        return slice(0, 0)
    parts = [values[: count * width].reshape(count, width, 3) for values in (gyro, accel)]
    calm = np.ones(count, bool)
    for part, limit in zip(parts, (STILL_RATE, STILL_FORCE), strict=True):
        calm &= part.std(axis=1).max(axis=1) < limit
    for part, limit in zip(parts, (STILL_RATE, STILL_FORCE), strict=True):
        if calm.any():
            means = part.mean(axis=1)
            calm &= np.abs(means - np.median(means[calm], axis=0)).max(axis=1) < limit
    edges = np.flatnonzero(np.diff(np.concatenate([[0], calm.astype(int), [0]])))
    if not len(edges):
        return slice(0, 0)
    begins, ends = edges[::2], edges[1::2]
    k = int(np.argmax(ends - begins))
    return slice(int(begins[k]) * width, int(ends[k]) * width)


def allan_deviation(values: Floats, rate: float) -> tuple[Floats, Floats]:
    """Averaging times (K,), s, and the overlapping Allan deviation (K, 3) of values (N, 3) (IEEE Std 952, annex C)."""
    n = len(values)
    sizes = np.unique(np.geomspace(1, max(n // _FITS, 1), 40).astype(int))
    theta = np.concatenate([np.zeros((1, 3)), np.cumsum(values, axis=0)]) / rate
    out = np.empty((len(sizes), 3))
    for k, m in enumerate(sizes):
        second = theta[2 * m :] - 2 * theta[m:-m] + theta[: -2 * m]
        out[k] = np.sqrt(0.5 * np.mean(second**2, axis=0)) / (m / rate)
    return sizes / rate, out


def _by_allan(values: Floats, rate: float) -> Noise:
    times, each = allan_deviation(values, rate)
    deviation = np.sqrt(np.mean(each**2, axis=1))
    # White noise rules the shorter half of the times, all below a second, over which it falls with their root.
    short = times <= max(min(1.0, times[-1]), times[0])
    density = float(np.median(deviation[short] * np.sqrt(times[short])))
    if len(values) / rate < _STABLE_S:
        return Noise(density)
    least = int(np.argmin(deviation))
    # At the last time, where white noise still falls, the instability is below what is seen.
    rises = least < len(times) - 1 and deviation[-1] > 1.5 * deviation[least]
    walk = float(deviation[-1] * np.sqrt(3 / times[-1])) if rises else None
    return Noise(density, float(deviation[least]) / _FLAT, walk)


def _by_differences(values: Floats, rate: float) -> float:
    """White noise from third differences, in which motion that is smooth over four samples cancels; shaking does not."""
    third = np.abs(np.diff(values, 3, axis=0))
    sigma = np.median(third, axis=0) / _MEDIAN / np.sqrt(_THIRD)
    return float(np.sqrt(np.mean(sigma**2) / rate))


def imu_toml(noise: Facts, name: str) -> str:
    """A configuration for `--config` with what was measured of the recording `name`."""
    how = (
        f"by Allan deviation over {noise['standing_s']:.0f} s of standing: a sensor that shakes has more"
        if noise["method"] == "allan"
        else "by third differences of its readings in motion, so with what shakes it at the sample rate"
    )
    known = ("accel_density", "gyro_density", "accel_walk", "gyro_walk")
    keys = ("accel_noise", "gyro_noise", "accel_walk", "gyro_walk")
    lines = [
        f"{key} = {noise[found]:.4g}" for key, found in zip(keys, known, strict=True) if (noise[found] or 0) > _LEAST
    ]
    return "\n".join([f"# IMU of {name}, {how}.", "[imu]", *lines]) + "\n"
