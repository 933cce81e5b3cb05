"""Predict, register, correct: the loop between motion prior and odometry."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, cast

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.geometry import se3
from lslam.core.types.imu import ImuDiagnostics
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import LEVER_M, Scan, Span
from lslam.core.types.scan_result import ScanResult, StageClock, Status, sum_stages
from lslam.core.types.state import State, Stateful
from lslam.odometry.base import Deskewing, Odometry, Registering, Resumable, WindowMethod
from lslam.odometry.inertial.constant_velocity import ConstantVelocity, MotionModel, middle_of
from lslam.odometry.inertial.window import WindowMotion
from lslam.odometry.scan_outcome import fault, plausible
from lslam.odometry.stationary import StationaryDetector
from lslam.registration.gaussian_map import FLOOR_M2
from lslam.registration.result import RegistrationResult

# Registers the scan that is being tracked from a motion prior.
Register = Callable[..., RegistrationResult]


@dataclass(frozen=True)
class ScanInput:
    """One scan as the background thread leaves it; `error` : why it is unreadable, and `status` : what its result has then."""

    index: int
    stamp_ns: int
    scan: Scan | None = None
    prepared: Any = None
    error: str = ""
    read_s: float = 0.0
    prepare_s: float = 0.0
    status: Status = "skipped"


class Tracker(Stateful):
    """Poses of scans, one after the other.

    sweep : motion of the sensor within the last scan, as used by its registration
    middle : instant, ns, and pose of the middle of the last sweep, where registration is most accurate
    """

    # A change of the motion within the sweep that moves no point by more, as surfaces are thick, is not worth a second
    # registration.
    REFINE_M = FLOOR_M2**0.5
    STATE = ("motion", "stationary", "middle", "_last")

    def __init__(
        self, odometry: Odometry, stationary: StationaryDetector | None = None, motion: MotionModel | None = None
    ) -> None:
        self.odometry, self.stationary = odometry, stationary
        # Asked for in each scan, and a tenth of a millisecond each time that a protocol is.
        self._deskewing = odometry if isinstance(odometry, Deskewing) else None
        self._window_method = odometry if isinstance(odometry, WindowMethod) else None
        self.motion: MotionModel = ConstantVelocity() if motion is None else motion
        self.sweep = MotionPrior.at_once(np.eye(4))
        self.middle = (0, np.eye(4))
        # Of the scan that is being tracked.
        self._clock = StageClock()
        # The newest accepted result.
        self._last: ScanResult | None = None
        # The first scan, until a second one tells how fast it was taken.
        self._first: tuple[Scan, Any, Floats] | None = None

    def track(self, entry: ScanInput) -> ScanResult:
        """Estimate the pose of the next scan and update odometry and motion model by it."""
        scan, motion, clock = entry.scan, self.motion, StageClock()
        self._clock = clock
        standing = self._standing(scan)
        if standing is not None:
            self._keep(standing)
            return replace(standing, stages=clock.seconds)
        span = Span() if scan is None else scan.span
        with clock.stage("imu"):
            prior = expected = motion.sweep(entry.stamp_ns, span)
        steady = None if motion.coasting is None else motion.coasting.predict(entry.stamp_ns)
        trial = None
        if scan is None:
            result = ScanResult(entry.index, entry.stamp_ns, prior.pose, entry.status, entry.error, converged=False)
        elif self._deskewing is not None:
            odometry = self._deskewing
            register: Register = partial(odometry.register, scan, entry.prepared)
            if motion.coasting is not None and motion.needs_comparison(entry.stamp_ns, span):
                # For comparison alone: the map and the motion model are not updated.
                without = motion.coasting.sweep(scan.stamp_ns, span)
                trial, _ = self._refine(register, scan, without, motion.coasting, StageClock())
            is_first_open = self._first is not None or not motion.is_known
            # While the motion is unknown the clouds of several LiDARs do not fit each other: one of them tells it.
            alone = scan.of_leading() if is_first_open else None
            if alone is None:
                alignment, prior = self._refine(register, scan, prior, motion, clock)
            else:
                own = partial(odometry.register, alone, odometry.prepare(alone))
                alignment, prior = self._refine(own, alone, prior, motion, clock)
            if is_first_open and alignment.is_accepted and scan.span.seconds > 0:
                if self._first is None:
                    self._first = (scan, entry.prepared, alignment.T_world_lidar)
                else:
                    prior = expected = self._begin_again(odometry, *self._first, scan, alignment)
                    alignment = register(prior)
                    prior = alignment.sweep or prior
            alignment, prior = self._fuse(odometry, register, scan.stamp_ns, alignment, prior, expected)
            result = odometry.update(scan, prior, alignment)
        else:
            registering = cast(Registering, self.odometry)
            result = plausible(registering.register(scan, entry.prepared, prior), prior.pose, self._last)
        self._correct(result, prior)
        if self.stationary is not None and scan is not None:
            with clock.stage("standing"):
                self.stationary.observe(scan, result)
        self._keep(result)
        return self._record(result, expected, steady, trial)

    @property
    def is_deskewing(self) -> bool:
        """Whether the method takes the motion within a sweep from the prior."""
        return self._deskewing is not None

    @property
    def is_complete(self) -> bool:
        """Whether nothing waits for the next scan, so that `state` is complete."""
        return self._first is None

    def state(self) -> State:
        """State for a checkpoint; of a method that is not `Resumable`, only that of the tracker and the motion model."""
        return {**super().state(), "odometry": self.odometry.state() if isinstance(self.odometry, Resumable) else None}

    def restore(self, state: State) -> None:
        """Replace the state by `state`."""
        if isinstance(self.odometry, Resumable) and state["odometry"] is not None:
            self.odometry.restore(state["odometry"])
        super().restore(state)

    def _standing(self, scan: Scan | None) -> ScanResult | None:
        """The result of a scan if the sensor has stood still, with which the motion model is updated; None if it has moved."""
        if scan is None or self.stationary is None:
            return None
        with self._clock.stage("standing"):
            result = self.stationary.result_of(scan)
        if result is not None:
            self.motion.correct(result.stamp_ns, result.T_world_lidar)
            self.sweep = MotionPrior.at_once(result.T_world_lidar)
        return result

    def _keep(self, result: ScanResult) -> None:
        """Keep an accepted result as the last one; drop the first scan once the speed is known."""
        if self.motion.is_known:
            self._first = None
        if result.status == "ok":
            self._last = result

    def _fuse(
        self,
        odometry: Deskewing,
        register: Register,
        stamp_ns: int,
        alignment: RegistrationResult,
        prior: MotionPrior,
        expected: MotionPrior,
    ) -> tuple[RegistrationResult, MotionPrior]:
        """The registration fused with the IMU, or one repeated from the prediction `expected`, and the motion within the sweep.

        A registration is rejected where no vehicle could reach its pose from the last one.
        """
        with self._clock.stage("imu"):
            fused = _fuse_with(self.motion, odometry, stamp_ns, alignment, prior)
        if fused.is_accepted and (reason := fault(fused.T_world_lidar, stamp_ns, self._last)):
            fused = fused.reject(reason, expected.pose.copy(), None)
        if fused.is_accepted or not self.motion.is_inertial or not odometry.is_searching:
            return fused, prior
        near = register(expected, is_near=True)
        with self._clock.stage("imu"):
            again = _fuse_with(self.motion, odometry, stamp_ns, near, expected)
        near = _both(alignment, again if again.is_accepted else _nearest(near, alignment, fused, expected))
        return near, expected if near.sweep is None else near.sweep

    def _correct(self, result: ScanResult, prior: MotionPrior) -> None:
        """Update the motion model and the motion within the sweep."""
        pose, is_ok = result.T_world_lidar, result.status == "ok"
        is_blind = is_ok and self._deskewing is None
        with self._clock.stage("imu"):
            self.sweep = self.motion.refine(prior, result.stamp_ns, pose) if is_blind else prior
            self.motion.correct(result.stamp_ns, pose, prior, is_ok)
            if self._window_method is not None:
                self._window_method.finalise(self.motion.poses() if isinstance(self.motion, WindowMotion) else {})
        middle, instant_ns = middle_of(prior, result.stamp_ns, pose)
        self.middle = (instant_ns, middle)

    def _record(
        self, result: ScanResult, expected: MotionPrior, steady: Floats | None, trial: RegistrationResult | None
    ) -> ScanResult:
        """The result with the error of its predictions, and with the cost of registration from constant velocity (`trial`).

        steady : (4, 4) prediction of constant velocity. The time of the map's update counts for neither.
        """
        pose, is_ok = result.T_world_lidar, result.status == "ok"
        own = {
            name: seconds
            for name, seconds in self._clock.seconds.items()
            if name != "imu" or self.motion.coasting is not None
        }
        imu = ImuDiagnostics(
            self.motion.imu_state(),
            self.motion.gravity_at(pose) if is_ok else None,
            None if steady is None else _matrix_norm(steady, pose),
        )
        stages = {**result.stages, **own}
        if trial is not None and trial.is_accepted and result.status != "bridged":
            work_s = sum(seconds for name, seconds in stages.items() if name not in ("update", "standing"))
            saved_s = sum(trial.stages.values()) - work_s
            imu = replace(imu, steady_iterations=trial.iterations, saved_s=saved_s)
        return replace(result, prior_norm=_matrix_norm(expected.pose, pose), imu=imu, stages=stages)

    def _refine(
        self, register: Register, scan: Scan, prior: MotionPrior, motion: MotionModel, clock: StageClock
    ) -> tuple[RegistrationResult, MotionPrior]:
        """Register, and once more if the motion within the sweep that follows from the pose differs; with the motion used last.

        motion : refines the prior by the registered pose; clock : measures its time
        """
        alignment = register(prior)
        if alignment.sweep is not None:
            return alignment, alignment.sweep
        if not motion.is_known or not alignment.ok or scan.span.seconds <= 0:
            return alignment, prior
        with clock.stage("imu"):
            better = motion.refine(prior, scan.stamp_ns, alignment.T_world_lidar)
        if _distance(prior, better) <= self.REFINE_M:
            return alignment, prior
        return _both(alignment, register(better)), better

    def _begin_again(
        self,
        odometry: Deskewing,
        first: Scan,
        prepared: Any,
        pose: Floats,
        second: Scan,
        alignment: RegistrationResult,
    ) -> MotionPrior:
        """Deskew the first scan, taken at an unknown speed, by the speed that the second revealed, and build the map anew.

        Returns the prior of the second scan, to be registered again.
        """
        self.motion.correct(second.stamp_ns, alignment.T_world_lidar)
        again = self.motion.sweep(second.stamp_ns, second.span)
        prior = self.motion.rewind(first.stamp_ns, pose, first.span)
        odometry.restart()
        odometry.update(first, prior, odometry.register(first, prepared, prior))
        return again


def _fuse_with(
    motion: MotionModel, odometry: Deskewing, stamp_ns: int, result: RegistrationResult, prior: MotionPrior
) -> RegistrationResult:
    """Registration fused by the motion model. A window is fused with the scan's normal equations, and once more if it moved."""
    if not (isinstance(motion, WindowMotion) and isinstance(odometry, WindowMethod)):
        return motion.fuse(stamp_ns, result, prior)
    motion.set_equations(odometry.equations(stamp_ns, result))
    fused = motion.fuse(stamp_ns, result, prior)
    again = odometry.equations_at(motion.stale())
    if not again:
        return fused
    motion.set_equations(again)
    return motion.fuse(stamp_ns, result, prior)


