"""What is known of an IMU besides the poses: velocity, gravity and biases, as Gaussians that every registered scan narrows.

Rotation and translation are two small linear filters: registration gives rotations far better than tilt from accelerations,
so the rotations along the way are taken as known when forces are integrated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lslam.inertial.gyroscope import Gyroscope
from lslam.inertial.integrate import Increments, integrate
from lslam.inertial.kalman import OUTLIER
from lslam.kernels import kalman
from lslam.kernels.rotation import vector_between
from lslam.types.imu import ImuStream

Floats = NDArray[np.float64]

GRAVITY = 9.80665
# Registration from scan to scan, at the least: m and rad, one sigma.
PLACE_SIGMA, TURN_SIGMA = 0.007, np.deg2rad(0.05)
# Force that no bias explains (shaking, misaligned axes, readings cut at the rate), m/s2 per sqrt(Hz). With the ICM-20948 over
# 0.1 s of simulated drives, walks and flights it is 0.004 (motorway) to 0.05 (streets, flights).
FORCE_NOISE = 0.05
# Random walks of bias and direction of gravity, per sqrt(s).
GRAVITY_WALK, ACCEL_WALK = 5e-3, 2e-3
GRAVITY_SIGMA = 0.03  # m/s2, over the Earth

# (3, 3) m2 and rad2, of a registration without covariance.
PLACE_NOISE, TURN_NOISE = PLACE_SIGMA**2 * np.eye(3), TURN_SIGMA**2 * np.eye(3)

# (9, 9) per second, random walks of velocity, gravity and accelerometer bias.
WALK = np.diag(np.repeat([0.0, GRAVITY_WALK**2, ACCEL_WALK**2], 3))

VELOCITY, DOWN, BIAS = slice(0, 3), slice(3, 6), slice(6, 9)


@dataclass(frozen=True)
class ImuEstimate:
    """Velocity of the IMU and gravity in the world, bias of its forces in IMU axes; SI units.

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

    def over(self, imu: ImuStream, instants_ns: NDArray[np.int64]) -> Increments:
        """What the IMU felt between increasing instants, biases taken off."""
        return integrate(imu, instants_ns, self.gyroscope.bias, self.accel_bias, self.gyroscope.axes)

    def displacement(self, step: Increments, R: Floats) -> tuple[Floats, Floats]:
        """Mean (3,) and covariance (3, 3) of how far `step` leads, m, world axes; R (3, 3) of the IMU at its beginning."""
        x, P = _propagate(self, step, R)
        return x[:3], P[:3, :3]

    def carried(self, step: Increments, R: Floats) -> ImuEstimate:
        """The estimate at the last instant of `step`, with nothing but the IMU to go by; R (3, 3) of the IMU at the first."""
        x, P = _propagate(self, step, R)
        return self._with(x[3:], P[3:, 3:], step)

    def taught(self, step: Increments, R: Floats, R_end: Floats, noise: Floats | None = None) -> Gyroscope:
        """The gyroscope, now that registration turned the IMU from R to R_end (3, 3) in the course of `step`.

        step : as this estimate finds it `over` the two instants
        noise : (3, 3) rad2, world axes, of either rotation; None for a registration without covariance
        """
        R_felt = R @ step.rotations[-1]
        if noise is None:
            noise = TURN_NOISE
        return self.gyroscope.learnt(step, vector_between(R_felt, R_end), 2 * R_felt.T @ noise @ R_felt)

    def corrected(
        self, imu: ImuStream, step: Increments, R: Floats, R_end: Floats, moved: Floats,
        gyroscope: Gyroscope, noise: Floats | None = None,
    ) -> ImuEstimate:  # fmt: skip
        """The estimate at the last instant of `step`, updated by the registered motion over it.

        step : as this estimate finds it `over` the two instants
        R, R_end : (3, 3) of the IMU in the world at the first and the last instant; moved : (3,) m in between
        gyroscope : as the turn has `taught`
        noise : (3, 3) m2, world axes, of either place; None for a registration without covariance
        """
        rest = vector_between(R @ step.rotations[-1], R_end)
        # The shape of the turn is the gyroscope's, its sum is registration's.
        axes = self.gyroscope.axes
        bias = self.gyroscope.bias - kalman.turn_bias(step.rotations[-1], step.velocity_arms[-1], axes, rest)
        step = integrate(imu, step.instants_ns, bias, self.accel_bias, axes)
        place = PLACE_NOISE if noise is None else PLACE_NOISE + noise
        x, P = _propagate(self, step, R)
        x, P = kalman.placed(x, P, moved, 2 * place, GRAVITY, GRAVITY_SIGMA, OUTLIER)
        return self._with(x[3:], P[3:, 3:], step, gyroscope)

    def _with(self, x: Floats, P: Floats, step: Increments, gyroscope: Gyroscope | None = None) -> ImuEstimate:
        walk = WALK * step.duration
        known = self.gyroscope if gyroscope is None else gyroscope
        return ImuEstimate(x[VELOCITY], x[DOWN], x[BIAS], known, P + walk)


def _propagate(estimate: ImuEstimate, step: Increments, R: Floats) -> tuple[Floats, Floats]:
    """Mean (12,) and covariance (12, 12) of displacement, velocity, gravity and accelerometer bias at the end of `step`."""
    x = np.concatenate([estimate.velocity, estimate.gravity, estimate.accel_bias])
    return kalman.propagate(
        x, estimate.covariance, step.duration, step.velocities[-1], step.positions[-1], step.velocity_arms[-1],
        step.position_arms[-1], R, _force_noise(step),
    )  # fmt: skip


def _force_noise(step: Increments) -> float:
    """m/s2 per sqrt(Hz); a force hidden over the whole step adds as much to the velocity as noise of that density."""
    if step.hidden is None:
        return FORCE_NOISE
    return math.sqrt(FORCE_NOISE**2 + float(step.hidden[:3].max()) ** 2 * step.duration)
