"""Inertial measurements beside poses, as smoothers and pose graphs take and give them: plain values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class SmootherNoise:
    """Densities, one sigma: force, m/s2 per sqrt(Hz); random walks per sqrt(s) of both biases and of gravity in the map's world.

    The rates' noise stands with each step.
    """

    force: float
    accel_walk: float
    gyro_walk: float
    gravity_walk: float


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
    hidden : (m/s2)2 per Hz of force that the range of the IMU cut off
    T_world_imu : (4, 4) registered, and its covariance (6, 6), t' = t + d[:3], R' = exp(d[3:]) R in world axes; None where
        registration failed
    """

    seconds: Floats
    accel: Floats
    rates: Floats
    rate_noise: Floats
    T_world_imu: Floats | None = None
    covariance: Floats | None = None
    hidden: float = 0.0


@dataclass(frozen=True)
class InertialLink:
    """What an IMU in the place and axes of the LiDAR would have measured from keyframe `a` to keyframe `b`."""

    a: int
    b: int
    step: InertialStep


@dataclass(frozen=True)
class InertialChain:
    """The IMU between the keyframes of a run, without the pairs over which it was silent.

    accel_bias, gyro_bias : (3,) as they were at the end, LiDAR axes, m/s2 and rad/s
    """

    links: Sequence[InertialLink]
    accel_bias: Floats
    gyro_bias: Floats
    noise: SmootherNoise

    @property
    def level(self) -> frozenset[int]:
        """The keyframes whose tilt the IMU tells.

        A link by itself tells of none: the velocities at its ends are free, and take up whatever gravity is said to be.
        """
        joints = {link.a for link in self.links} & {link.b for link in self.links}
        known = [(link.a, link.b) for link in self.links if not joints.isdisjoint((link.a, link.b))]
        return frozenset(k for ends in known for k in ends)

    def until(self, count: int) -> InertialChain | None:
        """That of the first `count` keyframes; None without a link."""
        links = [link for link in self.links if max(link.a, link.b) < count]
        return replace(self, links=links) if links else None
