"""Exact kinematics: one smooth function of time gives the pose, and its derivatives the motion that sensors measure.

Positions and unit quaternions of a path are interpolated by quintic B-splines, four times continuously differentiable. Their
derivatives are analytic, so poses, velocities, accelerations and rates can never disagree with each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from lslam.core.arrays import Floats
from lslam.core.config.input import Section
from lslam.core.geometry import portable, se3, so3
from lslam.simulation.curve import interpolating_spline

KNOT_STEP_S = 0.02  # s between the knots: scans at 10 Hz fall on knots, where the spline meets the path exactly
STANDING_ACCELERATION = 2.0  # m/s2, the most that moving off from a standing start adds
_EDGE = 1e-6  # s by which a query may overstep the ends: rounding of stamps to ns
SINES = 12  # on each axis


class PosePath(Protocol):
    """Pose of a LiDAR over `duration` s: the interface of vehicle, drone and walker."""

    @property
    def duration(self) -> float:
        """Seconds the path is defined for, from 0."""
        ...

    def poses(self, times: NDArray[Any]) -> Floats:
        """(M, 4, 4) T_city_lidar at `times` (M,), s."""
        ...


@dataclass(frozen=True)
class Kinematics:
    """The motion of one body at M instants.

    poses : (M, 4, 4) T_city_body; velocity, acceleration : (M, 3) of its origin in the city frame, m/s and m/s2
    rate, rate_change : (M, 3) angular velocity and acceleration in the body frame, rad/s and rad/s2
    """

    poses: Floats
    velocity: Floats
    acceleration: Floats
    rate: Floats
    rate_change: Floats

    def at_sensor(self, T_body_sensor: NDArray[Any]) -> Kinematics:
        """Motion of a sensor fixed to the body at `T_body_sensor` (4, 4), with the effect of the lever arm."""
        R_body_sensor, arm = np.asarray(T_body_sensor)[:3, :3], np.asarray(T_body_sensor)[:3, 3]
        R = self.poses[:, :3, :3]
        swing = np.cross(self.rate, arm)
        pull = np.cross(self.rate_change, arm) + np.cross(self.rate, swing)
        return Kinematics(
            poses=portable.product(self.poses, np.asarray(T_body_sensor, np.float64)),
            velocity=self.velocity + portable.rotate(R, swing),
            acceleration=self.acceleration + portable.rotate(R, pull),
            rate=portable.product(self.rate, R_body_sensor),
            rate_change=portable.product(self.rate_change, R_body_sensor),
        )


@dataclass(frozen=True)
class Motion:
    """A path as a function with derivatives; made by `smooth_motion`.

    position, quaternion : splines of T_city_lidar over s; the quaternion (xyzw) is unit only after normalisation
    duration : s, from 0
    """

    position: Any
    quaternion: Any
    duration: float

    def poses(self, times: NDArray[Any]) -> Floats:
        """(M, 4, 4) exact T_city_lidar at `times` (M,), s. Raises ValueError outside 0..duration."""
        at = self._inside(times)
        return se3.make(so3.from_quaternion(self.quaternion(at)), self.position(at))

    def at(self, times: NDArray[Any]) -> Kinematics:
        """Kinematics of the LiDAR at `times` (M,), s. Raises ValueError outside 0..duration."""
        at = self._inside(times)
        q, dq, ddq = (np.asarray(self.quaternion(at, nu=k)) for k in range(3))
        # The length of q cancels: only the part of conj(q) dq that turns is left in its vector part.
        square = np.sum(q * q, axis=1, keepdims=True)
        rate = 2 * _conjugate_times(q, dq) / square
        stretch = 2 * np.sum(q * dq, axis=1, keepdims=True) / square
        return Kinematics(
            poses=self.poses(at),
            velocity=np.asarray(self.position(at, nu=1)),
            acceleration=np.asarray(self.position(at, nu=2)),
            rate=rate,
            rate_change=2 * _conjugate_times(q, ddq) / square - stretch * rate,
        )

    def _inside(self, times: NDArray[Any]) -> Floats:
        """The times as float64; raises ValueError for one outside 0..duration."""
        at = np.asarray(times, np.float64)
        if len(at) and not (at.min() >= -_EDGE and at.max() <= self.duration + _EDGE):
            raise ValueError(f"times {at.min():g}..{at.max():g} s leave the motion of 0..{self.duration:g} s")
        return at


@dataclass(frozen=True)
class StandingStart:
    """`path` preceded by `seconds` s at rest and a smooth start over `ramp` s."""

    path: PosePath
    seconds: float
    ramp: float

    @property
    def duration(self) -> float:
        """Duration, s, with the rest."""
        return self.path.duration + self.seconds + self.ramp / 2

    def poses(self, times: NDArray[Any]) -> Floats:
        """(M, 4, 4) T_city_lidar at `times` (M,), s."""
        return self.path.poses(self.path_time(times))

    def path_time(self, times: NDArray[Any]) -> Floats:
        """Time on `path`, s, at `times` (M,), s: constant at first, then its rate grows from 0 to 1 as a smooth step."""
        since = np.asarray(times, np.float64) - self.seconds
        u = np.clip(since / self.ramp, 0, 1)
        # The integral of 35 u^4 - 84 u^5 + 70 u^6 - 20 u^7, whose first three derivatives vanish at both ends.
        grown = (u * u) ** 2 * u * (7 - 14 * u + 10 * u**2 - 2.5 * u * u * u)
        return np.asarray(self.ramp * grown + np.maximum(since - self.ramp, 0))


def smooth_motion(path: PosePath, spacing: float = KNOT_STEP_S) -> Motion:
    """Differentiable motion through the poses of `path` every `spacing` s."""
    knots = np.arange(max(int(path.duration / spacing), 8) + 1) * spacing
    # A last step that is shorter than half of the others would make the spline swing.
    knots = np.append(knots[knots < path.duration - spacing / 2], path.duration)
    poses = path.poses(knots)
    q = so3.to_quaternion(poses[:, :3, :3])
    flips = np.where(np.sum(q[1:] * q[:-1], axis=1) < 0, -1.0, 1.0)
    q[1:] *= np.cumprod(flips)[:, None]
    return Motion(interpolating_spline(knots, poses[:, :3, 3]), interpolating_spline(knots, q), float(path.duration))


def standing_start(path: PosePath, seconds: float) -> StandingStart:
    """`path` preceded by `seconds` s at rest; the faster it starts, the longer the smooth start takes."""
    step = 1e-3
    first = path.poses(np.array([0.0, step]))[:, :3, 3]
    speed = float(portable.norm(first[1] - first[0])) / step
    # The pace of the smooth step grows by at most 35/16 per ramp.
    return StandingStart(path, seconds, max(2.0, 35 / 16 * speed / STANDING_ACCELERATION))


def _conjugate_times(q: Floats, p: Floats) -> Floats:
    """Vector part (M, 3) of conj(q) p, quaternions xyzw (M, 4)."""
    v, w = q[:, :3], q[:, 3:]
    return np.asarray(w * p[:, :3] - p[:, 3:] * v - np.cross(v, p[:, :3]))


class Vibration(Section):
    """Vibration of the LiDAR on its mount: it moves the rays, and is not in the ground truth.

    angle_deg, height_mm : root mean square of roll, pitch and yaw each, and up and down; band_hz : lowest and highest frequency
    """

    angle_deg: float = Field(0.0, ge=0, le=2)
    height_mm: float = Field(0.0, ge=0, le=50)
    band_hz: tuple[float, float] = (8.0, 25.0)

    @model_validator(mode="after")
    def _check_band(self) -> Vibration:
        """Raise ValueError for an invalid range of frequencies."""
        low, high = self.band_hz
        if not 0 < low <= high <= 500:
            raise ValueError(f"vibration.band_hz = [{low:g}, {high:g}], expected two numbers up to 500, in order")
        return self


@dataclass(frozen=True)
class Shaking:
    """Sines of random frequencies and phases: amplitudes (4,) of roll, pitch, yaw, rad, and lift, m; others (4, `SINES`)."""

    amplitudes: Floats
    frequencies: Floats
    phases: Floats

    def at(self, times: NDArray[Any]) -> Floats:
        """(M, 4) roll, pitch, yaw, rad, and lift, m, at `times` (M,), s."""
        angle = 2 * np.pi * np.asarray(times)[:, None, None] * self.frequencies + self.phases
        return np.asarray(portable.sin(angle).sum(axis=2) * self.amplitudes)

    def shake(self, poses: NDArray[Any], times: NDArray[Any]) -> Floats:
        """Poses (M, 4, 4) at `times` (M,), s, of a vibrating LiDAR, from poses without vibration, (M, 4, 4) or one (4, 4)."""
        off = self.at(times)
        lift = np.column_stack([np.zeros((len(off), 2)), off[:, 3]])
        return portable.product(np.asarray(poses, np.float64), se3.make(so3.exp(off[:, :3]), lift))


def shaking(vibration: Vibration, rng: np.random.Generator) -> Shaking | None:
    """Vibration of one drive, drawn at random; None when there is none."""
    if not (vibration.angle_deg or vibration.height_mm):
        return None
    rms = np.array([*[np.radians(vibration.angle_deg)] * 3, vibration.height_mm * 1e-3])
    # A sine's root mean square is its amplitude over sqrt(2); independent ones add up in squares.
    shape = (4, SINES)
    frequencies, phases = rng.uniform(*vibration.band_hz, shape), rng.uniform(0, 2 * np.pi, shape)
    return Shaking(rms * np.sqrt(2 / SINES), frequencies, phases)
