"""From a sequence with an IMU to the motion model of a run: a few scans are registered without it first.

For the manifest, what the run found of the calibration: the rotation of its extrinsics and its clock.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.config import Config
from lslam.core.config.odometry import TIGHTLY_COUPLED
from lslam.core.errors import InputError
from lslam.core.types.imu import ImuStream
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.sequence import Selection, Sequence, select
from lslam.io.formats.state_files import read_state, write_state
from lslam.odometry import METHODS, create_odometry
from lslam.odometry.frontend.checkpoints import STATE_CLASSES
from lslam.odometry.frontend.register_scans import read_ahead
from lslam.odometry.frontend.scene_scale import in_scale
from lslam.odometry.frontend.tracker import Tracker
from lslam.odometry.inertial import fusion
from lslam.odometry.inertial.fusion import InertialMotion
from lslam.odometry.inertial.gyroscope import Gyroscope
from lslam.odometry.inertial.imu_cleaning import IMU_GAP_S, LEAST_RATE_HZ, ImuRefusedError, is_slow, rate_of
from lslam.odometry.inertial.initialise import FirstPoses, InertialStart, start

log = logging.getLogger("lslam")


@dataclass
class Inertial:
    """The IMU's part in a run: motion model, None if it was refused at the start, and problems."""

    motion: InertialMotion | None
    start: InertialStart | None = None
    notes: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


def warm_up() -> None:
    """Compile what the motion model and the scans before the run need."""
    create_odometry(Config()).warm_up()
    fusion.warm_up()


def begin_inertial(sequence: Sequence, config: Config) -> Inertial:
    """Check and align the sequence's IMU; a refused one leaves the run to constant velocity.

    Raises InputError when the sequence has no IMU, or a refused or slow one and a tightly coupled method.
    """
    is_needed = config.odometry.method in TIGHTLY_COUPLED
    if sequence.imu is None:
        raise InputError(
            f"{sequence.path} has no IMU: name its file with `imu` in sequence.toml, or run without --imu, by a method that "
            "needs none"
        )
    if is_needed:
        _require_rate(sequence, sequence.imu, config.odometry.method)
    part = Inertial(None)
    T_lidar_imu = sequence.calibration.T_lidar_imu
    if T_lidar_imu is None:
        part.problems.append("T_lidar_imu is not known: the IMU is taken to sit in the LiDAR with the same axes")
        T_lidar_imu = np.eye(4)
    try:
        opening = _begin(sequence, sequence.imu, T_lidar_imu, config)
    except ImuRefusedError as error:
        if is_needed:
            raise InputError(f"{config.odometry.method} needs an IMU, and this one is refused: {error}") from None
        part.problems.append(f"the IMU is refused, the run goes on without it: {error}")
        log.warning("%s", part.problems[-1])
        return part
    part.start, part.notes = opening, list(opening.notes)
    part.problems += opening.problems
    part.motion = motion_of(opening, config)
    for note in part.notes:
        log.info("%s", note)
    return part


def _require_rate(sequence: Sequence, imu: ImuStream, method: str) -> None:
    """Raise InputError for an IMU that a filter cannot propagate within a sweep."""
    rate = rate_of(imu)
    if is_slow(rate):
        extract = ", or take KITTI's `_extract` drive (100 Hz)" if sequence.kind.startswith("kitti") else ""
        raise InputError(
            f"{sequence.path}: {method} is tightly coupled and needs an IMU of {LEAST_RATE_HZ:.0f} Hz or more, this one has "
            f"{rate:.1f} Hz: run a loosely coupled method with it (--method icp --imu){extract}"
        )


def save_start(path: Path, part: Inertial) -> None:
    """Write the result of `begin_inertial` to `path`, for `load_start`. Raises OutputError."""
    write_state(path, {"start": part.start, "notes": part.notes, "problems": part.problems})


