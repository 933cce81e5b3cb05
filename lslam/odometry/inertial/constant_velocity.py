"""Constant velocity: the motion prior of a method that has no IMU, and the motion within a sweep.

Where later scans are known, that is the course of the sensor through poses at known instants, before and after.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar, Protocol

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.geometry import se3
from lslam.core.types.imu import GravityDirection, ImuState
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Span
from lslam.core.types.scan_result import MOST_ACCELERATION_M_S2
from lslam.core.types.state import State, Stateful
from lslam.registration.preprocessing.deskew import knots_over
from lslam.registration.result import RegistrationResult

# Poses on each side of those within a sweep. From one to the next its influence on a natural spline falls by 3.7.
NEIGHBOUR_SWEEPS = 3
# Of the motion from begin to end of a sweep.
MOTION_SIGMA_M, MOTION_SIGMA_RAD = 0.003, 0.001


class Course:
    """Natural cubic splines through the poses within and around each sweep.

    instants_ns : (N,); poses : (N, 4, 4). A pose no later than its predecessor, as of a very short sweep, is dropped.
    """

    def __init__(self, instants_ns: Longs, poses: Floats) -> None:
        is_later = np.append(True, instants_ns[1:] > np.maximum.accumulate(instants_ns)[:-1])
        self.instants_ns, self.poses = instants_ns[is_later], poses[is_later]

    def at(self, stamp_ns: int, times: Floats) -> Floats | None:
        """Poses (K, 4, 4) at `times` (K,), s from the stamp, by the spline through the poses in a sweep and three on each side.

        None where no pose lies within the sweep, the course has fewer than three, or K < 2.
        """
        begin, end = stamp_ns + 1e9 * times[0], stamp_ns + 1e9 * times[-1]
        first, last = np.searchsorted(self.instants_ns, begin), np.searchsorted(self.instants_ns, end, side="right")
        if len(times) < 2 or len(self.instants_ns) < NEIGHBOUR_SWEEPS or first == last:
            return None
        k = int(first + np.argmin(np.abs(self.instants_ns[first:last] - (begin + end) / 2)))
        around = slice(max(first - NEIGHBOUR_SWEEPS, 0), last + NEIGHBOUR_SWEEPS)
        nodes = 1e-9 * (self.instants_ns[around] - stamp_ns)
        twists = se3.log(se3.relative(self.poses[k], self.poses[around]))
        return se3.normalise(self.poses[k] @ se3.exp(natural_spline(np.asarray(nodes), twists, times)))


def motion_covariance() -> Floats:
    """(6, 6) of the motion from begin to end of a sweep, m2 and rad2."""
    return np.diag(np.repeat([MOTION_SIGMA_M, MOTION_SIGMA_RAD], 3) ** 2)


def natural_spline(nodes: Floats, values: Floats, times: Floats) -> Floats:
    """(K, C) cubic spline at `times` (K,) through `values` (N, C) at increasing `nodes` (N,), N > 2; beyond them straight."""
    from scipy.interpolate import CubicSpline

    spline, inside = CubicSpline(nodes, values, bc_type="natural"), np.clip(times, nodes[0], nodes[-1])
    return np.asarray(spline(inside) + (times - inside)[:, None] * spline(inside, 1))


# m/s2 and rad/s2, prior sigmas of the acceleration: a car brakes, a hand turns.
USUAL_ACCELERATION = np.repeat([3.0, 1.0], 3)


class MotionModel(Protocol):
    """Predicts the pose of a scan and the motion within it, and is corrected by registration.

    Methods with a body here are defaults for a model without a sensor.
    """

    @property
    def is_known(self) -> bool:
        """Whether there is a velocity yet."""
        ...

    def sweep(self, stamp_ns: int, span: Span) -> MotionPrior:
        """Poses over the `span` of the sweep; the one at the stamp when it takes no time."""
        ...

    def refine(self, prior: MotionPrior, stamp_ns: int, pose: Floats) -> MotionPrior:
        """The sweep's motion, refined by the registered `pose` (4, 4) at the stamp for `prior`."""
        ...

    def correct(
        self, stamp_ns: int, pose: Floats, prior: MotionPrior | None = None, has_registration: bool = True
    ) -> None:
        """Update with the pose (4, 4) found at `stamp_ns`; `prior` is the motion of its sweep.

        has_registration : whether the pose is registered, not predicted
        """
        ...

    def rewind(self, stamp_ns: int, pose: Floats, span: Span) -> MotionPrior:
        """Forget all scans but the first, at `stamp_ns` and `pose` (4, 4); returns the motion within its sweep."""
        ...

    def state(self) -> State:
        """State for a checkpoint."""
        ...

    def restore(self, state: State) -> None:
        """Set all that `state` gave."""
        ...

    @property
    def coasting(self) -> ConstantVelocity | None:
        """Constant velocity, where the model takes its place and is compared with it."""
        return None

    @property
    def is_inertial(self) -> bool:
        """Whether an inertial sensor predicted the newest sweep: a denied or lost scan is searched near there."""
        return False

    def needs_comparison(self, stamp_ns: int, span: Span) -> bool:
        """Whether the scan to come is to be registered from `coasting` as well."""
        return False

    def fuse(self, stamp_ns: int, result: RegistrationResult, prior: MotionPrior) -> RegistrationResult:
        """The registration from `prior` fused with the sensor's prediction. Here the result unchanged: there is no sensor."""
        return result

    def gravity_at(self, pose: Floats) -> GravityDirection | None:
        """Direction of gravity for a LiDAR at `pose` (4, 4) in the world, as of the last scan; None where unknown."""
        return None

    def imu_state(self) -> ImuState | None:
        """State and errors of the sensor at the last scan; None without one."""
        return None


