"""Comparison of a recording's IMU with its scans: unit of the rates, clock, axes and extrinsic rotation."""

from __future__ import annotations

import logging
from dataclasses import replace
from itertools import permutations, product

import numpy as np

from lslam.core.arrays import Bools, Floats, Longs
from lslam.core.config import Config
from lslam.core.geometry import so3
from lslam.core.types.imu import ImuStream
from lslam.core.types.sequence import Sequence
from lslam.odometry.frontend.inertial_start import first_poses
from lslam.odometry.inertial.agreement import FAR_S, LEAST_TURNING, NEAR_S, STEP_S, Agreement, check_agreement, turns
from lslam.odometry.inertial.fusion import InertialMotion
from lslam.odometry.inertial.imu_cleaning import CleanStream, ImuFault, ImuRefusedError, clean
from lslam.odometry.inertial.initialise import FirstPoses, covered_stretches, start
from lslam.pipeline.doctor import Facts, Finding, Findings

log = logging.getLogger("lslam")


_SCANS, _FEWEST = 60, 5
# s: less moves a point 20 m away by 5 cm at 30 deg/s.
_LEAST_OFFSET_S = 0.005
# Correlation about an axis: below the first it does not fit, from the second on it does.
_BAD, _GOOD = 0.5, 0.8
# Turns that correlate less may fit better where a run does not look for them, and do where they correlate so much.
_SURE, _CLEAR = 0.95, 0.9
# Axes are a little askew in any housing, and registration is not exact.
_LEAST_ANGLE = np.deg2rad(8.0)
# Faults found by now that leave nothing to compare.
_HOPELESS = {"imu-accel-unit", "imu-apart", "imu-finite"}


def examine_turns(sequence: Sequence, findings: Findings) -> Facts | None:
    """Register the first scans with `icp` and compare their rotations with the gyroscope's; None without an IMU."""
    imu, stamps_ns = sequence.imu, sequence.stamps_ns
    if imu is None or not len(imu) or len(sequence) < _FEWEST:
        return None
    try:
        stream = clean(imu, int(stamps_ns[0]), int(stamps_ns[-1]))
    except ImuRefusedError as error:
        if not _HOPELESS & {f.code for f in findings}:
            way_out = error.way_out or "it holds no measurements; look at its driver, and run without --imu"
            findings.add("imu-refused", f"IMU: {error.what}", way_out)
        return None
    log.info("registering the first %d scans to compare their turns with the IMU's", min(_SCANS, len(sequence)))
    seconds = float(np.clip(_SCANS / sequence.rate_hz, 0.5, 60))
    config = Config.model_validate({"imu": {"start_s": seconds}})
    try:
        first, _ = covered_stretches(first_poses(sequence, config, None), stream.imu)
    except ImuRefusedError:
        return None  # gaps everywhere, which are found by now
    if len(first.instants_ns) < _FEWEST:
        return None
    known = sequence.calibration.T_lidar_imu
    T_lidar_imu = np.eye(4) if known is None else known
    first = _swept_by_imu(sequence, stream.imu, T_lidar_imu, first, config)
    return compare(stream, T_lidar_imu, first.instants_ns, first.middles, findings)


def _swept_by_imu(
    sequence: Sequence, imu: ImuStream, T_lidar_imu: Floats, first: FirstPoses, config: Config
) -> FirstPoses:
    """First scans deskewed by the IMU if its clock seems off, since deskewing by constant velocity distorts rotations, too."""
    if first.covariances is not None:
        return first  # nothing to deskew
    try:
        begun = start(imu, T_lidar_imu, first, int(sequence.stamps_ns[-1]), config.imu)
        if not begun.offset_s:
            return first
        motion = InertialMotion(begun, config)
        again = covered_stretches(first_poses(sequence, config, motion), imu)[0]
    except ImuRefusedError:
        return first
    return again if len(again.instants_ns) >= _FEWEST else first


