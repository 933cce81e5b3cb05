"""Wheels as a motion model: they predict the way and the turn, constant velocity the rest, and registration corrects both."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.config.odometry import WheelsConfig
from lslam.core.geometry import se3, so3
from lslam.core.kernels.linearisation import RARE_SIGMAS
from lslam.core.types.imu import GRAVITY, WheelStream
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import LEVER_M, Span
from lslam.core.types.sequence import Sequence
from lslam.io.readers.wheels import read_wheels
from lslam.odometry.inertial.constant_velocity import USUAL_ACCELERATION, ConstantVelocity, middle_of
from lslam.odometry.inertial.imu_cleaning import WHEEL_GAP_S, covers, gaps
from lslam.odometry.inertial.imu_estimate import PredictionErrors
from lslam.odometry.inertial.wheel_calibration import (
    OFFSET_S,
    YAW_OFFSET,
    YAW_SCALE,
    U,
    WheelCalibration,
    WheelStep,
    by_axis,
    learn_noise,
    squares_along,
)
from lslam.odometry.kernels import kalman
from lslam.odometry.kernels.rotation import apart
from lslam.registration.result import RegistrationResult

log = logging.getLogger("lslam")

# (m/s2)2 along and across, (rad/s2)2: least of what constant velocity does not follow.
LEAST_ACCELERATION = np.array([0.1, 0.1, 0.03]) ** 2
# m2 and rad2, of the directions of which wheels, or surfaces, say nothing.
UNTOLD = 1e2


@dataclass(frozen=True)
class ReckonedStep:
    """The LiDAR's motion to an instant, by wheels and constant velocity together.

    pose : (4, 4) in the world; covariance : (4, 4) of the wheels' part in the way and the turn, axes of the LiDAR at the begin
    wheels, steady : of either alone, (4, 4) in axes of the begin; is_slip : wheels change their speed more than tyres hold
    """

    pose: Floats
    covariance: Floats
    wheels: WheelStep
    steady: Floats
    is_slip: bool


@dataclass(frozen=True)
class LearntFromScan:
    """Estimates updated by a registered step: calibration, accelerations with their counts, and prediction errors, m.

    errors : none where surfaces do not observe the path length
    """

    instant_ns: int
    calibration: WheelCalibration
    acceleration: Floats
    counts: Floats
    errors: tuple[float, float] | None


class WheelMotion(ConstantVelocity):
    """Constant velocity, corrected by the wheels' translation and yaw between scans as far as these predict better.

    Both predictions are averaged by their noise, which is estimated while driving: wheels of another robot get no weight. A
    registered motion is fused with the wheels' by the covariances of both. Tyres transmit no more than gravity: a speed of the
    wheels that changes faster is slip, and constant velocity is used. The motion within a sweep is that of constant velocity.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        *ConstantVelocity.STATE,
        "calibration",
        "refusal",
        "slip_scans",
        "gap_scans",
        "_acceleration",
        "_counts",
        "_agreed_ns",
        "_was_bridged",
        "errors",
    )
    TRANSIENT: ClassVar[tuple[str, ...]] = (*ConstantVelocity.TRANSIENT, "_reckoned", "_learnt")

    def __init__(self, wheels: WheelStream, pose: Floats | None = None) -> None:
        super().__init__(pose)
        self.wheels = wheels
        self.calibration = WheelCalibration.of(wheels)
        self.refusal = ""
        self.slip_scans = self.gap_scans = 0
        self._gaps = gaps(wheels, WHEEL_GAP_S)
        # Of constant velocity: variances along and across, (m/s2)2, and of the turn, (rad/s2)2, and the steps behind them.
        self._acceleration, self._counts = np.square(USUAL_ACCELERATION[[0, 0, 3]]), np.ones(3)
        # When wheels last changed their speed by no more than tyres hold, ns.
        self._agreed_ns: int | None = None
        # Whether the newest pose has no registration.
        self._was_bridged = False
        # Until the next `correct`: the step to the scan, and what its registration told.
        self._reckoned: ReckonedStep | None = None
        self._learnt: LearntFromScan | None = None
        self.errors = PredictionErrors()

    def fresh(self, pose: Floats) -> WheelMotion:
        """One that has learnt as much, and expects the first scan at `pose` (4, 4)."""
        other = WheelMotion(self.wheels, pose)
        empty = other.state()
        other.restore({**self.state(), **{name: empty[name] for name in ConstantVelocity.STATE}})
        return other

    @property
    def is_inertial(self) -> bool:
        """Whether wheels predicted the newest sweep: a denied or lost scan is searched near there."""
        return self._reckoned is not None and self._step_s > 0

    def sweep(self, stamp_ns: int, span: Span) -> MotionPrior:
        """Poses over the `span` of the sweep; the one at the stamp when it takes no time."""
        prior = super().sweep(stamp_ns, span)
        self._reckoned = None if prior.change is not None else self._reckon(stamp_ns)
        if self._reckoned is None:
            return prior
        return replace(prior, poses=self._reckoned.pose @ se3.relative(prior.pose, prior.poses))

    def fuse(self, stamp_ns: int, result: RegistrationResult, prior: MotionPrior) -> RegistrationResult:
        """Fuse the registered motion since the last scan with the wheels', each weighted by its covariance.

        A registration that contradicts both wheels and constant velocity is rejected. prior : motion within the sweep
        """
        middle, instant_ns = middle_of(prior, stamp_ns, result.T_world_lidar)
        if result.covariance is None or not result.is_accepted:
            return result
        reckoning = self._reckoned = self._reckon(instant_ns)
        if reckoning is None:
            return result
        C = result.covariance
        self._learnt = self._learn_from(reckoning, instant_ns, middle, C + _unobserved_covariance(result))
        up = self._pose[:3, :3] @ self.calibration.up
        G = np.zeros((6, 4))
        G[:3, :3], G[3:, 3] = self._pose[:3, :3], up
        P = G @ reckoning.covariance @ G.T
        P[3:, 3:] += UNTOLD * (np.eye(3) - np.outer(up, up))
        turn = so3.log(middle[:3, :3] @ reckoning.pose[:3, :3].T)
        rest = np.concatenate([middle[:3, 3] - reckoning.pose[:3, 3], turn])
        excess = kalman.square(rest, P + 2 * C) / RARE_SIGMAS**2
        if excess > len(G.T) and self._is_contrary(reckoning, middle):
            pose = reckoning.pose @ se3.relative(middle, result.T_world_lidar)
            metres, degrees = float(np.linalg.norm(rest[:3])), float(np.rad2deg(np.linalg.norm(rest[3:])))
            reason = f"registration is {metres:.2f} m and {degrees:.1f} deg from what the wheels told"
            return result.reject(reason, pose, C + G @ reckoning.covariance @ G.T)
        # Beyond so many sigma one of both is wrong, and nothing tells which.
        P *= max(1.0, excess)
        return result.with_pose(*kalman.fuse_poses(result.T_world_lidar, rest, C, P, result.map_age))

    def correct(
        self, stamp_ns: int, pose: Floats, prior: MotionPrior | None = None, has_registration: bool = True
    ) -> None:
        """Update by the pose (4, 4) at `stamp_ns`; adopt the calibration of `fuse`; `prior` is the motion within the sweep."""
        _, instant_ns = (pose, stamp_ns) if prior is None else middle_of(prior, stamp_ns, pose)
        reckoning, learnt_now = self._reckoned, self._learnt
        if reckoning is not None:
            self.slip_scans += reckoning.is_slip
            self._agreed_ns = self._agreed_ns if reckoning.is_slip else instant_ns
        elif not self.refusal and self._instant_ns is not None and not covers(self._gaps, self._instant_ns, instant_ns):
            self.gap_scans += 1
        if has_registration and learnt_now is not None and learnt_now.instant_ns == instant_ns:
            self.calibration = learnt_now.calibration
            self._acceleration, self._counts = learnt_now.acceleration, learnt_now.counts
            if learnt_now.errors is not None:
                self._judge(*learnt_now.errors)
        self._reckoned = self._learnt = None
        self._was_bridged = not has_registration
        super().correct(stamp_ns, pose, prior, has_registration)

    def _is_contrary(self, reckoning: ReckonedStep, middle: Floats) -> bool:
        """Whether a registration contradicts wheels and constant velocity: these are nearer to each other than the latter to it.

        Never twice in a row, as with an IMU: a registration that repeats itself is right.
        """
        if self._was_bridged or self._step_s <= 0:
            return False
        steady, registered = reckoning.steady, se3.relative(self._pose, middle)
        return bool(apart(steady, reckoning.wheels.pose, LEVER_M) < apart(steady, registered, LEVER_M))

    def _judge(self, own: float, steady: float) -> None:
        """Refuse wheels whose prediction errors (`own`, m) are clearly larger than those of constant velocity (`steady`, m)."""
        worse = self.errors.observe(own, steady)
        if worse is not None and not self.refusal:
            self.refusal = (
                f"they predict scans {worse[0]:.3f} m wrong where constant velocity is {worse[1]:.3f} m wrong (turns counted at "
                f"{LEVER_M:.0f} m): are they this robot's, in m/s and rad/s, on the clock of the scans?"
            )
            log.warning("the wheels are refused from here on: %s", self.refusal)

    def _reckon(self, instant_ns: int) -> ReckonedStep | None:
        """Predicted step from the newest pose to `instant_ns`, of wheels and constant velocity; None in gaps or after refusal."""
        begin_ns = self._instant_ns
        if self.refusal or begin_ns is None or instant_ns <= begin_ns or not covers(self._gaps, begin_ns, instant_ns):
            return None
        up, u, is_known = self.calibration.up, self.calibration.direction, self._step_s > 0
        yaw_rate = float(up @ self._twist[3:]) / self._step_s if is_known else 0.0
        wheels = self.calibration.step(self.wheels, begin_ns, instant_ns, yaw_rate)
        steady = se3.relative(self._pose, self.predict(instant_ns))
        before, by_wheels = se3.log(steady), se3.log(wheels.pose)
        more = np.append(by_wheels[:3] - before[:3], up @ (by_wheels[3:] - before[3:]))
        noise, seconds = self.calibration.step_noise(wheels), wheels.seconds
        gain, is_slip, lost = np.eye(4), False, np.zeros((4, 4))
        if is_known:
            others = np.zeros((4, 4))
            others[:3, :3] = seconds**4 * by_axis(self._acceleration[0], self._acceleration[1], u)
            others[3, 3] = seconds**4 * self._acceleration[2]
            since = seconds if self._agreed_ns is None else max(seconds, 1e-9 * (instant_ns - self._agreed_ns))
            most = (GRAVITY * since * seconds) ** 2 + RARE_SIGMAS**2 * float(u @ noise[:3, :3] @ u)
            change = float(u @ more[:3])
            is_slip = change**2 > most
            noise[:3, :3] += is_slip * change**2 * np.outer(u, u)
            gain[:] = np.linalg.solve(others + noise, others).T
            # The less of the wheels is in the mean, the less it says: constant velocity is no measurement.
            lost = noise @ np.linalg.solve(others, noise)
        part = gain @ more
        twist = before + np.concatenate([part[:3], part[3] * up])
        pose = se3.normalise(self._pose @ se3.exp(twist))
        return ReckonedStep(pose, self.calibration.state_covariance(wheels) + noise + lost, wheels, steady, is_slip)

    def _learn_from(self, reckoning: ReckonedStep, instant_ns: int, middle: Floats, C: Floats) -> LearntFromScan:
        """Calibration and noise updated by the registered pose `middle` (4, 4) with covariance C (6, 6); prediction errors."""
        up, B = self.calibration.up, np.zeros((4, 6))
        B[:3, :3], B[3, 3:] = self._pose[:3, :3].T, self._pose[:3, :3] @ up
        # Both ends of the step were registered.
        both = 2 * (B @ C @ B.T)
        registered = se3.relative(self._pose, middle)

        def rest_of(expected: Floats) -> Floats:
            turn = so3.log(registered[:3, :3] @ expected[:3, :3].T)
            return np.append(registered[:3, 3] - expected[:3, 3], up @ turn)

        rest, off = rest_of(reckoning.wheels.pose), rest_of(reckoning.steady)
        calibration = self.calibration.correct(reckoning.wheels, rest, both)
        acceleration, counts = self._acceleration, self._counts
        if self._step_s > 0:
            per = np.full(3, reckoning.wheels.seconds**4)
            squares, others = squares_along(off, both, self.calibration.direction)
            acceleration, counts = learn_noise(acceleration, counts, squares, others, per, LEAST_ACCELERATION)
        is_open = np.trace(C[:3, :3]) > UNTOLD
        return LearntFromScan(
            instant_ns, calibration, acceleration, counts, None if is_open else (_size(rest), _size(off))
        )


