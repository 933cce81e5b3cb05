"""Examination of a recording's IMU: time, units, gravity and its direction, extrinsics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.printable import count_of
from lslam.core.types.imu import GRAVITY, ImuStream
from lslam.core.types.sequence import Sequence, no_shared_time
from lslam.odometry.inertial.imu_cleaning import LEAST_RATE_HZ, gravity_unit, is_slow, mean_forces, rate_of
from lslam.pipeline.doctor import Facts, Finding, Findings

# s of standing: white noise is read off the Allan deviation from the first on, where that has its least from the second.
_WHITE_S, _STABLE_S = 10.0, 120.0
# A sensor that stands, with its engine on: spread of rates (rad/s) and forces (m/s2) over a second.
_STILL_RATE, _STILL_FORCE = 0.02, 0.3
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
    """Noise of three axes of one kind, as the root mean square over the axes.

    density : per sqrt(Hz); instability : of the bias, None where the sensor does not stand long enough; walk : of the bias,
        per sqrt(s), likewise, and where the Allan deviation rises at the end
    """

    density: float
    instability: float | None = None
    walk: float | None = None


def examine_noise(imu: ImuStream) -> Facts | None:
    """Noise of the IMU and the `method` used; None for less than half a second of data or an unknown unit."""
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
    """Samples of the longest rest in whole seconds: rates and forces hardly vary; empty without. rate : Hz; others : (M, 3)."""
    width = max(round(rate), 2)
    count = len(gyro) // width
    if not count:
        return slice(0, 0)
    parts = [values[: count * width].reshape(count, width, 3) for values in (gyro, accel)]
    calm = np.ones(count, bool)
    for part, limit in zip(parts, (_STILL_RATE, _STILL_FORCE), strict=True):
        calm &= part.std(axis=1).max(axis=1) < limit
    for part, limit in zip(parts, (_STILL_RATE, _STILL_FORCE), strict=True):
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
    """Averaging times (K,), s, and the overlapping Allan deviation (K, 3) of values (N, 3) (IEEE Std 952, annex C).

    rate : of the values, Hz; the deviation has their unit
    """
    n = len(values)
    sizes = np.unique(np.geomspace(1, max(n // _FITS, 1), 40).astype(int))
    theta = np.concatenate([np.zeros((1, 3)), np.cumsum(values, axis=0)]) / rate
    out = np.empty((len(sizes), 3))
    for k, m in enumerate(sizes):
        second = theta[2 * m :] - 2 * theta[m:-m] + theta[: -2 * m]
        out[k] = np.sqrt(0.5 * np.mean(second**2, axis=0)) / (m / rate)
    return sizes / rate, out


def _by_allan(values: Floats, rate: float) -> Noise:
    """Noise density, bias instability and random walk by the Allan deviation of values (N, 3) at `rate` Hz.

    Data of less than `_STABLE_S` s give the density alone.
    """
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
    """White noise from third differences: motion that is smooth over four samples cancels, vibration does not."""
    third = np.abs(np.diff(values, 3, axis=0))
    sigma = np.median(third, axis=0) / _MEDIAN / np.sqrt(_THIRD)
    return float(np.sqrt(np.mean(sigma**2) / rate))


def imu_toml(noise: Facts, name: str) -> str:
    """Configuration for `--config` with the measured noise of the recording `name`."""
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


# No carrier of a LiDAR turns at such a rate (290 deg/s) half of the time; one that reads deg/s soon does.
_TURNING = 5.0
# LiDARs are mounted tilted, and roads are steep, by less.
_TILT_DEG = 35.0
_GAP_S = 0.1


def examine_imu(sequence: Sequence, findings: Findings) -> Facts | None:
    """Facts of the IMU, None when there is none; faults of time, extrinsics, gravity and rates become findings."""
    imu = sequence.imu
    if imu is None or not len(imu):
        return None
    finite = np.isfinite(np.hstack([imu.accel, imu.gyro])).all(axis=1)
    if not finite.all():
        what = f"IMU: {int((~finite).sum())} of {len(imu)} samples are not finite"
        findings.add("imu-finite", what, "lslam leaves out a tenth at most and refuses the IMU beyond")
    steps = np.diff(imu.stamps_ns) * 1e-9
    median = float(np.median(steps)) if len(steps) else 0.0
    facts: Facts = {
        "samples": len(imu),
        "rate_hz": 1 / median if median > 0 else None,
        "gaps": _examine_time(sequence, imu, steps, median, findings),
        "longest_step_s": float(steps.max()) if len(steps) else None,
    }
    usable = ImuStream(imu.stamps_ns[finite], imu.accel[finite], imu.gyro[finite])
    _examine_extrinsics(sequence, findings)
    return (
        facts
        | _examine_gravity(usable, sequence.calibration.T_lidar_imu, findings)
        | _examine_gyro(usable, findings)
        | {"noise": examine_noise(usable)}
    )


def _examine_time(sequence: Sequence, imu: ImuStream, steps: Floats, median: float, findings: Findings) -> int:
    """Check rate, order, gaps and overlap by `steps` (M-1,), s, and their median. Returns the number of gaps."""
    if median > 0 and is_slow(1 / median):
        what = f"IMU: {1 / median:.1f} Hz, too slow to see shaking within a scan ({LEAST_RATE_HZ:.0f} Hz would do)"
        findings.add("imu-rate", what, "record it faster, of KITTI raw take the `_extract` drive (100 Hz)")
    back = int((steps <= 0).sum())
    if back:
        what = f"IMU: time repeats or goes back {count_of(back, 'time')}"
        findings.add("imu-rewinds", what, "lslam leaves those samples out; correct the stamps if they are many")
    gaps = int((steps > _GAP_S + 0.5 * median).sum())
    if gaps:
        what = f"IMU: {count_of(gaps, 'gap')}, the longest {steps.max():.3f} s"
        findings.add("imu-gaps", what, "scans within them are predicted by constant velocity")
    apart = no_shared_time("IMU")
    first, last = sequence.stamps_ns[0], sequence.stamps_ns[-1]
    if apart not in sequence.problems and (imu.stamps_ns[0] > last or imu.stamps_ns[-1] < first):
        ahead = (imu.stamps_ns[0] - first) * 1e-9
        findings.add(
            "imu-apart",
            f"{apart}, it begins {ahead:+.3f} s from the first",
            "correct its stamps or set imu.time_offset_s",
        )
    return gaps


def _examine_extrinsics(sequence: Sequence, findings: Findings) -> None:
    """Add a finding where the extrinsics of the IMU are unknown, so that readers take it to sit in the LiDAR, axes alike."""
    if sequence.calibration.T_lidar_imu is None:
        findings.add(
            "imu-extrinsics",
            "IMU: T_lidar_imu is not known, it is taken to sit in the LiDAR with the same axes",
            "give --extrinsics, or T_lidar_imu below [extrinsics] in sequence.toml",
        )


def _examine_gravity(imu: ImuStream, T_lidar_imu: Floats | None, findings: Findings) -> Facts:
    """Check the unit of the specific force and the up direction in the LiDAR's frame, which is +z if all is right."""
    if not len(imu):
        return {"gravity_norm": 0.0, "gravity_unit": None, "up_in_lidar": None, "tilt_deg": None}
    calm, unit = gravity_unit(imu) if len(imu) > 1 else (float(np.linalg.norm(imu.accel[0])), None)
    norm = float(np.linalg.norm(imu.accel.mean(axis=0)))
    if unit != "m/s2":
        findings.add(
            "imu-accel-unit",
            f"IMU: the mean specific force is {norm:.2f} ({calm:.2f} when calm), not about 9.81 (m/s2)",
            f"it seems to be in g, multiply by {GRAVITY} (a run does, and says so)"
            if unit == "g"
            else "not usable as it is, check its unit and that gravity was not taken off",
        )
    if unit is None:
        return {"gravity_norm": norm, "gravity_unit": None, "up_in_lidar": None, "tilt_deg": None}
    up = (np.eye(3) if T_lidar_imu is None else T_lidar_imu[:3, :3]) @ _calm_direction(imu)
    tilt = float(np.degrees(np.arccos(np.clip(up[2], -1, 1))))
    if tilt > _TILT_DEG:
        findings.append(_tilt(up, tilt))
    return {"gravity_norm": norm, "gravity_unit": unit, "up_in_lidar": [float(v) for v in up], "tilt_deg": tilt}