def compare(stream: CleanStream, T_lidar_imu: Floats, stamps_ns: Longs, poses: Floats, findings: Findings) -> Facts:
    """Compare the gyroscope with the LiDAR's poses (N, 4, 4) at `stamps_ns` (N,)."""
    agreement = Agreement(False)
    refusal: ImuRefusedError | None = None
    try:
        agreement = check_agreement(stream.imu, T_lidar_imu, stamps_ns, poses, None)
    except ImuRefusedError as error:
        refusal = error
    if refusal or (agreement.is_judged and agreement.correlation < _SURE):
        far = _far_off(stream, T_lidar_imu, stamps_ns, poses, agreement)
        if far is not None:
            agreement, refusal = far, None
    lidar_rates, imu_rates = turns(stream.imu, T_lidar_imu, stamps_ns, poses, agreement.offset_s)
    # In the axes of the IMU, which its user can name.
    R = T_lidar_imu[:3, :3]
    found = (
        _examine_axes(lidar_rates @ R, imu_rates @ R, R)
        if len(lidar_rates) and (agreement.is_judged or refusal)
        else None
    )
    if found is not None:
        findings.append(found[0])
        agreement = _with_axes(stream, found[1], stamps_ns, poses)
    elif refusal and not any(f.code == "imu-gyro-unit" for f in findings):
        code = "imu-gyro-unit" if refusal.fault is ImuFault.GYRO_IN_DEGREES else "imu-turns"
        findings.add(code, f"IMU: {refusal.what}", refusal.way_out)
    offset, sigma = _examine_clock(agreement, stream.rate_hz, findings), float(agreement.offset_sigma_s)
    return {
        "scans": len(stamps_ns),
        "is_judged": bool(agreement.is_judged or refusal or found),
        "correlation": float(agreement.correlation) if agreement.is_judged and found is None else None,
        "correlation_xyz": _by_axis(lidar_rates @ R, imu_rates @ R),
        "time_offset_s": offset,
        "time_offset_sigma_s": sigma if agreement.is_judged and np.isfinite(sigma) else None,
    }


def _with_axes(stream: CleanStream, R: Floats, stamps_ns: Longs, poses: Floats) -> Agreement:
    """Agreement after a correction of axes by R (3, 3), perhaps a reflection; before, the clock offset is unobservable.

    It is not judged where the stream is refused.
    """
    T = np.eye(4)
    T[:3, :3] = R
    try:
        return check_agreement(stream.imu, T, stamps_ns, poses, None)
    except ImuRefusedError:
        return Agreement(False)


def _far_off(
    stream: CleanStream, T_lidar_imu: Floats, stamps_ns: Longs, poses: Floats, near: Agreement
) -> Agreement | None:
    """Agreement at an offset beyond those that a run tries, if clearly better than `near`; else None."""
    best, at = 0.0, 0.0
    for offset in np.arange(-FAR_S, FAR_S, 4 * STEP_S):
        lidar_rates, imu_rates = turns(stream.imu, T_lidar_imu, stamps_ns, poses, float(offset))
        both = float(np.sqrt(np.sum(lidar_rates**2) * np.sum(imu_rates**2)))
        value = float(np.sum(lidar_rates * imu_rates)) / max(both, 1e-12)
        if value > best:
            best, at = value, float(offset)
    if abs(at) < NEAR_S or best < _CLEAR or best < near.correlation + 0.1:
        return None
    shifted = replace(stream.imu, stamps_ns=stream.imu.stamps_ns + round(1e9 * at))
    try:
        fine = check_agreement(shifted, T_lidar_imu, stamps_ns, poses, None)
    except ImuRefusedError:
        return None
    return replace(fine, offset_s=at + fine.offset_s)


def _examine_clock(agreement: Agreement, rate_hz: float, findings: Findings) -> float | None:
    """Time to add to the IMU's stamps, s, a finding if above half a sample period; None if rotation does not tell it."""
    if not agreement.is_judged:
        return None
    offset, sigma = float(agreement.offset_s), float(agreement.offset_sigma_s)
    if abs(offset) > max(_LEAST_OFFSET_S, 0.5 / rate_hz):
        findings.add(
            "imu-time-offset",
            f"IMU: its stamps are {1e3 * abs(offset):.1f} ms {'late' if offset < 0 else 'early'} (sigma "
            f"{1e3 * sigma:.1f} ms, by the turns)",
            f"run --imu finds and mends it, --set imu.time_offset_s={offset:.4f} states it"
            if abs(offset) < NEAR_S
            else f"correct them, or --set imu.time_offset_s={offset:.4f}; a run does not look so far",
        )
    return offset