def load_start(path: Path, config: Config) -> Inertial | None:
    """The result of `begin_inertial` that an earlier run wrote to `path`; None when it is absent or unreadable."""
    try:
        record = read_state(path, STATE_CLASSES) if path.is_file() else None
    except InputError as error:
        log.warning("the IMU is aligned again: %s", error)
        record = None
    if record is None:
        return None
    part = Inertial(None, record["start"], record["notes"], record["problems"])
    if part.start is not None:
        part.motion = motion_of(part.start, config)
    return part


def _begin(sequence: Sequence, imu: ImuStream, T_lidar_imu: Floats, config: Config) -> InertialStart:
    """Initialise the IMU by scans registered without it; again by scans deskewed with it, where that matters."""
    last_ns = int(sequence.stamps_ns[-1])
    first = first_poses(sequence, config, None)
    opening = start(imu, T_lidar_imu, first, last_ns, config.imu)
    is_moved = opening.offset_s != 0 and config.imu.time_offset_s is None
    if not is_moved and first.covariances is not None:
        return opening
    motion = InertialMotion(opening, config)
    better = first_poses(sequence, config, motion)
    if not is_moved:
        on_time = config.imu.model_copy(update={"time_offset_s": 0.0})
        again = start(opening.imu, T_lidar_imu, better, last_ns, on_time)
        return replace(again, offset_s=opening.offset_s, notes=opening.notes, problems=opening.problems)
    again = start(opening.imu, T_lidar_imu, better, last_ns, config.imu, 0.0)
    offset = opening.offset_s + again.offset_s
    note = f"IMU stamps moved by {1e3 * offset:+.1f} ms: its turns then fit those of the scans best"
    return replace(again, offset_s=offset, notes=[*opening.notes, note])


def with_imu_settings(config: Config) -> Config:
    """The configuration with the narrower correspondence search `imu.inlier_distance` and no trimming, if an IMU is used.

    Its motion priors are better than those of constant velocity.
    """
    if not config.imu.use or config.imu.inlier_distance is None:
        return config
    narrow = config.registration.model_copy(update={"inlier_distance": config.imu.inlier_distance, "inlier_ratio": 1.0})
    return config.model_copy(update={"registration": narrow})


def first_poses(sequence: Sequence, config: Config, motion: InertialMotion | None) -> FirstPoses:
    """Register every scan of the first seconds by `icp` with its defaults, up to the first that fails.

    Where the IMU begins later, up to its first seconds. motion : deskews the scans; None: constant velocity
    """
    whole, first = (sequence.whole, int(sequence.indices[0])) if isinstance(sequence, Selection) else (sequence, 0)
    begin_ns = first_imu_ns(sequence.imu, whole.stamps_ns[first:], config)
    if motion is None and begin_ns > whole.stamps_ns[first]:
        log.info("the IMU begins %.1f s after the first scan", 1e-9 * (begin_ns - whole.stamps_ns[first]))
    end_ns = begin_ns + round(1e9 * config.imu.start_s)
    few = select(whole, first, max(int(np.searchsorted(whole.stamps_ns[first:], end_ns)), 1))
    gate = config.preprocess.model_dump(include={"range_min", "range_max", "up", "ring_gap_deg", "deskew"})
    odometry = create_odometry(in_scale(Config.model_validate({"preprocess": gate}), few))
    tracker = Tracker(odometry, motion=motion)
    stamps: list[int] = []
    poses: list[Floats] = []
    instants: list[int] = []
    middles: list[Floats] = []
    covariances: list[Floats] = []
    for entry in read_ahead(few, odometry.prepare, config.input.workers):
        result = tracker.track(entry)
        if result.status == "skipped":
            continue
        if result.status != "ok":
            break
        stamps.append(result.stamp_ns)
        poses.append(result.T_world_lidar)
        instants.append(tracker.middle[0])
        middles.append(tracker.middle[1])
        # Where constant velocity deskews, poses are worse than a registration can know.
        if result.registration_covariance is not None and (motion is not None or len(tracker.sweep.times) == 1):
            covariances.append(result.registration_covariance)
    if not stamps:
        stamps, poses = [int(whole.stamps_ns[first])], [np.eye(4)]
    # The sweep of the first scan is not known before the second without an IMU.
    turns = slice(1 if motion is None else 0, None)
    return FirstPoses(
        np.array(stamps, np.int64),
        np.stack(poses),
        np.array(instants[turns], np.int64),
        np.array(middles[turns]).reshape(-1, 4, 4),
        np.stack(covariances)[turns] if len(covariances) == len(poses) else None,
    )


