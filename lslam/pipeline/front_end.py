"""Scans in, poses out: read ahead, predict, register, correct."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError
from lslam.geometry import se3, so3
from lslam.inertial.fusion import InertialMotion
from lslam.odometry.base import Deskewing, Odometry
from lslam.readers.selection import Selection
from lslam.registration.motion import ConstantVelocity, MotionModel, middle_of
from lslam.registration.registration import DOUBT
from lslam.registration.standing import Standing
from lslam.types.motion_prior import MotionPrior
from lslam.types.scan import Scan
from lslam.types.scan_result import ScanResult
from lslam.types.sequence import Sequence
from lslam.types.trajectory import Trajectory

# Half the points of a scan are nearer.
LEVER_M = 10.0


@dataclass(frozen=True)
class Loaded:
    """One scan as the background thread leaves it; `error` says why there is none."""

    index: int
    stamp_ns: int
    scan: Scan | None = None
    prepared: Any = None
    error: str = ""
    read_s: float = 0.0
    prepare_s: float = 0.0


def estimate(
    sequence: Sequence,
    odometry: Odometry,
    *,
    threads: int = 2,
    max_failures: int = 20,
    standing: Standing | None = None,
    motion: MotionModel | None = None,
    should_stop: Callable[[], bool] = lambda: False,
    on_scan: Callable[[ScanResult], None] = lambda result: None,
) -> list[ScanResult]:
    """Register every scan of the sequence; stops early on `should_stop` or after `max_failures` failures in a row.

    A scan that cannot be read, or is empty, is skipped: the motion prior stands in for its pose. With `standing`, scans
    during which the sensor stands are not registered. `motion` predicts the scans, constant velocity when None.
    """
    tracker = Tracker(odometry, standing, motion)
    results: list[ScanResult] = []
    failures = 0
    for loaded in read_ahead(sequence, odometry.prepare, threads):
        result = tracker.track(loaded)
        result = replace(result, stages={"read": loaded.read_s, "prepare": loaded.prepare_s, **result.stages})
        results.append(result)
        on_scan(result)
        failures = 0 if result.status == "ok" else failures + 1
        if failures >= max_failures or should_stop():
            break
    return results


class Tracker:
    """Predict, register, correct: the loop between motion prior and odometry."""

    # A change of the motion within the sweep that moves no point by more is not worth a second registration.
    REFINE_M = 0.01

    def __init__(self, odometry: Odometry, standing: Standing | None = None, motion: MotionModel | None = None) -> None:
        self.odometry, self.standing = odometry, standing
        self.motion: MotionModel = ConstantVelocity() if motion is None else motion
        # Instant, ns, and pose of the middle of the last sweep: what its registration knows best.
        self.middle = (0, np.eye(4))
        self._first: tuple[Scan, Any, NDArray[np.float64]] | None = None

    def track(self, loaded: Loaded) -> ScanResult:
        """Pose of the next scan."""
        scan = loaded.scan
        if scan is not None and self.standing is not None:
            return self._stand_or_move(scan, loaded, self.standing)
        return self._move(loaded)

    def _stand_or_move(self, scan: Scan, loaded: Loaded, standing: Standing) -> ScanResult:
        began = time.perf_counter()
        result = standing.result_of(scan)
        stages = {"standing": time.perf_counter() - began}
        if result is not None:
            self.motion.correct(result.stamp_ns, result.T_world_lidar)
            return replace(result, stages=stages)
        result = self._move(loaded)
        began = time.perf_counter()
        standing.observe(scan, result)
        stages["standing"] += time.perf_counter() - began
        return replace(result, stages=stages | result.stages)

    def _move(self, loaded: Loaded) -> ScanResult:
        scan = loaded.scan
        span = sweep_seconds(scan)
        prior = expected = self.motion.sweep(loaded.stamp_ns, span)
        inertial = self.motion if isinstance(self.motion, InertialMotion) else None
        steady = None if inertial is None else inertial.coasting.predict(loaded.stamp_ns)
        if scan is None:
            result = ScanResult(loaded.index, loaded.stamp_ns, prior.start, "skipped", loaded.error, converged=False)
        elif isinstance(self.odometry, Deskewing):
            result, prior = self._register(self.odometry, scan, loaded.prepared, prior)
        else:
            result = self.odometry.register(scan, loaded.prepared, prior)
        self.motion.correct(result.stamp_ns, result.T_world_lidar, prior, result.status == "ok")
        pose, instant_ns = middle_of(prior, result.stamp_ns, result.T_world_lidar)
        self.middle = (instant_ns, pose)
        found = result.T_world_lidar
        return replace(
            result,
            prior_norm=_matrix_norm(expected.start, found),
            steady_norm=None if steady is None else _matrix_norm(steady, found),
            gravity=inertial.gravity_at(found) if inertial is not None and result.status == "ok" else None,
        )

    def _register(
        self, odometry: Deskewing, scan: Scan, prepared: Any, prior: MotionPrior
    ) -> tuple[ScanResult, MotionPrior]:
        """Register, and again with the motion within the sweep that this found; the prior that was right."""
        result = odometry.register(scan, prepared, prior)
        if result.status == "ok" and sweep_seconds(scan) > 0:
            if self._first is None:
                self._first = (scan, prepared, result.T_world_lidar)
            elif isinstance(self.motion, ConstantVelocity) and not self.motion.is_known:
                prior = self._begin_again(odometry, self.motion, scan, result)
                result = odometry.register(scan, prepared, prior)
            else:
                better = self.motion.refine(prior, scan.stamp_ns, result.T_world_lidar)
                if _distance(prior, better) > self.REFINE_M:
                    prior = better
                    result = odometry.register(scan, prepared, prior)
        return odometry.update(scan, prepared, prior, result), prior

    def _begin_again(
        self, odometry: Deskewing, motion: ConstantVelocity, scan: Scan, result: ScanResult
    ) -> MotionPrior:
        """The first scan was taken at an unknown speed: now that it is known, deskew it and build the map anew."""
        assert self._first is not None
        first, prepared, pose = self._first
        motion.correct(scan.stamp_ns, result.T_world_lidar)
        prior = motion.steady(pose, sweep_seconds(first))
        odometry.restart()
        odometry.update(first, prepared, prior, odometry.register(first, prepared, prior))
        self.motion = ConstantVelocity()
        self.motion.correct(first.stamp_ns, pose, prior)
        return motion.steady(motion.predict(scan.stamp_ns), sweep_seconds(scan))


def has_point_times(sequence: Sequence) -> bool:
    """Whether the scans have per-point times: the first that can be read speaks for all."""
    for i in range(min(len(sequence), 10)):
        with suppress(InputError):
            return sequence.scan(i).times is not None
    return False


def sweep_seconds(scan: Scan | None) -> float:
    """How long the sensor took for the scan, s; 0 when its points belong to one instant."""
    return 0.0 if scan is None or scan.times is None or len(scan) == 0 else max(float(scan.times.max()), 0.0)


def _matrix_norm(prior: NDArray[np.float64], pose: NDArray[np.float64]) -> float:
    """Error of the motion prior, (4, 4), against registration: the largest singular value of inv(prior) pose - I.

    First thesis, equation 5.1.
    """
    return float(np.linalg.norm(se3.relative(prior, pose) - np.eye(4), 2))


def _distance(before: MotionPrior, after: MotionPrior) -> float:
    """How far the motion within a sweep differs at its end, m, at a lever arm of `LEVER_M`."""
    change = se3.relative(se3.relative(before.start, before.poses[-1]), se3.relative(after.start, after.poses[-1]))
    return float(np.linalg.norm(change[:3, 3]) + LEVER_M * so3.angle(change[:3, :3]))


def is_diverged(results: list[ScanResult], max_failures: int) -> bool:
    """Whether the run was given up: the last `max_failures` scans all failed, or hardly any scan was registered."""
    tail = results[-max_failures:]
    given_up = len(tail) == max_failures and all(r.status != "ok" for r in tail)
    return given_up or sum(r.status == "ok" for r in results) < max(1, len(results) // 2)


def to_trajectory(results: list[ScanResult], method: str) -> Trajectory:
    """The poses of all scans; covariances when the method has them, where a scan was skipped the last one and `DOUBT`."""
    known = any(r.covariance is not None for r in results)
    covariances: list[NDArray[np.float64]] = []
    for result in results if known else ():
        before = covariances[-1] if covariances else np.zeros((6, 6))
        covariances.append(before + DOUBT if result.covariance is None else result.covariance)
    return Trajectory(
        stamps_ns=np.array([r.stamp_ns for r in results], np.int64),
        poses=np.stack([r.T_world_lidar for r in results]),
        covariances=np.stack(covariances) if known else None,
        source=method,
    )


def read_ahead(
    sequence: Sequence, prepare: Callable[[Scan], Any] | None, threads: int, depth: int = 2
) -> Iterator[Loaded]:
    """The scans in order, read (and prepared) by one background thread while the caller works on earlier ones."""
    if threads < 2:
        for i in range(len(sequence)):
            yield _load(sequence, i, prepare)
        return
    pending: list[Future[Loaded]] = []
    with ThreadPoolExecutor(1, "lslam-read") as pool:
        try:
            for i in range(len(sequence)):
                pending.append(pool.submit(_load, sequence, i, prepare))
                if len(pending) > depth:
                    yield pending.pop(0).result()
            while pending:
                yield pending.pop(0).result()
        finally:
            for future in pending:
                future.cancel()


def _load(sequence: Sequence, i: int, prepare: Callable[[Scan], Any] | None) -> Loaded:
    stamp_ns = int(sequence.stamps_ns[i])
    began = time.perf_counter()
    try:
        scan = sequence.scan(i)
    except InputError as error:
        # A selection knows the scan's number in the recording, which no scan is there to tell.
        index = int(sequence.indices[i]) if isinstance(sequence, Selection) else i
        return Loaded(index, stamp_ns, error=str(error), read_s=time.perf_counter() - began)
    read = time.perf_counter()
    if len(scan) == 0:
        return Loaded(scan.index, stamp_ns, error="the scan has no points", read_s=read - began)
    prepared = prepare(scan) if prepare is not None else None
    return Loaded(scan.index, stamp_ns, scan, prepared, "", read - began, time.perf_counter() - read)
