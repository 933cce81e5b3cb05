"""The error state of a tightly coupled filter: pose, velocity, gravity and errors of the IMU, with one covariance.

After Xu et al. 2022 (FAST-LIO2), but propagated by preintegrated increments, one step a scan, and with the axes of a
consumer gyroscope among the states.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from lslam.core.geometry import se3, so3
from lslam.core.types.arrays import Floats
from lslam.core.types.imu import GRAVITY
from lslam.odometry.inertial.gyroscope import INNOVATION_SIGMAS, MOUNTING, OFFSET_WALK, USUAL_NOISE, Gyroscope, ImuNoise
from lslam.odometry.inertial.imu_estimate import GRAVITY_SIGMA_M_S2, GRAVITY_WALK, ImuEstimate
from lslam.odometry.inertial.integrate import Increments
from lslam.odometry.kernels import kalman

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
    """(N, N) by which errors at the first instant of `step` become errors at its last; N is 27, with the clocks' offset 28.

    R, R_end : (3, 3) of the IMU in the world at the two; gyroscope : that `step` was integrated with
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
    """(27, 27) that `t` seconds add; rate_variance : (rad/s)^2 per Hz of the gyroscope."""
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
    """(N, N) that readings which the range cut off add over a step with the transition F (N, N).

    hidden : (6,) one sigma of the mean force and rate; white noise over the step that adds as much velocity and turn

    A constant error of each step, another in the next, would put a pole of the filter at -1: where one position is found
    wrong, it would take twice the speed that makes up for it, back and forth ever after. With white noise it is at sqrt(3) - 2.
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
class NavigationState:
    """Where the IMU is, and all that is known of its motion and its errors.

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

    def propagated(self, step: Increments) -> NavigationState:
        """The state at the last instant of `step`, which this estimate integrated, with nothing but the IMU to go by."""
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
        return NavigationState(T, replace(e, velocity=velocities[-1]), P)._shared()

    def moved_to(self, T_world_imu: Floats, covariance: Floats) -> NavigationState:
        """After the pose was found to be another (4, 4), with its `covariance` (6, 6), by what knows nothing of the rest."""
        P = self.covariance
        gain = np.linalg.solve(P[POSE, POSE], P[POSE]).T
        d = np.concatenate(
            [T_world_imu[:3, 3] - self.T_world_imu[:3, 3], so3.log(T_world_imu[:3, :3] @ self.T_world_imu[:3, :3].T)]
        )
        P = P - gain @ (P[POSE, POSE] - covariance) @ gain.T
        state = self._shifted(gain @ d, 0.5 * (P + P.T))._with_gravity()
        return replace(state, T_world_imu=T_world_imu)._shared()

    def _shifted(self, x: Floats, P: Floats) -> NavigationState:
        """All states but the pose, moved by the error x (N,), with the covariance P."""
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
        """Gravity is as long as it is all over the Earth; what that says of the pose is far below what registration does."""
        norm = float(np.linalg.norm(self.estimate.gravity))
        size = len(self.covariance)
        H = np.zeros((1, size))
        H[0, DOWN] = self.estimate.gravity / norm
        rest, noise = np.array([GRAVITY - norm]), np.array([[GRAVITY_SIGMA_M_S2**2]])
        x, P = kalman.update(np.zeros(size), self.covariance, H, rest, noise, INNOVATION_SIGMAS)
        return self._shifted(x, P)

    def _shared(self) -> NavigationState:
        """The parts of the covariance where the estimate has them too."""
        P, e = self.covariance, self.estimate
        gyroscope: Gyroscope = replace(e.gyroscope, covariance=P[DEVICE, DEVICE])
        return replace(self, estimate=replace(e, covariance=P[REST, REST], gyroscope=gyroscope))
