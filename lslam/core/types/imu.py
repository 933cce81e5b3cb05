"""Readings of an IMU and of wheels, the direction of gravity, errors of an IMU, and what links scans by it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from lslam.core.arrays import Floats, Longs

# m/s2, the standard gravity of Earth.
GRAVITY = 9.80665


@dataclass(frozen=True)
class ImuStream:
    """Samples of one IMU in its own frame.

    stamps_ns : (M,) int64; accel : (M, 3) specific force, m/s2, +g up at rest; gyro : (M, 3) rad/s
    clipping_sigma : (M, 6) one sigma of what readings at the end of the range lack, of accel and gyro; None where none do
    """

    stamps_ns: Longs
    accel: Floats
    gyro: Floats
    clipping_sigma: Floats | None = None

    def __len__(self) -> int:
        return len(self.stamps_ns)


@dataclass(frozen=True)
class GravityDirection:
    """Measured direction of gravity at the start of a scan.

    direction : (3,) float64, unit, downwards, in LiDAR axes at the scan's stamp
    sigma : rad, one standard deviation of either of the two tilts that it fixes (it says nothing of yaw)

    Errors of scans that follow each other are nearly the same error: the filter behind it forgets over some twenty seconds. A
    graph with a factor per keyframe should count those of one such stretch as one measurement.
    """

    direction: Floats
    sigma: float


XYZ = ("x", "y", "z")
# In the order of the values.
IMU_STATES = (
    *(f"accel_bias_{axis}" for axis in XYZ),
    *(f"gyro_bias_{axis}" for axis in XYZ),
    *(f"gravity_{axis}" for axis in XYZ),
    *(f"mounting_{axis}" for axis in XYZ),
    "offset_s",
)


@dataclass(frozen=True)
class ImuState:
    """Means and standard deviations of `IMU_STATES`, NaN where one is not estimated.

    values, sigmas : (13,) accelerometer bias, m/s2, and gyroscope bias, rad/s, in IMU axes; gravity in the world, m/s2; the
    rotation vector from the IMU's axes to those of the T_lidar_imu that was given, rad; s to add to its stamps
    """

    values: Floats
    sigmas: Floats


@dataclass(frozen=True)
class ImuDiagnostics:
    """What an IMU made of one scan beside its pose, all None without one.

    state : errors of its readings after the scan, until it was refused
    gravity : the direction down; None where the scan is bridged or the IMU has a gap
    steady_norm : as `ScanResult.prior_norm`, of constant velocity, which the IMU took the place of
    steady_iterations : iterations of registration from constant velocity on the same map, of a sample of the scans
    saved_s : likewise, how much longer that took, s; the IMU's own part counted against it
    """

    state: ImuState | None = None
    gravity: GravityDirection | None = None
    steady_norm: float | None = None
    steady_iterations: int | None = None
    saved_s: float | None = None


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
    """State of an IMU in the world at one instant, with its biases and errors.

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
    clipping : (m/s2)2 per Hz of force that the range of the IMU cut off
    T_world_imu : (4, 4) registered, and its covariance (6, 6), t' = t + d[:3], R' = exp(d[3:]) R in world axes; None where
        registration failed
    """

    seconds: Floats
    accel: Floats
    rates: Floats
    rate_noise: Floats
    T_world_imu: Floats | None = None
    covariance: Floats | None = None
    clipping: float = 0.0


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
        """Keyframes whose tilt is observable by the IMU: those of links that meet another link.

        In a single link the velocities at both ends are free, and fit any direction of gravity.
        """
        joints = {link.a for link in self.links} & {link.b for link in self.links}
        known = [(link.a, link.b) for link in self.links if not joints.isdisjoint((link.a, link.b))]
        return frozenset(k for ends in known for k in ends)

    def until(self, count: int) -> InertialChain | None:
        """The chain of the first `count` keyframes; None without a link among them."""
        links = [link for link in self.links if max(link.a, link.b) < count]
        return replace(self, links=links) if links else None


@dataclass(frozen=True)
class WheelStream:
    """Speeds of a vehicle by its wheels.

    stamps_ns : (M,) int64, increasing; speed : (M,) m/s, forwards; yaw_rate : (M,) rad/s, None where it was not measured
    T_lidar_base : (4, 4) the frame of which they are the speeds, x forward and z up; None where its mounting is unknown
    """

    stamps_ns: Longs
    speed: Floats
    yaw_rate: Floats | None = None
    T_lidar_base: Floats | None = None

    def __len__(self) -> int:
        return len(self.stamps_ns)
