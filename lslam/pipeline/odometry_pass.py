"""First pass over the scans: odometry, and the keyframes it passes."""

from __future__ import annotations

import logging
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise

import numpy as np

from lslam.backend.keyframes.store import KeyframeStore
from lslam.core.arrays import Floats, Longs
from lslam.core.config import Config
from lslam.core.errors import InputError
from lslam.core.geometry import se3
from lslam.core.kernels import jit
from lslam.core.machine import rarely_collecting
from lslam.core.types.constraint import Turn
from lslam.core.types.imu import InertialChain
from lslam.core.types.run_record import RunRecord
from lslam.core.types.scan_result import ScanResult
from lslam.odometry import create_odometry
from lslam.odometry.base import Deskewing, Resumable
from lslam.odometry.frontend.checkpoints import Checkpoints, OdometryCheckpoints
from lslam.odometry.frontend.inertial_start import (
    Inertial,
    begin_inertial,
    close_inertial,
    copy_of,
    load_start,
    save_start,
    with_imu_settings,
)
from lslam.odometry.frontend.keyframing import Keyframing
from lslam.odometry.frontend.register_scans import diverges, estimate, to_trajectory
from lslam.odometry.frontend.segments import Begin
from lslam.odometry.frontend.tracker import Tracker
from lslam.odometry.given import GivenPoses
from lslam.odometry.inertial.constant_velocity import ConstantVelocity, MotionModel
from lslam.odometry.inertial.smoothing import SmootherMotion, smoother_noise
from lslam.odometry.inertial.wheel_motion import close_wheels
from lslam.odometry.integrity.monitor import IntegrityMonitor
from lslam.odometry.scan_outcome import measurable
from lslam.odometry.stationary import StationaryDetector
from lslam.pipeline.job import PreparedRun
from lslam.pipeline.manifest import Manifest
from lslam.pipeline.precompile import COUNTS, load_kernels
from lslam.pipeline.run_folder import CHECKPOINT, REPLIES, RunFolder
from lslam.pipeline.segments import checks_within, join_segments, raise_alerts
from lslam.registration.local_map import surroundings_m

log = logging.getLogger("lslam")

_MOST_FAULTS = 10  # scans
# Sections that choose no kernel of scans; of buildings it is enough whether there are any.
_WITHOUT_KERNELS = {"input", "keyframes", "graph", "gnss", "osm", "eval", "report"}
_ready: set[tuple[object, ...]] = set()


def estimate_poses(job: PreparedRun) -> RunRecord:
    """Estimate odometry over all scans; keyframes go to the store, and an earlier run is continued from its checkpoint.

    Raises InputError when no scan can be used.
    """
    sequence, config, manifest, watch = job.sequence, job.config, job.manifest, job.watch
    checkpoints, store, osm = job.checkpoints, job.store, job.osm
    folder = None if job.folder is None else job.folder.path
    if osm is not None:
        osm.begin(None if folder is None else folder / REPLIES)
    stationary = _stationary(config)
    monitor = IntegrityMonitor(config.preprocess) if config.odometry.integrity else None
    watch.on_start("kernels", 0)
    _warm_up(job, stationary, monitor)

    if osm is not None and checkpoints is not None:
        for result in checkpoints.results:
            osm.see(result.stamp_ns, result.T_world_lidar)

    def take(result: ScanResult) -> None:
        if result.status != "ok":
            log.warning("scan %d %s: %s", result.index, result.status, result.reason)
        if osm is not None:
            osm.see(result.stamp_ns, result.T_world_lidar)
        watch.on_step()

    watch.on_start("odometry", len(sequence) - (0 if checkpoints is None else checkpoints.scans))
    inertial = _begin_imu(job)
    given_speed = job.odometry.motion if isinstance(job.odometry, GivenPoses) else job.wheels.motion
    motion = given_speed or inertial.motion
    with manifest.time("odometry_s"), Keyframing(store, config) as keyframing:
        results = estimate(
            sequence,
            job.odometry,
            threads=config.input.workers,
            begin=_begin_segment(job, inertial),
            initial_scans=config.registration.start_scans,
            stationary=stationary,
            motion=motion,
            should_stop=watch.should_stop,
            on_scan=take,
            keyframing=keyframing,
            checkpoints=checkpoints,
            monitor=monitor,
            noise_m=config.registration.sigma,
            beyond_m=surroundings_m(config.registration),
        )
        keyframing.finalise()
    if checkpoints is not None and checkpoints.resumed_after:
        manifest.resumed_after_scans = checkpoints.resumed_after
        manifest.timings["odometry_s"] += checkpoints.seconds
    if all(r.status == "skipped" for r in results):
        raise InputError(f"{sequence.path}: none of {len(results)} scans can be used, the first: {results[0].reason}")
    if config.imu.use:
        manifest.imu = close_inertial(inertial, results)
        manifest.problems += inertial.problems
    manifest.wheels = close_wheels(job.wheels, job.odometry.ignores_prior)
    manifest.problems += job.wheels.problems
    _report_faults(results, manifest)
    results = join_segments(results, store, config, manifest, watch.should_stop)
    if motion is None:
        results = interpolate_gaps(results)
    manifest.keyframes = {"count": len(store), "bytes": store.size}
    manifest.judge(results, len(sequence), diverges(results))
    checks = [] if monitor is None else checks_within(monitor.checks, results)
    if monitor is not None:
        results = raise_alerts(results, checks, manifest, are_scans_alone=given_speed is None)
    return RunRecord(
        name=sequence.name,
        method=config.odometry.method,
        folder=folder,
        results=results,
        trajectory=to_trajectory(results, config.odometry.method),
        ground_truth=job.truth,
        checks=checks,
        real_time_limit=config.input.skip_frames / sequence.rate_hz,
        pose_time=manifest.pose_time,
        turns=_turns(inertial, store, config),
        inertial=_chain(inertial, store, config),
        imu=sequence.imu if config.imu.use else None,
    )