def _unobserved_covariance(result: RegistrationResult) -> Floats:
    """(6, 6) large covariance to add to a registration's, along directions that no surface observes.

    There the registration's own covariance is too small. Translation gets it in all axes: an unobserved direction is known to a
    degree only, and its part in the other axes would bias the scale of the wheels over hundreds of scans.
    """
    ways, turns = result.degenerate[:, :3], result.degenerate[:, 3:] / result.lever_arm
    lacks = np.zeros((6, 6))
    lacks[:3, :3], lacks[3:, 3:] = UNTOLD * np.sum(ways**2) * np.eye(3), UNTOLD * turns.T @ turns
    return lacks


def _size(rest: Floats) -> float:
    """Size, m, of an error (4,): translation (3,), m, and rotation, rad, at a lever arm of `LEVER_M`."""
    return float(np.linalg.norm(rest[:3]) + LEVER_M * abs(rest[3]))


def warm_up() -> None:
    """Compile or load the kernels of wheel motion by three scans."""
    wheels = WheelStream(np.arange(20, dtype=np.int64) * 20_000_000, np.ones(20), np.zeros(20))
    motion = WheelMotion(wheels)
    for k in range(3):
        prior = motion.sweep(100_000_000 * k, Span())
        result = RegistrationResult(prior.pose, covariance=1e-4 * np.eye(6))
        motion.correct(100_000_000 * k, motion.fuse(100_000_000 * k, result, prior).T_world_lidar, prior)