def _calm_direction(imu: ImuStream) -> Floats:
    """Unit vector (3,) of the specific force in the calmest tenth of the seconds, since bends tilt it."""
    means = mean_forces(imu)
    calm = np.argsort(np.linalg.norm(means, axis=1), kind="stable")[: max(1, len(means) // 10)]
    force = means[calm].mean(axis=0)
    return np.asarray(force / max(float(np.linalg.norm(force)), 1e-12))


def _tilt(up: Floats, tilt: float) -> Finding:
    """Finding on a specific force that is `tilt` deg away from up; up : (3,) its direction in the LiDAR's frame."""
    axis = int(np.argmax(np.abs(up)))
    name = ("-" if up[axis] < 0 else "+") + "xyz"[axis]
    what = f"IMU: specific force points along {name} of the LiDAR, {tilt:.0f} deg from up (+z)"
    if tilt > 180 - _TILT_DEG:
        way = "at rest it is +g up: change its sign, or T_lidar_imu, unless the LiDAR hangs upside down"
    else:
        way = (
            "correct the rotation of T_lidar_imu (sequence.toml, --extrinsics), unless the LiDAR is mounted on its side"
        )
    return Finding("imu-gravity", what, way)


def _examine_gyro(imu: ImuStream, findings: Findings) -> Facts:
    """Median rate of the gyroscope; a finding where it suggests deg/s."""
    rates = np.linalg.norm(imu.gyro, axis=1)
    median = float(np.median(rates)) if len(rates) else 0.0
    if median > _TURNING:
        what = f"IMU: half of the rates are above {median:.1f} rad/s ({np.degrees(median):.0f} deg/s)"
        findings.add("imu-gyro-unit", what, "they seem to be in deg/s, convert them to rad/s")
    return {"gyro_median_deg_s": float(np.degrees(median))}