def interpolate_gaps(results: list[ScanResult]) -> list[ScanResult]:
    """Results whose unregistered scans lie on the course of the registered ones before and after them, in one frame.

    While a drive is recorded constant velocity is all that is known of them. Monotone cubics through two poses on each side
    (Fritsch and Carlson 1980) do not swing out over a long gap. Scans with none before or after keep their prediction.
    """
    frames = np.array([r.frame if r.status == "ok" else -1 for r in results])
    stamps = np.array([r.stamp_ns for r in results], np.int64)
    out = list(results)
    for frame in np.unique(frames[frames >= 0]):
        anchors = np.flatnonzero(frames == frame)
        for i in np.flatnonzero(np.diff(anchors) > 1).tolist():
            gap = [k for k in range(anchors[i] + 1, anchors[i + 1]) if frames[k] < 0 and results[k].frame == frame]
            around = anchors[max(i - 1, 0) : i + 3]
            if not gap or np.any(np.diff(stamps[around]) <= 0):
                continue
            for k, pose in zip(gap, _course_through([results[k] for k in around], stamps[gap]), strict=True):
                out[k] = replace(results[k], T_world_lidar=pose, stamp_offset=None)
    return out


def _course_through(results: list[ScanResult], stamps_ns: Longs) -> Floats:
    """(K, 4, 4) poses at `stamps_ns` (K,) on monotone cubics through those of the results, whose stamps increase."""
    from scipy.interpolate import PchipInterpolator

    poses, begin = np.stack([r.at_stamp.T_world_lidar for r in results]), results[0].stamp_ns
    seconds = 1e-9 * np.array([r.stamp_ns - begin for r in results])
    course = PchipInterpolator(seconds, se3.log(se3.relative(poses[0], poses)))
    return se3.normalise(poses[0] @ se3.exp(course(1e-9 * (stamps_ns - begin))))


def _begin_segment(job: PreparedRun, inertial: Inertial) -> Begin | None:
    """Function of a pose that makes a tracker with an empty map; None for a method that predicts by itself or takes poses."""
    config = job.config
    if not isinstance(job.odometry, Deskewing):
        return None

    def begin(pose: Floats) -> Tracker:
        motion: MotionModel = ConstantVelocity(pose)
        if job.wheels.motion is not None:
            motion = job.wheels.motion.fresh(pose)
        if inertial.motion is not None and inertial.start is not None:
            motion = copy_of(inertial.motion, inertial.start, config)
        return Tracker(create_odometry(with_imu_settings(config)), _stationary(config), motion)

    return begin


