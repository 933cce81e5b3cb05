"""What an IMU tells a smoother: the state at an instant, and the preintegrated motion from there to the next one."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class MotionState:
    """Where an IMU is and how it moves, with the errors of its readings; SI units.

    T_world_imu : (4, 4); velocity, gravity : (3,) in the world; accel_bias, gyro_bias : (3,) in IMU axes
    gyro_axes : (3, 3) that makes true rates of readings less their bias
    covariance : (27, 27) of position, rotation (R' = exp(d) R), velocity, gravity, all in world axes, accelerometer bias,
        gyroscope bias and the rows of its axes
    """

    T_world_imu: Floats
    velocity: Floats
    gravity: Floats
    accel_bias: Floats
    gyro_bias: Floats
    gyro_axes: Floats
    covariance: Floats = field(repr=False)


@dataclass(frozen=True)
class PreintegratedStep:
    """A preintegrated motion between two states, in IMU axes at the first; linear in the errors of the readings.

    seconds : for which velocity and gravity act; 0 where the motion is not the IMU's
    rotation : (3, 3) from the IMU at the end to the IMU at the beginning
    velocity, position : (3,) the specific force integrated once and twice; velocity_arm, position_arm : (3, 3) what a
        constant force adds to them
    turn_columns : (3, 12) by which the turn grows with gyroscope bias and axes, in IMU axes at the end
    accel_bias, gyro_bias (3,), gyro_axes (3, 3) : by which it was integrated
    covariance : (15, 15) of position, rotation, velocity (world axes), accelerometer and gyroscope bias at the end, given
        the beginning
    """

    seconds: float
    rotation: Floats
    velocity: Floats
    position: Floats
    velocity_arm: Floats
    position_arm: Floats
    turn_columns: Floats
    accel_bias: Floats
    gyro_bias: Floats
    gyro_axes: Floats
    covariance: Floats = field(repr=False)


@dataclass(frozen=True)
class SweepLink:
    """What joins a scan to the state before it.

    T_lidar_imu : (4, 4); within : (4, 4) pose of the LiDAR at the middle of the sweep, where the state is, as seen from that
        at the stamp
    state : at the middle of the sweep as the motion model expects it: where a smoother begins
    step : to there from the last scan; None where there was none
    """

    T_lidar_imu: Floats
    within: Floats
    state: MotionState
    step: PreintegratedStep | None = None