def _examine_axes(lidar_rates: Floats, imu_rates: Floats, R_lidar_imu: Floats) -> tuple[Finding, Floats] | None:
    """Finding on swapped, inverted or rotated axes, and the `R_lidar_imu` (3, 3) to use; None if right, or hardly rotating.

    lidar_rates, imu_rates : (M, 3) rates of the LiDAR's and the IMU's rotation, in the IMU's axes
    """
    rms = np.sqrt(np.mean(lidar_rates**2, axis=0))
    turns_about = rms > LEAST_TURNING
    norms = np.maximum(np.sqrt(np.outer(np.sum(lidar_rates**2, axis=0), np.sum(imu_rates**2, axis=0))), 1e-12)
    correlation = (lidar_rates.T @ imu_rates) / norms
    as_is = np.diag(correlation)[turns_about]
    if not len(as_is):
        return None
    P = _best_axes(correlation, turns_about)
    better = np.sum(P * correlation, axis=1)[turns_about]
    if as_is.min() < _BAD and better.min() >= _GOOD:
        return _swap(P, float(as_is.min()), float(better.min()), int(turns_about.sum()), R_lidar_imu), R_lidar_imu @ P
    return _rotation_fit(lidar_rates, imu_rates, R_lidar_imu) if turns_about.sum() > 1 else None


def _best_axes(correlation: Floats, turns_about: Bools) -> Floats:
    """Signed permutation (3, 3), lidar_rates = P imu_rates, with the best correlation; identity about axes without rotation."""
    weight = correlation * turns_about[:, None] + 0.01 * np.eye(3)
    best, score = np.eye(3), -np.inf
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        P = np.zeros((3, 3))
        P[np.arange(3), order] = signs
        value = float(np.sum(P * weight))
        if value > score:
            best, score = P, value
    return best


def _swap(P: Floats, before: float, after: float, axes: int, R_lidar_imu: Floats) -> Finding:
    """Finding: IMU axes fit after the signed permutation P (3, 3). before, after : correlations; axes : number compared."""
    names = ", ".join(("-" if row.sum() < 0 else "") + "xyz"[int(np.argmax(np.abs(row)))] for row in P)
    what = f"IMU: its axes do not fit the scans' turns, ({names}) for (x, y, z) would (correlation {after:.2f}, not {before:.2f})"
    if axes < 2:
        way = "check the signs of its axes, and the rotation of T_lidar_imu"
    elif np.linalg.det(P) < 0:
        way = "an axis is mirrored, which no rotation mends: correct the signs in the recording of the IMU"
    else:
        way = f"correct its axes, or the rotation of T_lidar_imu to {_rows(R_lidar_imu @ P)}"
    return Finding("imu-axes", what, way)


def _rotation_fit(lidar_rates: Floats, imu_rates: Floats, R_lidar_imu: Floats) -> tuple[Finding, Floats] | None:
    """Finding and `R_lidar_imu` (3, 3) that fits the rates (M, 3) best, if it halves the residuals; else None."""
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(lidar_rates.T @ lidar_rates / len(lidar_rates)), 0.0))
    if spread[1] < LEAST_TURNING:
        return None  # turns about one axis say nothing of a turn about that axis
    u, _, vt = np.linalg.svd(lidar_rates.T @ imu_rates)
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    angle = float(so3.angle(rotation))
    rest, before = (
        float(np.sum((lidar_rates - imu_rates @ rotation.T) ** 2)),
        float(np.sum((lidar_rates - imu_rates) ** 2)),
    )
    if angle < _LEAST_ANGLE or rest > 0.5 * before or rest > 0.36 * float(np.sum(lidar_rates**2)):
        return None
    R = R_lidar_imu @ rotation
    what = f"IMU: T_lidar_imu is about {np.rad2deg(angle):.0f} deg off by the turns of the scans"
    return Finding("imu-rotation", what, f"correct its rotation to about {_rows(R)}"), R


def _by_axis(lidar_rates: Floats, imu_rates: Floats) -> list[float | None] | None:
    """Correlation of rates (M, 3) about x, y, z of the IMU; None about an axis with hardly any rotation."""
    if not len(lidar_rates):
        return None
    pairs = zip(lidar_rates.T, imu_rates.T, strict=True)
    return [
        float(a @ b / max(np.sqrt((a @ a) * (b @ b)), 1e-12)) if np.sqrt(np.mean(a**2)) > LEAST_TURNING else None
        for a, b in pairs
    ]


def _rows(R: Floats) -> str:
    """Matrix as text, row by row."""
    return "[" + ", ".join("[" + ", ".join(f"{v:.3g}" if abs(v) > 5e-4 else "0" for v in row) + "]" for row in R) + "]"