def first_imu_ns(imu: ImuStream | None, stamps_ns: Longs, config: Config) -> int:
    """Stamp, ns, from which on the IMU covers the scans: the first scan's, unless the IMU begins later than a gap."""
    first_ns = int(stamps_ns[0])
    if imu is None:
        return first_ns
    shifted = imu.stamps_ns + round(1e9 * (config.imu.time_offset_s or 0.0))
    during = shifted[(shifted >= first_ns) & (shifted <= stamps_ns[-1])]
    silent_s = 1e-9 * (int(during.min()) - first_ns) if len(during) else 0.0
    return first_ns if silent_s <= IMU_GAP_S else int(during.min())


def close_inertial(part: Inertial, results: list[ScanResult]) -> dict[str, Any]:
    """Facts about the IMU for the manifest, after the run; problems of the run are appended to those of `part`."""
    motion, opening = part.motion, part.start
    if motion is None or opening is None:
        return {"used": False, "decisions": [*part.notes, *part.problems]}
    if motion.gap_scans:
        part.problems.append(
            f"IMU: {motion.gap_scans} scans fell into gaps of the IMU and were predicted by constant velocity"
        )
    if problem := mounting_problem(motion):
        part.problems.append(problem)
    if motion.refusal:
        part.problems.append(f"the IMU was refused on the way, the run went on without it: {motion.refusal}")
    last = motion.estimate
    norms = [r.prior_norm for r in results[1:] if r.status == "ok"]
    steady = [r.imu.steady_norm for r in results[1:] if r.status == "ok" and r.imu.steady_norm is not None]
    iterations = [r.iterations for r in results[1:] if r.status == "ok" and not r.repeats_pose]
    return {
        "used": not motion.refusal,
        "decisions": part.notes,
        "velocity": motion.config.velocity,
        "time_offset_s": round(opening.offset_s + last.gyroscope.offset_s, 5),
        **calibration_of(last.gyroscope, opening),
        "is_checked_by_turns": opening.has_turn_check,
        "is_static_start": opening.is_static,
        "gyro_bias_rad_s": _round(last.gyroscope.bias, 5),
        "accel_bias_m_s2": _round(last.accel_bias, 4),
        "gravity_in_world_m_s2": _round(last.gravity, 4),
        "scans_in_gaps": motion.gap_scans,
        "median_prior_norm": round(float(np.median(norms)), 5) if norms else None,
        "median_constant_velocity_norm": round(float(np.median(steady)), 5) if steady else None,
        "mean_iterations": round(float(np.mean(iterations)), 2) if iterations else None,
        **_savings(results),
        **motion.errors.facts,
    }


def _savings(results: list[ScanResult]) -> dict[str, Any]:
    """Mean iterations and time that the IMU saved, over the scans that were also registered from constant velocity."""
    sample = [
        (r.iterations, r.imu.steady_iterations, r.imu.saved_s)
        for r in results
        if r.imu.steady_iterations is not None and r.imu.saved_s is not None
    ]
    if not sample:
        return {"compared_scans": 0}
    own, steady, saved = np.mean(sample, axis=0)
    return {
        "compared_scans": len(sample),
        "compared_iterations": round(float(own), 2),
        "constant_velocity_iterations": round(float(steady), 2),
        "saved_ms_per_scan": round(1e3 * float(saved), 2),
    }


