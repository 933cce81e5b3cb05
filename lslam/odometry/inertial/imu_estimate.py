"""What is known of an IMU besides the poses: velocity, gravity and biases, as Gaussians that every registered scan narrows.

Rotation and translation are two small linear filters: registration gives rotations far better than tilt from accelerations,
so the rotations along the way are taken as known when forces are integrated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.kernels.linearisation import OUTLIER_SIGMAS, RARE_SIGMAS
from lslam.core.types.imu import GRAVITY, ImuState, ImuStream
from lslam.core.types.scan import LEVER_M
from lslam.core.types.state import State, Stateful
from lslam.odometry.inertial.gyroscope import Gyroscope
from lslam.odometry.inertial.integrate import Increments, integrate
from lslam.odometry.kernels import kalman
from lslam.odometry.kernels.rotation import vector_between

# Registration from scan to scan, at the least: m, and of turns what that is at `LEVER_M`, one sigma.
PLACE_SIGMA = 0.007
TURN_SIGMA = PLACE_SIGMA / LEVER_M
# Random walk of gravity in the world of a registration that drifts, m/s2 per sqrt(s).
GRAVITY_WALK = 5e-3
GRAVITY_SIGMA_M_S2 = 0.03  # m/s2, over the Earth
# Times that one account of the motion may miss the registered one by more than its alternative before it is refused.
WORSE_RATIO = 2.0


class PredictionErrors(Stateful):
    """Prediction errors, m, of a sensor and of constant velocity over the newest scans, rotations multiplied by `LEVER_M`."""

    # Scans over which the sensor's median error is tested against constant velocity.
    MEDIAN_SCANS = 30

    def __init__(self) -> None:
        self._pairs: list[tuple[float, float]] = []

    def observe(self, own: float, steady: float) -> tuple[float, float] | None:
        """Add the errors of a scan; returns both medians over the newest scans if the sensor is clearly worse, else None.

        own, steady : m, of its prediction and of that by constant velocity
        """
        self._pairs.append((own, steady))
        if len(self._pairs) < self.MEDIAN_SCANS:
            return None
        newest = np.sort(np.array(self._pairs[-self.MEDIAN_SCANS :]), axis=0)
        own, steady = (float(v) for v in 0.5 * (newest[(self.MEDIAN_SCANS - 1) // 2] + newest[self.MEDIAN_SCANS // 2]))
        return (own, steady) if own > WORSE_RATIO * steady + OUTLIER_SIGMAS * PLACE_SIGMA else None

    @property
    def medians(self) -> tuple[float, float] | None:
        """Median error, m, of the sensor and of constant velocity over all scans; None before the first."""
        if not self._pairs:
            return None
        own, steady = np.median(np.array(self._pairs), axis=0)
        return float(own), float(steady)

    @property
    def facts(self) -> dict[str, float | None]:
        """The medians, for a manifest."""
        own, steady = self.medians or (None, None)
        return {
            "prior_error_m": None if own is None else round(own, 5),
            "constant_velocity_error_m": None if steady is None else round(steady, 5),
        }

    def state(self) -> State:
        """All errors so far, for a checkpoint."""
        return {"pairs": np.array(self._pairs).reshape(-1, 2)}

    def restore(self, state: State) -> None:
        """Replace the errors by those of `state`."""
        self._pairs = [(float(own), float(steady)) for own, steady in state["pairs"]]


# (3, 3) m2 and rad2, of a registration without covariance.
PLACE_NOISE, TURN_NOISE = PLACE_SIGMA**2 * np.eye(3), TURN_SIGMA**2 * np.eye(3)

VELOCITY, DOWN, BIAS = slice(0, 3), slice(3, 6), slice(6, 9)


@dataclass(frozen=True)
class ImuEstimate:
    """Velocity of the IMU and gravity in the world, accelerometer bias in IMU axes; SI units.

    covariance : (9, 9) of velocity, gravity and accelerometer bias
    """

    velocity: Floats
    gravity: Floats
    accel_bias: Floats
    gyroscope: Gyroscope
    covariance: Floats = field(repr=False)

    @property
    def down(self) -> tuple[Floats, float]:
        """Direction of gravity in the world, (3,) unit, and one sigma of the larger of its two tilts, rad."""
        norm = float(np.linalg.norm(self.gravity))
        direction = self.gravity / norm
        across = np.eye(3) - np.outer(direction, direction)
        values = np.linalg.eigvalsh(across @ self.covariance[DOWN, DOWN] @ across)
        return direction, float(np.sqrt(max(values[-1], 0.0))) / norm

    @property
    def summary(self) -> ImuState:
        """Means and standard deviations of biases, gravity, mounting and clock offset, for reports; NaN if not estimated."""
        g = self.gyroscope
        values, variances = np.full(13, np.nan), np.full(13, np.nan)
        values[:9] = np.concatenate([self.accel_bias, g.bias, self.gravity])
        diagonal = np.diag(self.covariance)
        variances[:9] = np.concatenate([diagonal[BIAS], np.diag(g.covariance)[:3], diagonal[DOWN]])
        if g.has_mounting:
            values[9:12], variances[9:12] = g.rotation[0], np.diag(g.rotation_covariance)
        if g.has_offset:
            values[12], variances[12] = g.offset_s, g.covariance[12, 12]
        return ImuState(values, np.sqrt(np.maximum(variances, 0.0)))

    def over(self, imu: ImuStream, instants_ns: Longs) -> Increments:
        """Motion measured by the IMU between increasing instants, without biases."""
        return self._integrate(imu, instants_ns, self.gyroscope.bias)

    def _integrate(self, imu: ImuStream, instants_ns: Longs, gyro_bias: Floats) -> Increments:
        """Motion measured by the IMU between instants, less this `gyro_bias` (3,), rad/s, and with the estimated calibration."""
        g = self.gyroscope
        return integrate(imu, instants_ns, gyro_bias, self.accel_bias, g.axes, g.mounting, g.offset_ns)

    def displacement(self, step: Increments, R: Floats) -> tuple[Floats, Floats]:
        """Mean (3,) and covariance (3, 3) of how far `step` leads, m, world axes; R (3, 3) of the IMU at its beginning."""
        x, P = _propagate(self, step, R)
        return x[:3], P[:3, :3]

    def propagate(self, step: Increments, R: Floats) -> ImuEstimate:
        """The estimate at the last instant of `step`, with nothing but the IMU to go by; R (3, 3) of the IMU at the first."""
        x, P = _propagate(self, step, R)
        return self._with(x[3:], P[3:, 3:], step)

    def calibrate(self, step: Increments, R: Floats, R_end: Floats, noise: Floats | None = None) -> Gyroscope:
        """The gyroscope, now that registration turned the IMU from R to R_end (3, 3) in the course of `step`.

        step : as this estimate finds it `over` the two instants
        noise : (3, 3) rad2, world axes, of either rotation; None for a registration without covariance
        """
        R_imu = R @ step.rotations[-1]
        if noise is None:
            noise = TURN_NOISE
        return self.gyroscope.learn(step, vector_between(R_imu, R_end), 2 * R_imu.T @ noise @ R_imu)

    def correct(
        self,
        imu: ImuStream,
        step: Increments,
        R: Floats,
        R_end: Floats,
        displacement: Floats,
        gyroscope: Gyroscope,
        noise: Floats | None = None,
    ) -> ImuEstimate:
        """The estimate at the last instant of `step`, updated by the registered motion over it.

        step : integrated by this estimate (`over`) between the two instants
        R, R_end : (3, 3) of the IMU in the world at the first and the last instant
        displacement : (3,) m in between
        gyroscope : its calibration after the same motion (`calibrate`)
        noise : (3, 3) m2, world axes, of either position; None for a registration without covariance
        """
        rest = vector_between(R @ step.rotations[-1], R_end)
        # The shape of the turn is the gyroscope's, its sum is registration's.
        axes = self.gyroscope.axes
        bias = self.gyroscope.bias - kalman.turn_bias(step.rotations[-1], step.velocity_arms[-1], axes, rest)
        step = self._integrate(imu, step.instants_ns, bias)
        place = PLACE_NOISE if noise is None else PLACE_NOISE + noise
        x, P = _propagate(self, step, R)
        x, P = kalman.correct_by_displacement(x, P, displacement, 2 * place, GRAVITY, GRAVITY_SIGMA_M_S2, RARE_SIGMAS)
        return self._with(x[3:], P[3:, 3:], step, gyroscope)

    def _with(self, x: Floats, P: Floats, step: Increments, gyroscope: Gyroscope | None = None) -> ImuEstimate:
        """The estimate of mean x (9,) and covariance P plus random walks; a changed mounting also changes the bias."""
        # Velocity, gravity and accelerometer bias.
        P = P + np.diag(np.repeat([0.0, GRAVITY_WALK**2, self.gyroscope.noise.accel_walk**2], 3)) * step.duration
        device = self.gyroscope if gyroscope is None else gyroscope
        bias = x[BIAS]
        before, after = self.gyroscope.mounting, device.mounting
        if gyroscope is not None and before is not None and after is not None:
            # The force goes on as it was: the bias had learnt it about the axes before, and may be wrong by as much.
            force = np.linalg.solve(step.velocity_arms[-1], step.velocities[-1])
            change = before.T @ force - after.T @ force
            bias = bias + change
            P[BIAS, BIAS] += np.outer(change, change)
        return ImuEstimate(x[VELOCITY], x[DOWN], bias, device, P)


def _propagate(estimate: ImuEstimate, step: Increments, R: Floats) -> tuple[Floats, Floats]:
    """Mean (12,) and covariance (12, 12) of displacement, velocity, gravity and accelerometer bias at the end of `step`."""
    x = np.concatenate([estimate.velocity, estimate.gravity, estimate.accel_bias])
    velocity_arm, position_arm = step.velocity_arms[-1], step.position_arms[-1]
    if (mounting := estimate.gyroscope.mounting) is not None:
        velocity_arm, position_arm = velocity_arm @ mounting, position_arm @ mounting
    return kalman.propagate(
        x,
        estimate.covariance,
        step.duration,
        step.velocities[-1],
        step.positions[-1],
        velocity_arm,
        position_arm,
        R,
        math.sqrt(estimate.gyroscope.noise.force**2 + step.hidden_density[0]),
    )
