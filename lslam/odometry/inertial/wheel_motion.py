"""Wheels as a motion model: they predict the way and the turn, constant velocity the rest, and registration corrects both."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from lslam.core.geometry import se3, so3
from lslam.core.types.arrays import Floats
from lslam.core.types.imu import GRAVITY
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import LEVER_M, Span
from lslam.core.types.state import State
from lslam.core.types.wheels import WheelStream
from lslam.odometry.inertial.constant_velocity import ConstantVelocity, middle_of
from lslam.odometry.inertial.gyroscope import INNOVATION_SIGMAS
from lslam.odometry.inertial.imu_cleaning import covers, gaps
from lslam.odometry.inertial.wheel_calibration import WheelCalibration, WheelSteps, learnt
from lslam.odometry.kernels import kalman
from lslam.odometry.uncertainty import USUAL
from lslam.registration.result import RegistrationResult

# (m/s2)2 along and across, (rad/s2)2: least of what constant velocity does not follow.
LEAST_ACCELERATION = np.array([0.1, 0.1, 0.03]) ** 2
# m2 and rad2, of the directions of which wheels say nothing.
UNTOLD = 1e2


class WheelMotion(ConstantVelocity):
    """Constant velocity whose way and turn are those of the wheels, as far as these predict scans better.

    Both predictions are averaged by their mean squared innovations, which are learnt while driving: wheels of another robot have
    no weight. A registered motion is weighed against the wheels by the covariances of both. Tyres hold no more than gravity: a
    speed of the wheels that changes faster is slip, and constant velocity goes on.

    gap_s : time between readings beyond which there are none
    """

    STATE: ClassVar[tuple[str, ...]] = (
        *ConstantVelocity.STATE,
        "calibration",
        "slip_scans",
        "gap_scans",
        "_acceleration",
        "_acceleration_counts",
        "_agreed_ns",
    )
    CLEARED: ClassVar[tuple[str, ...]] = (*ConstantVelocity.CLEARED, "_taught")

    def __init__(self, wheels: WheelStream, gap_s: float, pose: Floats | None = None) -> None:
        super().__init__(pose)
        self.wheels, self.gap_s = wheels, gap_s
        self.calibration = WheelCalibration.of(wheels)
        self.slip_scans = self.gap_scans = 0
        self._gaps = gaps(wheels, gap_s)
        # Of constant velocity: variances along and across, (m/s2)2, and of the turn, (rad/s2)2, and counts behind them.
        self._acceleration = np.square([USUAL[0], USUAL[0], USUAL[3]])
        self._acceleration_counts = np.ones(3)
        # When wheels last changed their speed by no more than tyres hold, ns.
        self._agreed_ns: int | None = None
        # Whether wheels slip on the step to come; and from `fuse` at an instant, ns, what `correct` takes over.
        self._is_slipping = False
        self._taught: tuple[int, WheelCalibration, Floats, Floats, tuple[float, float]] | None = None
        self._errors: list[tuple[float, float]] = []

    def fresh(self, pose: Floats) -> WheelMotion:
        """One that has learnt as much, and expects the first scan at `pose` (4, 4)."""
        other = WheelMotion(self.wheels, self.gap_s, pose)
        other.calibration, other.slip_scans, other.gap_scans = self.calibration, self.slip_scans, self.gap_scans
        other._acceleration, other._acceleration_counts = self._acceleration, self._acceleration_counts
        other._errors = list(self._errors)
        return other

    def sweep(self, stamp_ns: int, span: Span) -> MotionPrior:
        """Poses over the `span` of the sweep; the one at the stamp when it takes no time."""
        prior = super().sweep(stamp_ns, span)
        if prior.change is not None or self._instant_ns is None:
            return prior
        blend = self._blend(prior.poses, stamp_ns, prior.times, self._instant_ns, self._pose)
        return prior if blend is None else MotionPrior(prior.times, blend.poses)

    def refine(self, prior: MotionPrior, stamp_ns: int, pose: Floats) -> MotionPrior:
        """The sweep's motion again, now that registration gave the `pose` (4, 4) at the stamp for `prior`."""
        refined = super().refine(prior, stamp_ns, pose)
        if refined is prior:
            return prior
        middle, instant_ns = middle_of(prior, stamp_ns, pose)
        blend = self._blend(refined.poses, stamp_ns, refined.times, instant_ns, middle)
        return refined if blend is None else MotionPrior(refined.times, blend.poses)

    def fuse(self, stamp_ns: int, result: RegistrationResult, prior: MotionPrior) -> RegistrationResult:
        """The registered motion since the last scan weighed against the wheels', each by its covariance.

        prior : of the registration, says how the sweep moved
        """
        C = result.covariance
        middle, instant_ns = middle_of(prior, stamp_ns, result.T_world_lidar)
        if C is None or not result.is_accepted or self._instant_ns is None or instant_ns <= self._instant_ns:
            return result
        blend = self._blend(self.predict(instant_ns)[None], instant_ns, np.zeros(1), self._instant_ns, self._pose)
        if blend is None:
            return result
        C = C + _open(result)
        self._learn_from(blend, instant_ns, middle, C)
        R, up = self._pose[:3, :3], self.calibration.up
        G = np.zeros((6, 4))
        G[:3, :3], G[3:, 3] = R, R @ up
        P = G @ blend.covariance @ G.T
        P[3:, 3:] += UNTOLD * (np.eye(3) - np.outer(R @ up, R @ up))
        expected = blend.poses[0]
        turn = so3.log(middle[:3, :3] @ expected[:3, :3].T)
        rest = np.concatenate([middle[:3, 3] - expected[:3, 3], turn])
        # Beyond so many sigma one of both is wrong: the registration was accepted.
        P *= max(1.0, kalman.square(rest, P + 2 * C) / INNOVATION_SIGMAS**2)
        return result.moved(*kalman.weighed(result.T_world_lidar, rest, C, P, result.map_age))

    def correct(
        self, stamp_ns: int, pose: Floats, prior: MotionPrior | None = None, is_registered: bool = True
    ) -> None:
        """Take the pose (4, 4) found at `stamp_ns` as the newest; `prior` says how its sweep moved."""
        _, instant_ns = (pose, stamp_ns) if prior is None else middle_of(prior, stamp_ns, pose)
        if self._instant_ns is not None and instant_ns > self._instant_ns:
            is_covered = covers(self._gaps, self._instant_ns, instant_ns)
            self.gap_scans += not is_covered
            self.slip_scans += self._is_slipping
            if not self._is_slipping and is_covered:
                self._agreed_ns = instant_ns
        if self._taught is not None and self._taught[0] == instant_ns:
            _, self.calibration, self._acceleration, self._acceleration_counts, errors = self._taught
            self._errors.append(errors)
        self._taught, self._is_slipping = None, False
        super().correct(stamp_ns, pose, prior, is_registered)

    def prior_errors(self) -> tuple[float, float] | None:
        """Medians, m, of how wrong wheels and constant velocity predicted the scans, turns counted at `LEVER_M`."""
        if not self._errors:
            return None
        own, steady = np.median(np.array(self._errors), axis=0)
        return float(own), float(steady)

    def state(self) -> State:
        """What `restore` needs to go on from here; not the stream."""
        return {**super().state(), "errors": np.array(self._errors).reshape(-1, 2)}

    def restore(self, state: State) -> None:
        """Go on where `state` was taken."""
        super().restore(state)
        self._errors = [(float(own), float(steady)) for own, steady in state["errors"]]
        self._is_slipping = False

    def _blend(
        self, steady: Floats, stamp_ns: int, times: Floats, anchor_ns: int, anchor: Floats
    ) -> _Blend | None:
        """Both predictions averaged at `times` (K,), s from the stamp; None where wheels say nothing.

        steady : (K, 4, 4) of constant velocity; anchor : (4, 4) pose from which both go on
        """
        instants = stamp_ns + np.round(1e9 * times).astype(np.int64)
        k = len(times) // 2 if anchor_ns < instants.min() else len(times) - 1
        if not covers(self._gaps, min(anchor_ns, int(instants.min())), max(anchor_ns, int(instants.max()))):
            return None
        up, is_known = self.calibration.up, self._step_s > 0
        yaw_rate = float(up @ self._twist[3:]) / self._step_s if is_known else 0.0
        steps = self.calibration.steps(self.wheels, anchor_ns, instants, yaw_rate)
        c, m = se3.log(se3.relative(anchor, steady)), se3.log(steps.poses)
        apart4 = np.column_stack([m[:, :3] - c[:, :3], (m[:, 3:] - c[:, 3:]) @ up])
        own, gain = self.calibration.step_noise(steps, k), np.eye(4)
        cost = self.calibration.spread(steps, k) + own
        if is_known:
            seconds = float(steps.seconds[k])
            u = self.calibration.direction
            along, across, turning = self._acceleration * seconds**4
            others = np.zeros((4, 4))
            others[:3, :3] = across * np.eye(3) + (along - across) * np.outer(u, u)
            others[3, 3] = turning
            change = float(u @ apart4[k, :3])
            since = seconds
            if anchor_ns == self._instant_ns and self._agreed_ns is not None:
                since = max(since, 1e-9 * (int(instants[k]) - self._agreed_ns))
            most = (GRAVITY * since * seconds) ** 2 + INNOVATION_SIGMAS**2 * float(u @ own[:3, :3] @ u)
            if anchor_ns == self._instant_ns:
                self._is_slipping = change**2 > most
            if change**2 > most:
                own = own.copy()
                own[:3, :3] += change**2 * np.outer(u, u)
            gain = np.linalg.solve(others + own, others).T
            # The less of the wheels is in the mean, the less it says: constant velocity is no measurement.
            cost = self.calibration.spread(steps, k) + own + own @ np.linalg.solve(others, own)
        twist = c + np.hstack([apart4 @ gain[:3].T, (apart4 @ gain[3])[:, None] * up])
        return _Blend(se3.normalise(anchor @ se3.exp(twist)), cost, steps, steady)

    def _learn_from(self, blend: _Blend, instant_ns: int, middle: Floats, C: Floats) -> None:
        """Calibrate the wheels and their noise, and that of constant velocity, by the registered `middle` (4, 4)."""
        R, up, u = self._pose[:3, :3], self.calibration.up, self.calibration.direction
        B = np.zeros((4, 6))
        B[:3, :3], B[3, 3:] = R.T, R @ up
        # Both ends of the step were registered.
        both = 2 * (B @ C @ B.T)
        registered = se3.relative(self._pose, middle)

        def rest_of(expected: Floats) -> Floats:
            turn = so3.log(registered[:3, :3] @ expected[:3, :3].T)
            return np.append(registered[:3, 3] - expected[:3, 3], up @ turn)

        rest = rest_of(blend.steps.poses[0])
        calibration = self.calibration.corrected(blend.steps, 0, rest, both)
        acceleration, counts = self._acceleration, self._acceleration_counts
        steady = se3.relative(self._pose, blend.steady[0])
        errors = (_size(rest), _size(rest_of(steady)))
        if self._step_s > 0:
            off = rest_of(steady)
            along = float(u @ off[:3]) ** 2
            known_along = float(u @ both[:3, :3] @ u)
            squares = np.array([along, (float(off[:3] @ off[:3]) - along) / 2, off[3] ** 2])
            known = np.array([known_along, (np.trace(both[:3, :3]) - known_along) / 2, both[3, 3]])
            per = np.full(3, float(blend.steps.seconds[0]) ** 4)
            acceleration, counts = learnt(acceleration, counts, squares, known, per, LEAST_ACCELERATION)
        self._taught = instant_ns, calibration, acceleration, counts, errors


@dataclass(frozen=True)
class _Blend:
    """Poses (K, 4, 4) in the world; `covariance` (4, 4) of the wheels' part in them at the reference, in axes of the anchor."""

    poses: Floats
    covariance: Floats
    steps: WheelSteps
    steady: Floats


def _open(result: RegistrationResult) -> Floats:
    """(6, 6) that a registration's covariance lacks: of directions that no surface holds it says a metre, and knows nothing."""
    scaled = result.degenerate / np.repeat([1.0, result.lever_arm], 3)
    return np.asarray(UNTOLD * scaled.T @ scaled)


def _size(rest: Floats) -> float:
    return float(np.linalg.norm(rest[:3]) + LEVER_M * abs(rest[3]))
