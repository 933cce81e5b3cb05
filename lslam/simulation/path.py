"""Motion of a vehicle along a curve, over the ground, by a speed profile; poses are exact at any instant."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.geometry import portable, se3, so3
from lslam.core.types.arrays import Floats
from lslam.simulation.curve import RouteCurve, interpolating_spline
from lslam.simulation.terrain import Terrain


@dataclass(frozen=True)
class SpeedProfile:
    """Limits of a vehicle: cruising and initial speed, m/s; accelerations along and across, m/s2; jerk, m/s3.

    The defaults are comfortable for passengers of a car.
    """

    cruise: float
    start: float
    acceleration: float = 2.0
    braking: float = 2.5
    lateral: float = 4.0
    jerk: float = 2.0

    @property
    def easing(self) -> float:
        """Time from the strongest acceleration to the strongest braking, s, at the largest jerk."""
        return (self.acceleration + self.braking) / self.jerk


@dataclass(frozen=True)
class Suspension:
    """Small oscillations of roll, pitch and heave: K sines each, rad and m.

    amplitudes, phases : (K, 3); frequencies : (K,) Hz
    """

    amplitudes: Floats
    phases: Floats
    frequencies: Floats

    def at(self, times: NDArray[Any]) -> Floats:
        """(M, 3) roll, pitch (rad) and heave (m) at `times` (M,), s."""
        angle = 2 * np.pi * times[:, None, None] * self.frequencies[:, None] + self.phases
        return np.asarray(np.sum(self.amplitudes * portable.sin(angle), axis=1))


def suspension(rng: np.random.Generator, angle_deg: float = 0.15, heave: float = 0.004) -> Suspension:
    """Suspension of a car: three sines of 0.6 to 2.2 Hz on each axis."""
    amplitudes = rng.uniform(0.3, 1.0, (3, 3)) * [np.radians(angle_deg), np.radians(angle_deg), heave]
    return Suspension(amplitudes, rng.uniform(0, 2 * np.pi, (3, 3)), rng.uniform(0.6, 2.2, 3))


@dataclass(frozen=True)
class VehiclePath:
    """A LiDAR `height` m above the ground on a vehicle that follows `curve`.

    travelled : distance along the curve over time, a smooth function of s; duration : s it is defined for
    """

    curve: RouteCurve
    terrain: Terrain
    travelled: Any
    duration: float
    height: float
    shaking: Suspension

    def poses(self, times: NDArray[Any]) -> Floats:
        """(M, 4, 4) exact T_city_lidar at `times` (M,), s since the start."""
        times = np.asarray(times, np.float64)
        s = np.asarray(self.travelled(times))
        xy, t = self.curve.position(s), self.curve.tangent(s)
        slope = self.terrain.slope(xy)
        z_axis = np.column_stack([-slope, np.ones(len(s))])
        z_axis /= np.linalg.norm(z_axis, axis=1, keepdims=True)
        x_axis = np.column_stack([t, np.sum(t * slope, axis=1)])
        x_axis /= np.linalg.norm(x_axis, axis=1, keepdims=True)
        R = np.stack([x_axis, np.cross(z_axis, x_axis), z_axis], axis=-1)
        roll, pitch, heave = self.shaking.at(times).T
        ground = np.column_stack([xy, self.terrain.height(xy)])
        position = ground + (self.height + heave)[:, None] * z_axis
        shaken = portable.product(R, so3.exp(np.column_stack([roll, pitch, np.zeros_like(roll)])))
        return se3.make(shaken, position)


def drive(
    curve: RouteCurve, terrain: Terrain, speed: SpeedProfile, distance: float, height: float, shaking: Suspension
) -> VehiclePath:
    """Path along `distance` m of `curve`, lap after lap on a closed one."""
    s = np.linspace(0, distance, int(np.ceil(distance / 0.25)) + 1)
    v = _speeds(curve, s, speed)
    t = np.concatenate([[0.0], np.cumsum(2 * np.diff(s) / (v[:-1] + v[1:]))])
    times, travelled = _ease(t, s, v, speed.easing if speed.start > 0 else -speed.easing)
    duration = float(np.interp(distance, travelled, times))
    return VehiclePath(curve, terrain, interpolating_spline(times, travelled), duration, height, shaking)


def _speeds(curve: RouteCurve, s: Floats, speed: SpeedProfile) -> Floats:
    """Speed at each distance, m/s: cruising, lower in bends, with bounded acceleration and braking."""
    bend = np.maximum(np.abs(curve.curvature(s)), 1e-9)
    v = np.minimum(speed.cruise, np.sqrt(speed.lateral / bend))
    step, half = s[1] - s[0], speed.easing / 2
    # Easing smears the profile: whatever is slow stays so a little before and after.
    held = v.copy()
    for k in range(1, min(int(speed.cruise * half / step), len(v) - 1) + 1):
        lasting = np.where(k * step <= v * half, v, np.inf)
        held[k:] = np.minimum(held[k:], lasting[:-k])
        held[:-k] = np.minimum(held[:-k], lasting[k:])
    held[0] = min(held[0], speed.start)
    for i in range(len(s) - 1):
        gain = speed.acceleration if s[i] >= speed.start * half else 0.0
        held[i + 1] = min(held[i + 1], np.sqrt(held[i] ** 2 + 2 * gain * step))
    for i in range(len(s) - 2, -1, -1):
        held[i] = min(held[i], np.sqrt(held[i + 1] ** 2 + 2 * speed.braking * step))
    return np.asarray(held)


def _ease(t: Floats, s: Floats, v: Floats, easing: float) -> tuple[Floats, Floats]:
    """Times in even steps from 0 and distances there: `s` over `t` smoothed over `easing` s, so that acceleration is continuous.

    A negative `easing` begins half of it earlier, standing at the start.
    """
    half, step = abs(easing) / 2, 0.05
    # Beyond both ends it goes on evenly.
    fine = np.arange(-2 * half - step, t[-1] + 2 * half + 2 * step, step / 5)
    speeds = np.interp(fine, t, v)
    at = np.concatenate([[0.0], np.cumsum((speeds[1:] + speeds[:-1]) * (step / 10))])
    at += s[0] - np.interp(0.0, fine, at)
    summed = np.concatenate([[0.0], np.cumsum((at[1:] + at[:-1]) * (step / 10))])
    begin = -half if easing < 0 else 0.0
    times = np.arange(0.0, t[-1] + half - begin, step)
    ahead, behind = (np.interp(times + begin + sign * half, fine, summed) for sign in (1, -1))
    return times, (ahead - behind) / (2 * half)
