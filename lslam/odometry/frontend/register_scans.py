"""Scans in, poses out: read ahead, predict, register, correct."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from contextvars import copy_context
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.errors import InputError
from lslam.core.geometry import se3
from lslam.core.geometry.se3 import poses_at
from lslam.core.types.scan import FARTHEST_M, Scan, Span
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.sequence import Selection, Sequence
from lslam.core.types.trajectory import Trajectory
from lslam.odometry.base import Odometry
from lslam.odometry.frontend.checkpoints import OdometryCheckpoints
from lslam.odometry.frontend.keyframing import Keyframing
from lslam.odometry.frontend.segments import Begin, SegmentTracker, TrackedScan
from lslam.odometry.frontend.tracker import ScanInput, Tracker
from lslam.odometry.frontend.windows import WindowTracker
from lslam.odometry.inertial.constant_velocity import MotionModel
from lslam.odometry.integrity.monitor import IntegrityMonitor
from lslam.odometry.scan_outcome import measurable
from lslam.odometry.stationary import StationaryDetector
from lslam.registration.acceptance import PRIOR_COVARIANCE
from lslam.registration.local_map import surroundings_m

# Of a pose in a frame of which nobody knows where it lies, m2 and rad2.
INFINITE_COVARIANCE = np.diag(np.full(6, np.inf))
# Scans with points that say when sweeps begin and end.
_LOOKED_AT = 3
# Scans that are read before they are asked for.
_AHEAD = 2


def estimate(
    sequence: Sequence,
    odometry: Odometry,
    *,
    threads: int = 2,
    begin: Begin | None = None,
    initial_scans: int = RegistrationConfig().start_scans,
    stationary: StationaryDetector | None = None,
    motion: MotionModel | None = None,
    should_stop: Callable[[], bool] = lambda: False,
    on_scan: Callable[[ScanResult], None] = lambda result: None,
    keyframing: Keyframing | None = None,
    checkpoints: OdometryCheckpoints | None = None,
    monitor: IntegrityMonitor | None = None,
    noise_m: float = RegistrationConfig().sigma,
    beyond_m: float = surroundings_m(RegistrationConfig()),
) -> list[ScanResult]:
    """Register every scan of the sequence; stops early only when `should_stop` returns True.

    A scan that cannot be read, or is empty, is skipped: its pose is the motion prior. `begin` and `initial_scans` make a new
    segment where the map is lost, as in `SegmentTracker`. With `stationary`, scans of a stationary sensor are not registered.
    `motion` predicts the scans, constant velocity when None. `keyframing` gets every scan and the motion within it.
    `checkpoints`, which need keyframing, restore an earlier run's state and save this one's. `monitor` checks the pose of every
    scan. `noise_m`, the noise of a point, and `beyond_m` are those of `WindowTracker`.
    """
    tracker = SegmentTracker(Tracker(odometry, stationary, motion), begin, initial_scans)
    windows = WindowTracker(tracker, monitor, noise_m, beyond_m)
    results: list[ScanResult] = []
    if checkpoints is not None and keyframing is not None:
        results = checkpoints.begin(windows, keyframing)
    middle = windows.middle
    ahead = read_ahead(sequence, odometry.prepare, threads, first=len(results))
    for entry in chain(ahead, (None,)):
        windows.open(entry)
        decided = windows.decide(entry, None if entry is None else windows.present.track(entry))
        for track in decided:
            if results and tracker.has_middles and not track.has_both_sides:
                results[-1] = between_middles(results[-1], middle, track)
            results.append(_observe(track, len(results), keyframing, monitor))
            middle = track.middle
            on_scan(results[-1])
        if decided and should_stop():
            break
        if checkpoints is not None and keyframing is not None:
            checkpoints.offer(results, windows, keyframing)
    if checkpoints is not None and keyframing is not None:
        checkpoints.close(results, windows, keyframing, len(results) == len(sequence))
    return results


def _observe(
    track: TrackedScan, position: int, keyframing: Keyframing | None, monitor: IntegrityMonitor | None
) -> ScanResult:
    """Hand the scan to keyframing and monitor. Returns its result with the times of all stages."""
    entry, result = track.entry, track.result
    stages = {"read": entry.read_s, "prepare": entry.prepare_s, **result.stages}
    if keyframing is not None:
        began = time.perf_counter()
        keyframing.see(position, entry.scan, result, track.sweep)
        stages["keyframe"] = time.perf_counter() - began
    if monitor is not None:
        began = time.perf_counter()
        monitor.see(position, entry.scan, entry.prepared, result, track.sweep)
        stages["integrity"] = time.perf_counter() - began
    return replace(result, stages=stages, fault="" if entry.scan is None else entry.scan.fault)


def sweep_of(sequence: Sequence) -> Span | None:
    """Begin and end of a sweep, s from the stamp: the longest among the first scans with points; None without point times.

    The search ends with a sweep of half a scan period. Motion compensated scans of which the first has no times have none.
    """
    spans: list[Span | None] = []
    for i in range(min(len(sequence), 10)):
        with suppress(InputError):
            scan = sequence.scan(i)
            if len(scan):
                spans.append(None if scan.times is None else scan.span)
        if spans and spans[0] is None and sequence.motion_compensated:
            break
        last = spans[-1] if spans else None
        if len(spans) == _LOOKED_AT or (last is not None and last.seconds * sequence.rate_hz >= 0.5):
            break
    return max((span for span in spans if span is not None), key=lambda span: span.seconds, default=None)


def diverges(results: list[ScanResult]) -> bool:
    """Whether fewer than half of the scans were registered in the frame of the trajectory."""
    return sum(r.status == "ok" and r.frame == 0 for r in results) < max(1, len(results) // 2)


def between_middles(result: ScanResult, middle: tuple[int, Floats], following: TrackedScan) -> ScanResult:
    """The result with `stamp_offset`, by interpolation between the middles of its sweep and the next, if the stamp lies between.

    middle : instant, ns, and pose of the middle of its own sweep

    From its own middle, a stamp at the end of a sweep would be extrapolated: where the sweep changes its direction, the error
    of the speed is as large as a step.
    """
    (begin_ns, begin), (end_ns, end), after = middle, following.middle, following.result
    is_placed = all(r.status == "ok" and not r.repeats_pose and r.segment == after.segment for r in (result, after))
    # No farther from the next middle than a sweep is long: where scans are missing, its own is nearer.
    if not is_placed or not 0 < end_ns - result.stamp_ns <= 2 * (result.stamp_ns - begin_ns):
        return result
    pose = poses_at(np.array([begin_ns, end_ns]), np.stack([begin, end]), np.array([result.stamp_ns]))[0]
    return replace(result, stamp_offset=se3.relative(result.T_world_lidar, pose))


def to_trajectory(results: list[ScanResult], method: str) -> Trajectory:
    """The poses of all scans, with covariances when the method has them.

    A skipped scan adds `PRIOR_COVARIANCE` to the last; that of a scan in another frame is `INFINITE_COVARIANCE`.
    """
    has_covariances = any(r.covariance is not None for r in results)
    covariances: list[Floats] = []
    for result in results if has_covariances else ():
        before = covariances[-1] if covariances else np.zeros((6, 6))
        covariances.append(before + PRIOR_COVARIANCE if result.covariance is None else result.covariance)
    elsewhere = [k for k, result in enumerate(results) if result.frame and has_covariances]
    for k in elsewhere:
        covariances[k] = INFINITE_COVARIANCE
    return Trajectory(
        stamps_ns=np.array([r.stamp_ns for r in results], np.int64),
        poses=np.stack([r.at_stamp.T_world_lidar for r in results]),
        covariances=np.stack(covariances) if has_covariances else None,
        source=method,
    )


def read_ahead(
    sequence: Sequence, prepare: Callable[[Scan], Any] | None, threads: int, first: int = 0
) -> Iterator[ScanInput]:
    """The scans from `first` on, read (and prepared) by one background thread while the caller works on earlier ones."""
    if threads < 2:
        for i in range(first, len(sequence)):
            yield _load(sequence, i, prepare)
        return
    pending: list[Future[ScanInput]] = []
    with ThreadPoolExecutor(1, "lslam-read") as pool:
        try:
            for i in range(first, len(sequence)):
                pending.append(pool.submit(copy_context().run, _load, sequence, i, prepare))
                if len(pending) > _AHEAD:
                    yield pending.pop(0).result()
            while pending:
                yield pending.pop(0).result()
        finally:
            for future in pending:
                future.cancel()


def _load(sequence: Sequence, i: int, prepare: Callable[[Scan], Any] | None) -> ScanInput:
    """Read scan `i` and prepare it, with times taken; unreadable, empty and unusable scans have an `error` instead."""
    stamp_ns = int(sequence.stamps_ns[i])
    began = time.perf_counter()
    try:
        scan = sequence.scan(i)
    except InputError as error:
        # A selection knows the scan's number in the recording, which no scan is there to tell.
        index = int(sequence.indices[i]) if isinstance(sequence, Selection) else i
        return ScanInput(index, stamp_ns, error=str(error), read_s=time.perf_counter() - began)
    read = time.perf_counter()
    if len(scan) == 0:
        return ScanInput(scan.index, stamp_ns, error="the scan has no points", read_s=read - began)
    count, scan = len(scan), measurable(scan)
    if len(scan) == 0:
        why = f"0 usable points: none of {count} is finite and within {FARTHEST_M / 1e3:g} km"
        return ScanInput(scan.index, stamp_ns, error=why, read_s=read - began, status="bridged")
    prepared = prepare(scan) if prepare is not None else None
    return ScanInput(scan.index, stamp_ns, scan, prepared, "", read - began, time.perf_counter() - read)