def _nearest(
    near: RegistrationResult, alignment: RegistrationResult, denial: RegistrationResult, expected: MotionPrior
) -> RegistrationResult:
    """The result to enter after a registration that failed or that the IMU rejected, and one close to its prediction (`near`).

    With perceptual aliasing a wide search converges at the wrong place. If both initial guesses lead to the same minimum, it
    is accepted against the IMU.
    """
    is_same = apart(near.T_world_lidar, alignment.T_world_lidar) < apart(near.T_world_lidar, expected.pose)
    source = alignment if near.ok and is_same else denial
    # Where nothing is found near by, the first registration enters with the points as they are seen from there.
    base = near
    if not near.ok:
        own = replace(alignment, points=near.points, sweep=near.sweep)
        base = replace(own, iterations=near.iterations, stages=near.stages)
    moved = base.with_pose(source.T_world_lidar, source.covariance)
    is_rejected = base.ok and not source.is_accepted
    return replace(moved, is_rejected=is_rejected, reason=source.reason, converged=source.converged)


def _both(first: RegistrationResult, second: RegistrationResult) -> RegistrationResult:
    """The second registration of a scan, with the iterations and times of both."""
    stages = sum_stages([first.stages, second.stages])
    return replace(second, iterations=first.iterations + second.iterations, stages=stages)


def _matrix_norm(prior: Floats, pose: Floats) -> float:
    """Error of the prior (4, 4): largest singular value of inv(prior) pose - I (Girolimetto, equation 5.1)."""
    return float(np.linalg.norm(se3.relative(prior, pose) - np.eye(4), 2))


def _distance(before: MotionPrior, after: MotionPrior) -> float:
    """Difference, m, of two motions from the start to the end of a sweep, rotations at a lever arm of `LEVER_M`."""
    return apart(*(se3.relative(prior.poses[0], prior.poses[-1]) for prior in (before, after)))


def apart(a: Floats, b: Floats) -> float:
    """Distance, m, of two poses (4, 4), their rotation at a lever arm of `LEVER_M`."""
    move, turn = se3.magnitude(se3.relative(a, b))
    return move + LEVER_M * turn
