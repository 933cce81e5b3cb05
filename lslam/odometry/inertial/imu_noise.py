"""The noise of an IMU as its filters take it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lslam.core.config.odometry import ImuConfig

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

    force : m/s2, of what no bias explains; rate : rad/s, the least, for more is learnt; accel_walk, gyro_walk : of the biases
    """

    force: float = FORCE_NOISE
    rate: float = RATE_NOISE
    accel_walk: float = ACCEL_WALK
    gyro_walk: float = BIAS_WALK

    @classmethod
    def of(cls, config: ImuConfig) -> ImuNoise:
        """What the configuration says of it, the defaults where it says nothing."""
        c = config
        return cls(
            FORCE_NOISE if c.accel_noise is None else c.accel_noise,
            RATE_NOISE if c.gyro_noise is None else c.gyro_noise,
            ACCEL_WALK if c.accel_walk is None else c.accel_walk,
            BIAS_WALK if c.gyro_walk is None else c.gyro_walk,
        )


USUAL = ImuNoise()