class ConstantVelocity(Stateful, MotionModel):
    """Predicts the next pose from the last two, scaled to the time between scans.

    Registration is most accurate at the middle of a sweep: an error of the deskewing velocity has opposite signs at start and
    end. So velocities are measured from middle to middle.

    A registration error of decimetres is a velocity error of metres per second: the change of velocity is bounded by the
    largest plausible acceleration.

    pose : (4, 4) expected of the first scan, the identity when None
    """

    # Bound of extrapolation, in last steps: the speed after a longer pause is unknown.
    MAX_STRETCH = 5.0
    STATE: ClassVar[tuple[str, ...]] = ("_instant_ns", "_pose", "_twist", "_step_s", "_velocity")
    TRANSIENT: ClassVar[tuple[str, ...]] = ("_predicted",)

    def __init__(self, pose: Floats | None = None) -> None:
        self._instant_ns: int | None = None
        self._pose = np.eye(4) if pose is None else pose
        self._twist = np.zeros(6)
        self._step_s = 0.0
        # Velocity (6,) between the last two poses, m/s and rad/s.
        self._velocity: Floats | None = None
        # The newest prediction and its stamp, ns: several ask for the same one.
        self._predicted: tuple[int, Floats] | None = None
        # Tells the motion of the sweeps that it knows instead.
        self.course: Course | None = None

    def predict(self, stamp_ns: int) -> Floats:
        """(4, 4) T_world_lidar expected at `stamp_ns`; before the first scan, the initial pose."""
        if self._instant_ns is None or self._step_s <= 0:
            return self._pose.copy()
        if self._predicted is None or self._predicted[0] != stamp_ns:
            stretch = min(max((stamp_ns - self._instant_ns) * 1e-9 / self._step_s, 0.0), self.MAX_STRETCH)
            self._predicted = stamp_ns, se3.normalise(self._pose @ se3.exp(stretch * self._twist))
        return self._predicted[1].copy()

    @property
    def is_known(self) -> bool:
        """Whether there is a velocity yet."""
        return self._step_s > 0 or self.course is not None

    def sweep(self, stamp_ns: int, span: Span) -> MotionPrior:
        """Predicted poses over the `span` (s) of the sweep at `stamp_ns`, by the course if it covers it, or constant velocity."""
        knots = knots_over(span)
        poses = None if self.course is None else self.course.at(stamp_ns, knots)
        if poses is None:
            return self.steady(self.predict(stamp_ns), span)
        sweep = MotionPrior(knots, poses, change=motion_covariance())
        if self._instant_ns is None:  # the world begins where the first scan is expected
            sweep = replace(sweep, poses=self._pose @ se3.relative(sweep.pose, poses))
        return sweep

    def steady(self, pose: Floats, span: Span) -> MotionPrior:
        """Motion over the `span` (s) of a sweep by constant velocity, through the `pose` (4, 4) at its stamp."""
        if span.seconds <= 0 or self._step_s <= 0:
            return MotionPrior.at_once(pose)
        return _steady(pose, self._twist / self._step_s, knots_over(span))

    def refine(self, prior: MotionPrior, stamp_ns: int, pose: Floats) -> MotionPrior:
        """The sweep's motion by the velocity that the registered `pose` (4, 4) at the stamp implies; `prior` was used for it.

        Extrapolating the change of velocity as well was tried: it amplifies jitter more than it follows bends.
        """
        if prior.change is not None:
            return prior
        middle, instant_ns = middle_of(prior, stamp_ns, pose)
        step = 0.0 if self._instant_ns is None else (instant_ns - self._instant_ns) * 1e-9
        if len(prior.times) < 2 or step <= 0:
            return prior
        velocity = se3.log(se3.relative(self._pose, middle)) / step
        return _steady(middle @ se3.exp(-prior.times[len(prior.times) // 2] * velocity), velocity, prior.times)

    def correct(
        self, stamp_ns: int, pose: Floats, prior: MotionPrior | None = None, has_registration: bool = True
    ) -> None:
        """Update position and velocity by the pose (4, 4) at `stamp_ns`; `prior` is the motion within its sweep.

        A pose without a registration (`has_registration`) is used likewise.
        """
        middle, instant_ns = (pose, stamp_ns) if prior is None else middle_of(prior, stamp_ns, pose)
        if self._instant_ns is not None:
            step = (instant_ns - self._instant_ns) * 1e-9
            if step > 0:
                self._learn(se3.log(se3.relative(self._pose, middle)) / step, step)
        self._instant_ns, self._pose = instant_ns, middle.copy()
        self._predicted = None

    def _learn(self, velocity: Floats, step: float) -> None:
        """Update the velocity by one (6,) measured over `step` seconds, with bounded acceleration."""
        before, self._velocity = self._velocity, velocity
        if before is not None and self._step_s > 0:
            expected = self._twist / self._step_s
            change, again = velocity[:3] - expected[:3], velocity[:3] - before[:3]
            # Unless the next step confirms it.
            most = MOST_ACCELERATION_M_S2 * (step + self._step_s) / 2
            size = float(np.linalg.norm(change))
            if size > most and np.linalg.norm(again) > most:
                velocity = np.concatenate([expected[:3] + change * most / size, velocity[3:]])
        self._twist, self._step_s = velocity * step, step

    def rewind(self, stamp_ns: int, pose: Floats, span: Span) -> MotionPrior:
        """Forget all scans but the first, at `stamp_ns` and `pose` (4, 4); returns the motion within its sweep.

        It keeps the present velocity.
        """
        prior = self.steady(pose, span)
        self._instant_ns, self._step_s, self._velocity = None, 0.0, None
        self.correct(stamp_ns, pose, prior)
        return prior


def _steady(pose: Floats, velocity: Floats, times: Floats) -> MotionPrior:
    """Poses at `times` (K,), s from the stamp, of a sensor at `pose` (4, 4) with a constant `velocity` (6,) in its own axes."""
    return MotionPrior(times, se3.normalise(pose @ se3.exp(times[:, None] * velocity)))


def middle_of(prior: MotionPrior, stamp_ns: int, pose: Floats) -> tuple[Floats, int]:
    """Pose and instant of the middle of a sweep that had the `pose` at the stamp and moved as `prior` says."""
    k = len(prior.times) // 2
    within = se3.relative(prior.pose, prior.poses[k])
    return np.asarray(pose @ within), stamp_ns + round(1e9 * float(prior.times[k]))