def _stationary(config: Config) -> StationaryDetector | None:
    """The stationary detector, if it is configured; else None."""
    is_on = config.preprocess.skip_standing
    return StationaryDetector(config.preprocess, config.registration) if is_on else None


def _chain(inertial: Inertial, store: KeyframeStore, config: Config) -> InertialChain | None:
    """IMU factors between keyframes; None if the graph is not to contain them, or the IMU was refused."""
    motion = inertial.motion
    if not isinstance(motion, SmootherMotion) or motion.refusal or not config.lio_sam.graph_imu:
        return None
    return motion.chain(
        [(k.number, k.stamp_ns) for k in store.keyframes], smoother_noise(motion.estimate.gyroscope.noise)
    )


def _turns(inertial: Inertial, store: KeyframeStore, config: Config) -> list[Turn]:
    """The gyroscope's rotations between successive keyframes, if the graph is to contain them."""
    if inertial.motion is None or config.graph.imu_orientation_deg == 0:
        return []
    sigma = float(np.deg2rad(config.graph.imu_orientation_deg))
    found = []
    for a, b in pairwise(store.keyframes):
        R = inertial.motion.turn(a.stamp_ns, b.stamp_ns)
        if R is not None:
            found.append(Turn(a.number, b.number, R, sigma))
    return found


def odometry_checkpoints(folder: RunFolder, job: PreparedRun, goes_on: bool) -> OdometryCheckpoints | None:
    """Checkpoints in a run folder; None when they are disabled. Logs when the run to resume left none."""
    every_s = job.config.odometry.checkpoint_s
    if every_s == 0:
        return None
    checkpoints = OdometryCheckpoints(Checkpoints(folder.path / CHECKPOINT, "odometry", every_s))
    if goes_on and not checkpoints.scans:
        has_state = isinstance(job.odometry, Resumable)
        why = "there is no checkpoint to go on from" if has_state else "its state is its own"
        log.info("%s begins again at the first scan: %s", job.config.odometry.method, why)
    return checkpoints


def _warm_up(job: PreparedRun, stationary: StationaryDetector | None, monitor: IntegrityMonitor | None) -> None:
    """Compile or load the run's kernels, fewer if odometry is done; once per process and configuration."""
    config, is_over = job.config, job.checkpoints is not None and job.checkpoints.is_over
    alike = type(job.odometry), bool(config.osm.extract), repr(config.model_dump(exclude=_WITHOUT_KERNELS))
    count = COUNTS.get(config.odometry.method)
    with job.manifest.time("compile_s"), rarely_collecting(), jit.count_kernels(log, count):
        if alike not in _ready and not is_over:
            load_kernels(config, [one for one in (job.odometry, stationary, monitor) if one is not None])
            _ready.add(alike)
        with suppress(InputError):
            measurable(job.sequence.scan(0))  # the reader's kernels; what is wrong with the scan is said in its turn


def _begin_imu(job: PreparedRun) -> Inertial:
    """The initialised IMU, empty without one; a resumed run reads the result of the earlier one."""
    config = job.config
    if not config.imu.use:
        return Inertial(None)
    path = None if job.checkpoints is None else job.checkpoints.folder / "imu.npz"
    with job.manifest.time("imu_start_s"):
        known = None if path is None else load_start(path, config)
        inertial = begin_inertial(job.sequence, config) if known is None else known
        if path is not None and known is None:
            path.parent.mkdir(exist_ok=True)
            save_start(path, inertial)
    if job.odometry.ignores_prior:
        inertial.problems.append(f"{config.odometry.method} predicts by itself: the IMU only bridges scans that fail")
    return inertial


def _report_faults(results: list[ScanResult], manifest: Manifest) -> None:
    """Add a problem naming the scans of which faulty points were dropped."""
    faulty = [r for r in results if r.fault]
    if not faulty:
        return
    numbers = ", ".join(str(r.index) for r in faulty[:_MOST_FAULTS]) + (", ..." if len(faulty) > _MOST_FAULTS else "")
    manifest.problems.append(
        f"in {len(faulty)} of {len(results)} scans not all was right and the rest was used ({numbers}); scan {faulty[0].index}: "
        f"{faulty[0].fault}"
    )
    log.warning("%s", manifest.problems[-1])
