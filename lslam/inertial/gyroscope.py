"""Calibration of a gyroscope's constant errors by registered rotations, and the covariance of its own rotations.

The axes of a consumer device are some per cent askew, and its mounting is known to a degree or two: while the sensor turns,
that is worth more than its bias wanders, and no noise at all but the same error at every turn.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lslam.inertial.integrate import Increments
from lslam.inertial.kalman import OUTLIER
from lslam.kernels import kalman

Floats = NDArray[np.float64]

# One sigma of scale, misalignment and mounting together: a data sheet's 2 % across the axes, a degree of mounting.
AXES_SIGMA = 0.025
# rad/s per sqrt(Hz), least noise density; rad/s per sqrt(s), random walk of the bias: that of Kalibr's
# ADIS16448. Ten times more, and turns over more than some seconds were registration's again, with all its noise.
RATE_NOISE, BIAS_WALK = np.deg2rad(0.01), np.deg2rad(0.001)
# The noise is learnt over so many scans.
MEMORY = 20


@dataclass(frozen=True)
class Gyroscope:
    """From readings to rates: axes @ (reading - bias), rad/s.

    bias : (3,) rad/s; axes : (3, 3), the identity for a perfect device
    covariance : (12, 12) of the bias and of the rows of `axes`
    rate_variance : (rad/s)^2 per Hz, of what is left
    """

    bias: Floats
    axes: Floats = field(default_factory=lambda: np.eye(3))
    covariance: Floats = field(default_factory=lambda: np.zeros((12, 12)), repr=False)
    rate_variance: float = float(RATE_NOISE**2)

    @classmethod
    def of_bias(cls, bias: Floats, sigma: float) -> Gyroscope:
        """The prior of a device: its bias (3,), with `sigma` rad/s."""
        return cls(bias, covariance=np.diag(np.repeat([sigma**2, AXES_SIGMA**2], [3, 9])))

    def rates(self, readings: Floats) -> Floats:
        """(..., 3) rad/s from `readings` (..., 3)."""
        return np.asarray((readings - self.bias) @ self.axes.T)

    def turn_covariance(self, step: Increments) -> Floats:
        """(3, 3) rad2 of the turn over `step`, in IMU axes at its end."""
        return kalman.turn_covariance(
            self.covariance, self._variance(step), step.rotations[-1], step.velocity_arms[-1], self.axes, step.duration
        )

    def learnt(self, step: Increments, rest: Floats, noise: Floats) -> Gyroscope:
        """After registration found the turn over `step` larger by `rest` (3,) rad, itself known to `noise` (3, 3), rad2.

        `rest` and `noise` are in IMU axes at the end of the step.
        """
        x, P, excess = kalman.turned(
            np.concatenate([self.bias, self.axes.ravel()]), self.covariance, self._variance(step), step.rotations[-1],
            step.velocity_arms[-1], step.duration, rest, noise, BIAS_WALK, OUTLIER,
        )  # fmt: skip
        variance = max(self.rate_variance + excess / (3 * step.duration * MEMORY), float(RATE_NOISE**2))
        return Gyroscope(x[:3], x[3:].reshape(3, 3), P, variance)

    def _variance(self, step: Increments) -> float:
        """(rad/s)^2 per Hz over `step`; a rate hidden over all of it adds as much to the turn as noise of that density."""
        if step.hidden is None:
            return self.rate_variance
        return self.rate_variance + float(step.hidden[3:].max()) ** 2 * step.duration

    def columns(self, step: Increments) -> Floats:
        """(3, 12) by which the turn over `step` grows with bias and axes; the rate is taken for constant."""
        return kalman.turn_columns(step.rotations[-1], step.velocity_arms[-1], self.axes, step.duration)