def _round(values: Floats, digits: int) -> list[float]:
    """The values as plain floats with so many decimal `digits`."""
    return [round(float(v), digits) for v in values]


# An IMU whose turns lie so far beside those of the scans, and by so many sigma, is turned against T_lidar_imu: axes two per
# cent askew (a consumer device's data sheet) show 1.6 deg.
LEAST_TURN_RAD, SIGMAS = np.deg2rad(2.0), 4.0


def mounting_problem(motion: InertialMotion) -> str:
    """A sentence where the rotations contradict that of T_lidar_imu and it is not estimated; else empty.

    Rotations about one axis do not distinguish a wrongly mounted device from one with misaligned axes; a second axis does.
    The advice fits the method of this motion model.
    """
    gyroscope = motion.estimate.gyroscope
    angle, sigma = gyroscope.tilt
    if gyroscope.has_mounting or angle < LEAST_TURN_RAD or angle < SIGMAS * sigma:
        return ""
    first = "" if motion.HAS_DEVICE else "--method fast-lio2 "
    if motion.config.velocity != "registration":
        first = "--set imu.velocity=registration "
    cause = "correct T_lidar_imu, or have it estimated"
    if not _has_turn(gyroscope):
        cause = (
            "the gyroscope's axes are askew or T_lidar_imu is turned, turns about one axis do not tell which; the latter is "
            "estimated"
        )
    return (
        f"IMU: it turns about an axis {np.rad2deg(angle):.1f} deg (sigma {np.rad2deg(sigma):.1f}) beside that of the scans: "
        f"{cause} by {first}--set imu.estimate_extrinsics=true"
    )


def _has_turn(gyroscope: Gyroscope) -> bool:
    """Whether a rotation of the whole device is certain, whatever its axes may be askew."""
    rotation, covariance = gyroscope.rotation[0], gyroscope.rotation_covariance
    angle = float(np.linalg.norm(rotation))
    return angle**2 > SIGMAS * float(np.sqrt(rotation @ covariance @ rotation))


def calibration_of(gyroscope: Gyroscope, opening: InertialStart) -> dict[str, Any]:
    """Estimated time offset and mounting with their sigmas, for the manifest; empty where neither was estimated.

    `mounting_deg` is the rotation vector from IMU readings to the axes of the configured T_lidar_imu; `T_lidar_imu` includes it.
    """
    facts: dict[str, Any] = {}
    if gyroscope.has_offset:
        facts["time_offset_sigma_s"] = round(float(np.sqrt(gyroscope.covariance[12, 12])), 6)
    if gyroscope.has_mounting:
        vector, sigma = gyroscope.rotation
        T = opening.T_lidar_imu.copy()
        mounting = gyroscope.mounting
        assert mounting is not None
        T[:3, :3] = T[:3, :3] @ mounting
        facts["mounting_deg"] = [round(float(v), 3) for v in np.rad2deg(vector)]
        facts["mounting_sigma_deg"] = round(float(np.rad2deg(sigma)), 3)
        facts["T_lidar_imu"] = [round(float(v), 6) for v in T[:3].ravel()]
    return facts


def motion_of(opening: InertialStart, config: Config) -> InertialMotion:
    """Create the motion model of the method: by `create_motion` of its module if it has one, else `InertialMotion`."""
    create: Callable[[InertialStart, Config], InertialMotion] = InertialMotion
    if config.odometry.method in METHODS:
        module, _ = METHODS[config.odometry.method]
        create = getattr(import_module(module), "create_motion", create)
    return create(opening, config)


def copy_of(motion: InertialMotion, opening: InertialStart, config: Config) -> InertialMotion:
    """A second motion model of the same IMU, in the state of `motion`."""
    other = motion_of(opening, config)
    other.restore(deepcopy(motion.state()))
    return other
