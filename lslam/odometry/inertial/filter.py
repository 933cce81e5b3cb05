"""The iterated error-state Kalman filter of FAST-LIO2 as a motion model: its prior joins the points in one estimate.

Its error state is pose, velocity, gravity and errors of the IMU, with one covariance. After Xu et al. 2022, but propagated by
preintegrated increments, one step a scan, and with the axes of a consumer gyroscope among the states.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from lslam.core.arrays import Bools, Floats
from lslam.core.geometry import noise, se3, so3
from lslam.core.kernels import linalg
from lslam.core.kernels.linearisation import RARE_SIGMAS
from lslam.core.types.imu import GRAVITY
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Span
from lslam.odometry.inertial.constant_velocity import middle_of
from lslam.odometry.inertial.fusion import InertialMotion
from lslam.odometry.inertial.gyroscope import MOUNTING, OFFSET_WALK, USUAL_NOISE, Gyroscope, ImuNoise
from lslam.odometry.inertial.imu_estimate import GRAVITY_SIGMA_M_S2, GRAVITY_WALK, PLACE_SIGMA, TURN_SIGMA, ImuEstimate
from lslam.odometry.inertial.integrate import Increments
from lslam.odometry.kernels import kalman
from lslam.registration.result import RegistrationResult

PLACE, TURN, SPEED, DOWN, FORCE = (slice(3 * k, 3 * k + 3) for k in range(5))
POSE, REST, GYRO = slice(0, 6), slice(6, 15), slice(15, 27)
AXES = slice(18, 27)
# The gyroscope and, where it is a state, the offset of the clocks.
DEVICE = slice(15, None)
# What every scan of a window has of its own: position, rotation, velocity and both biases.
OWN = np.r_[0:9, 12:18]
# Without the offset of the clocks, which stands last.
STATE_SIZE = 27
# Of the pose at the beginning, where the world is put: m and rad, one sigma.
BEGIN_SIGMA = 1e-4


def transition(step: Increments, R: Floats, R_end: Floats, gyroscope: Gyroscope) -> Floats:
    """(N, N) Jacobian of the errors at the last instant of `step` by those at the first; N is 27, or 28 with a clock offset.

    R, R_end : (3, 3) of the IMU in the world at the two; gyroscope : the calibration that `step` was integrated with
    """
    t = float(step.seconds[-1])
    columns = gyroscope.columns(step)
    F = np.eye(DEVICE.start + columns.shape[1])
    F[PLACE, TURN] = -so3.hat(R @ step.positions[-1])
    F[PLACE, SPEED], F[PLACE, DOWN] = t * np.eye(3), 0.5 * t**2 * np.eye(3)
    arms = step.position_arms[-1], step.velocity_arms[-1]
    mounting = gyroscope.mounting
    if mounting is not None:
        # Turned further by d, the device feels d x f more of a force f.
        force = so3.hat(np.linalg.solve(step.velocity_arms[-1], step.velocities[-1]))
        F[PLACE, AXES], F[SPEED, AXES] = (-R @ arm @ force @ MOUNTING for arm in arms)
        arms = arms[0] @ mounting, arms[1] @ mounting
    F[PLACE, FORCE] = -R @ arms[0]
    F[TURN, DEVICE] = R_end @ columns
    F[SPEED, TURN] = -so3.hat(R @ step.velocities[-1])
    F[SPEED, DOWN], F[SPEED, FORCE] = t * np.eye(3), -R @ arms[1]
    return F


def process_noise(t: float, rate_variance: float, noise: ImuNoise = USUAL_NOISE) -> Floats:
    """(27, 27) covariance of the process noise over `t` seconds; rate_variance : (rad/s)^2 per Hz of the gyroscope."""
    Q = np.zeros((STATE_SIZE, STATE_SIZE))
    force = noise.force**2 * np.array([[t**3 / 3, t**2 / 2], [t**2 / 2, t]])
    for i, a in enumerate((PLACE, SPEED)):
        for j, b in enumerate((PLACE, SPEED)):
            Q[a, b] = force[i, j] * np.eye(3)
    walks = (rate_variance, GRAVITY_WALK**2, noise.accel_walk**2, noise.gyro_walk**2)
    for part, variance in zip((TURN, DOWN, FORCE, slice(15, 18)), walks, strict=True):
        Q[part, part] = variance * t * np.eye(3)
    return Q


def cut_noise(hidden: Floats, F: Floats) -> Floats:
    """(N, N) covariance added by readings beyond the IMU's range, over a step with the transition F (N, N).

    hidden : (6,) one sigma of the mean force and rate; white noise over the step that adds as much velocity and rotation

    An error constant within each step and independent of the next step's would put a pole of the filter at -1: a wrong position
    would be compensated by twice the speed, back and forth without end. White noise puts it at sqrt(3) - 2.
    """
    turned, errors = F[TURN, GYRO][:, :3] * hidden[3:], np.zeros((len(F), 15))
    moved, pushed = F[PLACE, FORCE] * hidden[:3], F[SPEED, FORCE] * hidden[:3]
    errors[SPEED, :3], errors[PLACE, :3], errors[PLACE, 3:6] = pushed, moved, moved / np.sqrt(3)
    # The integral of a random walk, and the integral of that: with its end, with each other, and alone.
    swayed, led = F[SPEED, TURN] @ turned, F[PLACE, TURN] @ turned
    errors[TURN, 6:9] = turned
    errors[SPEED, 6:9], errors[SPEED, 9:12] = swayed / 2, swayed / np.sqrt(12)
    errors[PLACE, 6:9], errors[PLACE, 9:12], errors[PLACE, 12:] = led / 3, led / np.sqrt(12), led / np.sqrt(180)
    return np.asarray(errors @ errors.T)


@dataclass(frozen=True)
class Normal:
    """H (N, N) and gradient g (N,) at some values; the cost decreases along -H^-1 g."""

    H: Floats
    g: Floats

    def step(self) -> Floats:
        """(N,) the update to the minimum; NaN where H is not positive definite."""
        return -linalg.solve(self.H, self.g)

    def without(self, out: Bools) -> Normal:
        """Marginalise the variables marked in `out` (N,) by the Schur complement."""
        if not out.any():
            return self
        kept = ~out
        # The gradient rides along as one more column.
        across = np.column_stack([self.H[np.ix_(out, kept)], self.g[out]])
        n = len(across[0])
        rest = np.zeros((n, n))
        rest[:-1, :-1], rest[:-1, -1], rest[-1, :-1] = self.H[np.ix_(kept, kept)], self.g[kept], self.g[kept]
        left = linalg.complement(self.H[np.ix_(out, out)], across, rest)
        return Normal(0.5 * (left[:-1, :-1] + left[:-1, :-1].T), left[:-1, -1].copy())


def warm_up_solver() -> None:
    """Compile or load what an estimate over a window is solved, marginalised and given a covariance with."""
    normal = Normal(np.eye(2), np.zeros(2))
    normal.step()
    normal.without(np.array([True, False]))
    linalg.inverse(normal.H)


@dataclass(frozen=True)
class NavigationState:
    """State of the filter: pose, velocity, gravity and calibration of the IMU, with their covariance.

    T_world_imu : (4, 4); estimate : velocity, gravity, accelerometer bias and gyroscope, whose covariances are parts of
    covariance : (27, 27) of position, rotation (R' = exp(d) R), velocity, gravity, all in world axes, accelerometer bias,
        gyroscope bias and axes; (28, 28) where the offset of the clocks is a state
    """

    T_world_imu: Floats
    estimate: ImuEstimate
    covariance: Floats = field(repr=False)

    @classmethod
    def begin(cls, T_world_imu: Floats, estimate: ImuEstimate) -> NavigationState:
        """The state of an IMU that was initialised at a pose (4, 4) which is the world's."""
        size = DEVICE.start + len(estimate.gyroscope.covariance)
        P = np.zeros((size, size))
        P[POSE, POSE] = BEGIN_SIGMA**2 * np.eye(6)
        P[REST, REST], P[DEVICE, DEVICE] = estimate.covariance, estimate.gyroscope.covariance
        return cls(T_world_imu, estimate, P)

    def propagate(self, step: Increments) -> NavigationState:
        """The state at the last instant of `step`, which this estimate integrated, predicted by the IMU alone."""
        e, R, t = self.estimate, self.T_world_imu[:3, :3], float(step.seconds[-1])
        R_end, velocities, moved = step.motion(0, R, e.velocity, e.gravity)
        F = transition(step, R, R_end[-1], e.gyroscope)
        P = F @ self.covariance @ F.T
        P[:STATE_SIZE, :STATE_SIZE] += process_noise(t, e.gyroscope.rate_variance, e.gyroscope.noise)
        if e.gyroscope.has_offset:
            P[-1, -1] += OFFSET_WALK**2 * t
        if step.hidden is not None:
            P += cut_noise(step.hidden, F)
        T = se3.normalise(se3.make(R_end[-1], self.T_world_imu[:3, 3] + moved[-1]))
        return NavigationState(T, replace(e, velocity=velocities[-1]), P)._share_covariance()

    def moved_to(self, T_world_imu: Floats, covariance: Floats) -> NavigationState:
        """The state after its pose became `T_world_imu` (4, 4) with `covariance` (6, 6); the rest follows by its correlation."""
        P = self.covariance
        gain = np.linalg.solve(P[POSE, POSE], P[POSE]).T
        d = noise.changes(self.T_world_imu, T_world_imu)
        P = P - gain @ (P[POSE, POSE] - covariance) @ gain.T
        state = self._shift(gain @ d, 0.5 * (P + P.T))._with_gravity()
        return replace(state, T_world_imu=T_world_imu)._share_covariance()

    def _shift(self, x: Floats, P: Floats) -> NavigationState:
        """The state with covariance P (N, N) after the error x (N,) was added to all parts but the pose."""
        e, gyro = self.estimate, x[DEVICE]
        gyroscope = replace(
            e.gyroscope,
            bias=e.gyroscope.bias + gyro[:3],
            axes=e.gyroscope.axes + gyro[3:12].reshape(3, 3),
            offset_s=e.gyroscope.offset_s + (float(gyro[12]) if e.gyroscope.has_offset else 0.0),
        )
        e = replace(
            e,
            velocity=e.velocity + x[SPEED],
            gravity=e.gravity + x[DOWN],
            accel_bias=e.accel_bias + x[FORCE],
            gyroscope=gyroscope,
        )
        return replace(self, estimate=e, covariance=P)

    def _with_gravity(self) -> NavigationState:
        """The state after an update by the known magnitude of gravity; its effect on the pose is negligible and omitted."""
        norm = float(np.linalg.norm(self.estimate.gravity))
        size = len(self.covariance)
        H = np.zeros((1, size))
        H[0, DOWN] = self.estimate.gravity / norm
        rest, noise = np.array([GRAVITY - norm]), np.array([[GRAVITY_SIGMA_M_S2**2]])
        x, P = kalman.update(np.zeros(size), self.covariance, H, rest, noise, RARE_SIGMAS)
        return self._shift(x, P)

    def _share_covariance(self) -> NavigationState:
        """The state whose `estimate` has the blocks of the covariance that concern it."""
        P, e = self.covariance, self.estimate
        gyroscope: Gyroscope = replace(e.gyroscope, covariance=P[DEVICE, DEVICE])
        return replace(self, estimate=replace(e, covariance=P[REST, REST], gyroscope=gyroscope))


class FilterMotion(InertialMotion):
    """Predicts a scan with its covariance, and updates all states by the registered pose.

    An iterated update of a Kalman filter is a Gauss-Newton estimate with the prior as one more measurement (Bell and Cathey
    1993). The points observe the pose alone, so registration estimates that, and the other states follow by their
    covariance with it.
    """

    STATE: ClassVar[tuple[str, ...]] = (*InertialMotion.STATE, "_now")

    # At the middle of the newest sweep, `_instant_ns`; and at that of the next one, before and after its registration.
    _now: NavigationState | None = None
    _next: tuple[int, NavigationState] | None = None
    _posterior: tuple[int, NavigationState] | None = None

    def sweep(self, stamp_ns: int, span: Span) -> MotionPrior:
        """Predicted poses over the `span` of the sweep as by `InertialMotion`, with the covariance of the pose at the stamp."""
        prior = super().sweep(stamp_ns, span)
        self._next = self._posterior = None
        if not self.is_inertial or self._now is None or self._instant_ns is None:
            return prior
        middle, instant_ns = middle_of(prior, stamp_ns, prior.pose)
        if instant_ns <= self._instant_ns:
            return prior
        state = self._now.propagate(self._since_last(instant_ns))
        self._next = instant_ns, state
        back = prior.pose[:3, 3] - middle[:3, 3]
        return replace(prior, covariance=noise.transport(self._of_lidar(state), back))

    def refine(self, prior: MotionPrior, stamp_ns: int, pose: Floats) -> MotionPrior:
        """The prior itself: a sweep is deskewed once, by back propagation.

        Where readings exceed the range of the IMU, the states that the registered `pose` implies deskew it again, since the speed
        in the sweep lacks the force that was cut off. The covariance of the prior remains.
        """
        if prior.covariance is None or self._next is None:
            return super().refine(prior, stamp_ns, pose)
        instant_ns, state = self._next
        hidden = self._since_last(instant_ns).hidden
        if hidden is None:
            return prior
        middle, _ = middle_of(prior, stamp_ns, pose)
        T_world_imu = middle @ self.T_lidar_imu
        registration_noise = np.diag(np.repeat([PLACE_SIGMA**2, TURN_SIGMA**2], 3))
        estimate = state.moved_to(T_world_imu, registration_noise).estimate
        swept = self._prior(estimate, instant_ns, middle, stamp_ns, prior.times)
        return replace(swept, covariance=prior.covariance)

    def fuse(self, stamp_ns: int, result: RegistrationResult, prior: MotionPrior) -> RegistrationResult:
        """Return the result unchanged: it was registered with points and prior. All other states are updated by its pose."""
        C = result.covariance
        if C is None or not result.is_accepted or prior.covariance is None or self._next is None:
            return result
        instant_ns, state = self._next
        middle, _ = middle_of(prior, stamp_ns, result.T_world_lidar)
        T_world_imu = middle @ self.T_lidar_imu
        covariance = noise.transport(C, T_world_imu[:3, 3] - result.T_world_lidar[:3, 3])
        self._posterior = instant_ns, state.moved_to(T_world_imu, covariance)
        return result

    def correct(
        self, stamp_ns: int, pose: Floats, prior: MotionPrior | None = None, has_registration: bool = True
    ) -> None:
        """Update as `InertialMotion.correct`, with the states of the filter.

        They are those that `fuse` updated, those predicted for a scan without registration, or new ones after a gap.
        """
        predicted, posterior = self._next, self._posterior
        self._next = self._posterior = None
        before = self.estimate
        super().correct(stamp_ns, pose, prior, has_registration)
        if self._instant_ns is None or self._has_gap:
            self._now = None
            return
        if has_registration and posterior is not None and posterior[0] == self._instant_ns:
            self._now = posterior[1]
        elif predicted is not None and predicted[0] == self._instant_ns and not has_registration:
            self._now = predicted[1]
        else:
            # The first scan, the first behind a gap, or one that stood: at its pose, by what the loose estimate knows.
            self._now = NavigationState.begin(self._pose @ self.T_lidar_imu, self.estimate)
            return
        self.estimate = self._now.estimate if not self.refusal else before

    def _of_lidar(self, state: NavigationState) -> Floats:
        """(6, 6) covariance of the LiDAR's pose, world axes, from that of the IMU's pose."""
        lever = (state.T_world_imu @ self.T_imu_lidar)[:3, 3] - state.T_world_imu[:3, 3]
        return noise.transport(state.covariance[POSE, POSE], lever)
