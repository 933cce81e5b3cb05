"""What a smoother of poses and inertial measurements takes and gives, as plain values."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class InertialState:
    """An IMU in the world at one instant, with what is wrong with it.

    T_world_imu : (4, 4); velocity, gravity : (3,) world axes, m/s and m/s2, gravity downwards
    accel_bias, gyro_bias : (3,) IMU axes, m/s2 and rad/s
    covariance : (18, 18) of position, rotation (R' = exp(d) R), velocity, accelerometer bias, gyroscope bias and gravity,
        those of the world in its axes
    """

    T_world_imu: Floats
    velocity: Floats
    accel_bias: Floats
    gyro_bias: Floats
    gravity: Floats
    covariance: Floats = field(repr=False)


@dataclass(frozen=True)
class InertialStep:
    """What an IMU measured from one instant to the next, and where registration put it at the second.

    seconds : (N,) that each reading lasts; accel, rates : (N, 3) m/s2 and rad/s, biases left in
    rate_noise : (3, 3) (rad/s)2 per Hz
    T_world_imu : (4, 4) registered, and its covariance (6, 6), t' = t + d[:3], R' = exp(d[3:]) R in world axes; None where
        registration failed
    """

    seconds: Floats
    accel: Floats
    rates: Floats
    rate_noise: Floats
    T_world_imu: Floats | None = None
    covariance: Floats | None = None