@dataclass
class Wheels:
    """The wheels' part in a run: its motion model, None without wheels."""

    motion: WheelMotion | None = None
    notes: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


def begin_wheels(sequence: Sequence, config: WheelsConfig) -> Wheels:
    """Read the configured wheels and make their motion model. Raises InputError and UsageError as `read_wheels`."""
    if not config.source:
        return Wheels()
    part = Wheels()
    stream = getattr(sequence, "wheels", None)  # of a simulated drive, which has no files
    if stream is None:
        stream = read_wheels(sequence, config.source, config.frame, config.wheelbase_m, part.notes, part.problems)
    part.motion = WheelMotion(stream)
    what = "speed and yaw rate" if stream.yaw_rate is not None else "speed"
    part.notes.append(f"wheels from {config.source}: {what}, {len(stream)} readings")
    for note in part.notes:
        log.info("%s", note)
    for problem in part.problems:
        log.warning("%s", problem)
    return part


def close_wheels(part: Wheels, ignores_prior: bool) -> dict[str, Any]:
    """Facts about the wheels for the manifest, empty without wheels; problems of the run are appended to those of `part`.

    ignores_prior : whether the method predicts by itself
    """
    motion = part.motion
    if motion is None:
        return {}
    if ignores_prior:
        part.problems.append("wheels: the method predicts by itself, they only bridge scans that fail")
    last = motion.calibration
    scale, sigma = last.scale
    if motion.gap_scans:
        part.problems.append(f"wheels: {motion.gap_scans} scans fell into gaps and were predicted by constant velocity")
    if motion.refusal:
        part.problems.append(f"the wheels were refused on the way, the run went on without them: {motion.refusal}")
    facts = {
        "used": not (motion.refusal or ignores_prior),
        "decisions": part.notes,
        "readings": len(motion.wheels),
        "scale": round(scale, 5),
        "scale_sigma": round(sigma, 5),
        "forward_in_lidar": [round(float(v), 5) for v in last.states[U]],
        "time_offset_s": round(float(last.states[OFFSET_S]), 5),
        "scans_in_gaps": motion.gap_scans,
        "scans_with_slip": motion.slip_scans,
        **motion.errors.facts,
    }
    if last.has_yaw:
        facts["yaw_scale"], facts["yaw_offset_rad_s"] = (
            round(float(last.states[k]), 5) for k in (YAW_SCALE, YAW_OFFSET)
        )
    return facts
