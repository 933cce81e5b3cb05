"""Calibration of a gyroscope's constant errors by registered rotations, and the covariance of its own rotations.

Two of them are those of the whole device, where they are asked for: how it is mounted, and how late its clock is.

The axes of a consumer device are some per cent askew, and its mounting is known to a degree or two: while the sensor turns,
that is worth more than its bias wanders, and no noise at all but the same error at every turn.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.config.odometry import ImuConfig
from lslam.core.geometry import so3
from lslam.core.kernels.linearisation import RARE_SIGMAS
from lslam.odometry.inertial.integrate import Increments
from lslam.odometry.kernels import kalman

# rad/s per sqrt(Hz), least noise density; rad/s per sqrt(s), random walk of the bias: that of Kalibr's
# ADIS16448. Ten times more, and turns over more than some seconds were registration's again, with all its noise.
RATE_NOISE, BIAS_WALK = float(np.deg2rad(0.01)), float(np.deg2rad(0.001))
# Force that no bias explains (shaking, misaligned axes, readings cut at the rate), m/s2 per sqrt(Hz). With the ICM-20948 over
# 0.1 s of simulated drives, walks and flights it is 0.004 (motorway) to 0.05 (streets, flights).
FORCE_NOISE = 0.05
# Random walk of the accelerometer's bias, m/s2 per sqrt(s).
ACCEL_WALK = 2e-3


@dataclass(frozen=True)
class ImuNoise:
    """Densities of white noise, per sqrt(Hz), and of the random walk of biases, per sqrt(s).

    force : m/s2, that no bias explains; rate : rad/s, a lower bound, since the actual one is estimated; accel_walk, gyro_walk :
        of the biases
    """

    force: float = FORCE_NOISE
    rate: float = RATE_NOISE
    accel_walk: float = ACCEL_WALK
    gyro_walk: float = BIAS_WALK

    @classmethod
    def of(cls, config: ImuConfig) -> ImuNoise:
        """The configured densities, defaults for those that are not set."""
        c = config
        return cls(
            FORCE_NOISE if c.accel_noise is None else c.accel_noise,
            RATE_NOISE if c.gyro_noise is None else c.gyro_noise,
            ACCEL_WALK if c.accel_walk is None else c.accel_walk,
            BIAS_WALK if c.gyro_walk is None else c.gyro_walk,
        )


USUAL_NOISE = ImuNoise()


# One sigma of scale, misalignment and mounting together: a data sheet's 2 % across the axes, a degree of mounting.
AXES_SIGMA = 0.025
# The noise is learnt over so many scans.
NOISE_MEMORY_SCANS = 20
# Where they are estimated, one sigma: a mounting read off a drawing or by eye, rad; the latency of a driver, s; how an offset
# of two clocks drifts (some ppm), s per sqrt(s).
MOUNTING_SIGMA, OFFSET_SIGMA, OFFSET_WALK = np.deg2rad(3.0), 0.03, 1e-5
# (3, 9) rotation vector of what rotation there is in the rows of the axes, to first order: their antisymmetric part.
MOUNTING = 0.5 * np.array(
    [
        [0, 0, 0, 0, 0, -1, 0, 1, 0],
        [0, 0, 1, 0, 0, 0, -1, 0, 0],
        [0, -1, 0, 1, 0, 0, 0, 0, 0],
    ],
    dtype=float,
)


@dataclass(frozen=True)
class Gyroscope:
    """Calibration of a gyroscope: rates are axes @ (reading - bias), rad/s.

    bias : (3,) rad/s; axes : (3, 3), the identity for a perfect device
    covariance : (12, 12) of the bias and of the rows of `axes`; (13, 13) where the offset of the clocks is estimated too
    rate_variance : (rad/s)^2 per Hz of the residual noise; noise : of the device, its accelerometer's too
    offset_s : s to add to the stamps; has_mounting : whether the rotation in `axes` applies to the accelerometer too
    """

    bias: Floats
    axes: Floats = field(default_factory=lambda: np.eye(3))
    covariance: Floats = field(default_factory=lambda: np.zeros((12, 12)), repr=False)
    rate_variance: float = RATE_NOISE**2
    noise: ImuNoise = USUAL_NOISE
    offset_s: float = 0.0
    has_mounting: bool = False

    @classmethod
    def of_bias(cls, bias: Floats, sigma: float, noise: ImuNoise = USUAL_NOISE) -> Gyroscope:
        """The prior of a device: its bias (3,), with `sigma` rad/s."""
        P = np.diag(np.repeat([sigma**2, AXES_SIGMA**2], [3, 9]))
        return cls(bias, covariance=P, rate_variance=noise.rate**2, noise=noise)

    def with_calibration(self, mounting: bool, offset: bool) -> Gyroscope:
        """This prior with wide sigmas of mounting rotation and clock offset, for those that are to be estimated."""
        P = self.covariance
        if mounting:
            P = P.copy()
            P[3:12, 3:12] += 4 * (MOUNTING_SIGMA**2 - 0.5 * AXES_SIGMA**2) * (MOUNTING.T @ MOUNTING)
        if offset:
            P = np.pad(P, (0, 1))
            P[12, 12] = OFFSET_SIGMA**2
        return replace(self, covariance=P, has_mounting=mounting)

    @property
    def has_offset(self) -> bool:
        """Whether the offset of the clocks is estimated."""
        return len(self.covariance) > 12

    @property
    def offset_ns(self) -> int:
        """To add to the stamps."""
        return round(1e9 * self.offset_s)

    @property
    def rotation(self) -> tuple[Floats, float]:
        """Rotation vector (3,) of how the device is turned against its given axes, rad, and one sigma of its worst axis."""
        largest = float(np.linalg.eigvalsh(self.rotation_covariance)[-1])
        return so3.log(_nearest_rotation(self.axes)), float(np.sqrt(max(largest, 0.0)))

    @property
    def rotation_covariance(self) -> Floats:
        """(3, 3) rad2 of that rotation vector, to first order."""
        return np.asarray(MOUNTING @ self.covariance[3:12, 3:12] @ MOUNTING.T)

    @property
    def mounting(self) -> Floats | None:
        """(3, 3) that turns specific forces into the given axes; None where they are taken as they are."""
        return _nearest_rotation(self.axes) if self.has_mounting else None

    @property
    def tilt(self) -> tuple[float, float]:
        """Angle between a sensed and the actual axis of rotation, rad, and its sigma, for the most significant of three axes."""
        best = (0.0, np.inf)
        for k in range(3):
            off = np.delete(self.axes[:, k], k)
            across = np.delete(np.arange(3), k)
            C = self.covariance[np.ix_(3 + 3 * across + k, 3 + 3 * across + k)]
            angle, sigma = float(np.linalg.norm(off)), float(np.sqrt(np.linalg.eigvalsh(C)[-1]))
            if angle / max(sigma, 1e-9) > best[0] / max(best[1], 1e-9):
                best = angle, sigma
        return best

    def rates(self, readings: Floats) -> Floats:
        """(..., 3) rad/s from `readings` (..., 3)."""
        return np.asarray((readings - self.bias) @ self.axes.T)

    def turn_covariance(self, step: Increments) -> Floats:
        """(3, 3) rad2 of the turn over `step`, in IMU axes at its end."""
        if self.has_offset:
            H = self.columns(step)
            return np.asarray(H @ self.covariance @ H.T + self._variance(step) * step.duration * np.eye(3))
        return kalman.turn_covariance(
            self.covariance, self._variance(step), step.rotations[-1], step.velocity_arms[-1], self.axes, step.duration
        )

    def learn(self, step: Increments, rest: Floats, noise: Floats) -> Gyroscope:
        """Update by a registered rotation over `step` that is larger by `rest` (3,), rad, with covariance `noise` (3, 3), rad2.

        `rest` and `noise` are in IMU axes at the end of the step.
        """
        if self.has_offset:
            return self._learnt_with_offset(step, rest, noise)
        x, P, excess = kalman.correct_turn(
            np.concatenate([self.bias, self.axes.ravel()]),
            self.covariance,
            self._variance(step),
            step.rotations[-1],
            step.velocity_arms[-1],
            step.duration,
            rest,
            noise,
            self.noise.gyro_walk,
            RARE_SIGMAS,
        )
        return self._update(x, P, excess, step)

    def with_bias(self, bias: Floats, covariance: Floats) -> Gyroscope:
        """The calibration with the bias (3,) and `covariance` (3, 3) of another estimate; the rest follows by its correlation."""
        P = self.covariance
        gain = np.linalg.solve(P[:3, :3], P[:3]).T
        d = gain @ (bias - self.bias)
        P = P - gain @ (P[:3, :3] - covariance) @ gain.T
        offset = self.offset_s + float(d[12]) if self.has_offset else self.offset_s
        return replace(
            self, bias=bias, axes=self.axes + d[3:12].reshape(3, 3), covariance=0.5 * (P + P.T), offset_s=offset
        )

    def _variance(self, step: Increments) -> float:
        """(rad/s)^2 per Hz over `step`."""
        return self.rate_variance + step.hidden_density[1]

    def columns(self, step: Increments) -> Floats:
        """Jacobian (3, 12) of the rotation over `step` by bias and rows of `axes`, at a constant rate.

        (3, 13) where the clock offset is estimated: a later interval gains rotation at its end and loses some at its begin.
        """
        H = kalman.turn_columns(step.rotations[-1], step.velocity_arms[-1], self.axes, step.duration)
        if not self.has_offset:
            return H
        begin, end = self.rates(step.readings)
        return np.column_stack([H, step.rotations[-1].T @ begin - end])

    def _learnt_with_offset(self, step: Increments, rest: Floats, noise: Floats) -> Gyroscope:
        """The update of `learn` by `kalman.update` with the clock offset as a thirteenth state."""
        walk = np.zeros(13)
        walk[:3], walk[12] = self.noise.gyro_walk**2 * step.duration, OFFSET_WALK**2 * step.duration
        before = self.covariance + np.diag(walk)
        own = noise + self._variance(step) * step.duration * np.eye(3)
        H = self.columns(step)
        allowed = float(np.trace(H @ before @ H.T + own))
        x = np.concatenate([self.bias, self.axes.ravel(), [self.offset_s]])
        x, P = kalman.update(x, before, H, rest, own, RARE_SIGMAS)
        return self._update(x, P, min(float(rest @ rest), RARE_SIGMAS**2 * allowed) - allowed, step)

    def _update(self, x: Floats, P: Floats, excess: float, step: Increments) -> Gyroscope:
        """The calibration of mean x and covariance P; `excess`, rad2, of a squared innovation raises the noise of the rates."""
        variance = max(self.rate_variance + excess / (3 * step.duration * NOISE_MEMORY_SCANS), self.noise.rate**2)
        offset = float(x[12]) if self.has_offset else self.offset_s
        return Gyroscope(x[:3], x[3:12].reshape(3, 3), P, variance, self.noise, offset, self.has_mounting)


def _nearest_rotation(axes: Floats) -> Floats:
    """The orthogonal matrix (3, 3) nearest to `axes` (3, 3)."""
    u, _, vt = np.linalg.svd(axes)
    return np.asarray(u @ vt)
