"""Predict, register, correct: the loop between motion prior and odometry."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.frontend import joint
from lslam.geometry import se3, so3
from lslam.integrity.monitor import IntegrityMonitor
from lslam.odometry.base import Deskewing, Odometry, Registered, Resumable, Searching
from lslam.odometry.sanity import plausible
from lslam.odometry.stationary import StationaryDetector
from lslam.registration.constant_velocity import ConstantVelocity, MotionModel, middle_of
from lslam.types.motion_prior import MotionPrior
from lslam.types.scan import Scan, Span
from lslam.types.scan_result import ScanResult, Status
from lslam.types.stage_clock import StageClock
from lslam.types.state import State

# Lever arm of rotations: half the points of a scan are nearer.
LEVER_M = 10.0
# Two registrations from different initial guesses are the same minimum if their distance is below this part of the distance
# between the prior and the first.
SAME = 0.3


@dataclass(frozen=True)
class Loaded:
    """One scan as the background thread leaves it; `error` : why it is unreadable, and `status` : what its result has then."""

    index: int
    stamp_ns: int
    scan: Scan | None = None
    prepared: Any = None
    error: str = ""
    read_s: float = 0.0
    prepare_s: float = 0.0
    status: Status = "skipped"


class Tracker:
    """Poses of scans, one after the other.

    sweep : motion of the sensor within the last scan, as used by its registration
    monitor : checks the poses that were found, by `check`
    middle : instant, ns, and pose of the middle of the last sweep, where registration is most accurate
    """

    # A change of the motion within the sweep that moves no point by more is not worth a second registration.
    REFINE_M = 0.01

    def __init__(
        self, odometry: Odometry, stationary: StationaryDetector | None = None, motion: MotionModel | None = None,
        monitor: IntegrityMonitor | None = None,
    ) -> None:  # fmt: skip
        self.odometry, self.stationary, self.monitor = odometry, stationary, monitor
        self.motion: MotionModel = ConstantVelocity() if motion is None else motion
        self.sweep = MotionPrior.at_once(np.eye(4))
        self.middle = (0, np.eye(4))
        # The newest accepted result.
        self._last: ScanResult | None = None
        # The first scan, until a second one tells how fast it was taken.
        self._first: tuple[Scan, Any, NDArray[np.float64]] | None = None

    def track(self, loaded: Loaded) -> ScanResult:
        """Pose of the next scan."""
        scan = loaded.scan
        if scan is not None and self.stationary is not None:
            result = self._stand_or_move(scan, loaded, self.stationary)
        else:
            result = self._move(loaded)
        if self.motion.is_known:
            self._first = None
        if result.status == "ok":
            self._last = result
        return result

    def check(self, position: int, loaded: Loaded, result: ScanResult) -> None:
        """Have the monitor, if there is one, check what `track` found for the scan at this position of the run."""
        if self.monitor is not None:
            self.monitor.see(position, loaded.scan, loaded.prepared, result, self.sweep)

    @property
    def is_settled(self) -> bool:
        """Whether nothing waits for the next scan, so that `state` is complete."""
        return self._first is None

    def state(self) -> State:
        """What `restore` needs to go on from here; of a method that is not `Resumable`, only what is around it."""
        return {
            "odometry": self.odometry.state() if isinstance(self.odometry, Resumable) else None,
            "motion": self.motion.state(),
            "stationary": None if self.stationary is None else self.stationary.state(),
            "middle": self.middle,
            "last": self._last,
            "monitor": None if self.monitor is None else self.monitor.state(),
        }

    def restore(self, state: State) -> None:
        """Go on where `state` was taken."""
        if isinstance(self.odometry, Resumable) and state["odometry"] is not None:
            self.odometry.restore(state["odometry"])
        self.motion.restore(state["motion"])
        if self.stationary is not None:
            self.stationary.restore(state["stationary"])
        self.middle, self._last = state["middle"], state["last"]
        if self.monitor is not None:
            self.monitor.restore(state["monitor"])

    def _stand_or_move(self, scan: Scan, loaded: Loaded, stationary: StationaryDetector) -> ScanResult:
        began = time.perf_counter()
        result = stationary.result_of(scan)
        stages = {"standing": time.perf_counter() - began}
        if result is not None:
            self.motion.correct(result.stamp_ns, result.T_world_lidar)
            self.sweep = MotionPrior.at_once(result.T_world_lidar)
            return replace(result, stages=stages)
        result = self._move(loaded)
        began = time.perf_counter()
        stationary.observe(scan, result)
        stages["standing"] += time.perf_counter() - began
        return replace(result, stages=stages | result.stages)

    def _move(self, loaded: Loaded) -> ScanResult:
        scan, odometry, motion = loaded.scan, self.odometry, self.motion
        span = Span() if scan is None else scan.span
        clock = StageClock()
        with clock.stage("imu"):
            prior = expected = motion.sweep(loaded.stamp_ns, span)
        coasting = motion.coasting
        steady = None if coasting is None else coasting.predict(loaded.stamp_ns)
        trial = None
        if scan is None:
            result = ScanResult(loaded.index, loaded.stamp_ns, prior.pose, loaded.status, loaded.error, converged=False)
        elif isinstance(odometry, Deskewing):
            if coasting is not None and motion.is_compared(loaded.stamp_ns, span):
                # For comparison alone: the map and the motion model are not updated.
                without = coasting.sweep(scan.stamp_ns, span)
                trial = self._align(odometry, scan, loaded.prepared, without, coasting)[0].result
            result, prior = self._register(odometry, scan, loaded.prepared, prior, clock)
        else:
            result = plausible(odometry.register(scan, loaded.prepared, prior), prior.pose, self._last)
        found = result.T_world_lidar
        is_blind = result.status == "ok" and not isinstance(odometry, Deskewing)
        with clock.stage("imu"):
            self.sweep = motion.refine(prior, result.stamp_ns, found) if is_blind else prior
            motion.correct(result.stamp_ns, found, prior, result.status == "ok")
            joint.settle(odometry, motion)
        pose, instant_ns = middle_of(prior, result.stamp_ns, found)
        self.middle = (instant_ns, pose)
        result = replace(
            result,
            prior_norm=_matrix_norm(expected.pose, found),
            steady_norm=None if steady is None else _matrix_norm(steady, found),
            gravity=motion.gravity_at(found) if result.status == "ok" else None,
            imu=motion.imu_state(),
            stages=result.stages if coasting is None else {**result.stages, **clock.seconds},
        )
        return result if trial is None or "bridged" in (trial.status, result.status) else _compared(result, trial)

    def _register(
        self, odometry: Deskewing, scan: Scan, prepared: Any, prior: MotionPrior, clock: StageClock
    ) -> tuple[ScanResult, MotionPrior]:
        """Register the scan, fuse the pose with the IMU and update the map; also the motion that it was deskewed with."""
        expected = prior
        is_first_open = self._first is not None or not self.motion.is_known
        # While the motion is unknown the clouds of several LiDARs do not fit each other: one of them tells it.
        alone = scan.of_leading() if is_first_open else None
        found, prior = self._align(
            odometry, scan if alone is None else alone, prepared if alone is None else odometry.prepare(alone), prior,
            self.motion, clock,
        )  # fmt: skip
        if found.result.status == "ok" and scan.span.seconds > 0 and is_first_open:
            if self._first is None:
                self._first = (scan, prepared, found.result.T_world_lidar)
            else:
                prior = expected = self._begin_again(odometry, *self._first, found.result, scan.span)
                found, prior = self._align(odometry, scan, prepared, prior)
        with clock.stage("imu"):
            weighed = joint.weighed(odometry, self.motion, found, prior)
        weighed = plausible(weighed, expected.pose, self._last)
        if weighed.status != "ok" and self.motion.is_inertial and isinstance(odometry, Searching):
            found = self._near(odometry, scan, prepared, expected, found, weighed, clock)
            prior = expected if found.sweep is None else found.sweep
        else:
            found = replace(found, result=weighed)
        return odometry.update(prior, found), prior

    def _align(
        self, odometry: Deskewing, scan: Scan, prepared: Any, prior: MotionPrior, motion: MotionModel | None = None,
        clock: StageClock | None = None,
    ) -> tuple[Registered, MotionPrior]:  # fmt: skip
        """Register, and again with the motion within the sweep that follows from it; also the motion of the final deskewing.

        motion : refines the prior by the registered pose; None: no second registration
        clock : measures the time of `motion`
        """
        found = odometry.register(scan, prepared, prior)
        if found.sweep is not None:
            return found, found.sweep
        if motion is None or not motion.is_known or found.result.status != "ok" or scan.span.seconds <= 0:
            return found, prior
        with (clock or StageClock()).stage("imu"):
            better = motion.refine(prior, scan.stamp_ns, found.result.T_world_lidar)
        if _distance(prior, better) <= self.REFINE_M:
            return found, prior
        again = odometry.register(scan, prepared, better)
        return replace(again, result=_both(found.result, again.result)), better

    def _near(
        self, odometry: Searching, scan: Scan, prepared: Any, prior: MotionPrior, found: Registered, denied: ScanResult,
        clock: StageClock,
    ) -> Registered:  # fmt: skip
        """Register again near the IMU's prediction, after a registration that failed or whose pose the IMU overruled (`denied`).

        With perceptual aliasing a wide search converges at the wrong place. The same minimum from both initial guesses is
        accepted against the IMU.
        """
        near, first = odometry.register_near(scan, prepared, prior, found), found.result
        with clock.stage("imu"):
            weighed = joint.weighed(odometry, self.motion, near, prior)
        if weighed.status == "ok":
            return replace(near, result=_both(first, weighed))
        apart, off = (_apart(pose, first.T_world_lidar) for pose in (near.result.T_world_lidar, prior.pose))
        is_same = near.result.status == "ok" and apart < SAME * off
        return replace(near, result=_both(near.result, first if is_same else denied))

    def _begin_again(
        self, odometry: Deskewing, first: Scan, prepared: Any, pose: NDArray[np.float64], second: ScanResult, span: Span
    ) -> MotionPrior:
        """The first scan was taken at an unknown speed: now that it is known, deskew it and build the map anew.

        The prior of the second scan, whose registration told the speed; `span` is that of its sweep.
        """
        self.motion.correct(second.stamp_ns, second.T_world_lidar)
        again = self.motion.sweep(second.stamp_ns, span)
        prior = self.motion.rewind(first.stamp_ns, pose, first.span)
        odometry.restart()
        odometry.update(prior, self._align(odometry, first, prepared, prior)[0])
        return again


def _compared(result: ScanResult, trial: ScanResult) -> ScanResult:
    """The result beside what registration from constant velocity took; the map's update is no part of either."""
    own = sum(seconds for name, seconds in result.stages.items() if name != "update")
    return replace(result, steady_iterations=trial.iterations, saved_s=sum(trial.stages.values()) - own)


def _both(first: ScanResult, second: ScanResult) -> ScanResult:
    """The second registration of a scan, with the iterations and times of both."""
    stages = {name: first.stages.get(name, 0.0) + second.stages.get(name, 0.0) for name in first.stages | second.stages}
    return replace(second, iterations=first.iterations + second.iterations, stages=stages)


def _matrix_norm(prior: NDArray[np.float64], pose: NDArray[np.float64]) -> float:
    """Error of the motion prior, (4, 4), against registration: the largest singular value of inv(prior) pose - I.

    Girolimetto, equation 5.1.
    """
    return float(np.linalg.norm(se3.relative(prior, pose) - np.eye(4), 2))


def _distance(before: MotionPrior, after: MotionPrior) -> float:
    """How far the motion from a sweep's start to its end differs, m, at a lever arm of `LEVER_M`."""
    return _apart(*(se3.relative(prior.poses[0], prior.poses[-1]) for prior in (before, after)))


def _apart(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """How far two poses (4, 4) are apart, m, at a lever arm of `LEVER_M`."""
    change = se3.relative(a, b)
    return float(np.linalg.norm(change[:3, 3]) + LEVER_M * so3.angle(change[:3, :3]))
