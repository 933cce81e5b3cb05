"""How a vehicle moves: along a curve, over the ground, at a speed profile. Poses are exact at any instant."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.geometry import se3, so3
from lslam.simulation.curve import Curve
from lslam.simulation.terrain import Terrain

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class SpeedProfile:
    """What limits a vehicle: cruising speed and the speed at the start, m/s; accelerations along and across, m/s2."""

    cruise: float
    start: float
    acceleration: float = 3.0
    braking: float = 4.0
    lateral: float = 4.0


@dataclass(frozen=True)
class Suspension:
    """Small rolling, pitching and heaving over time: K sines on each of (roll, pitch, heave), rad and m.

    amplitudes, phases : (K, 3); frequencies : (K,) Hz
    """

    amplitudes: Floats
    phases: Floats
    frequencies: Floats

    def at(self, times: NDArray[Any]) -> Floats:
        """(M, 3) roll, pitch (rad) and heave (m) at `times` (M,), s."""
        angle = 2 * np.pi * times[:, None, None] * self.frequencies[:, None] + self.phases
        return np.asarray(np.sum(self.amplitudes * np.sin(angle), axis=1))


def suspension(rng: np.random.Generator, angle_deg: float = 0.15, heave: float = 0.004) -> Suspension:
    """Suspension of a car: three sines of 0.6 to 2.2 Hz on each axis."""
    amplitudes = rng.uniform(0.3, 1.0, (3, 3)) * [np.radians(angle_deg), np.radians(angle_deg), heave]
    return Suspension(amplitudes, rng.uniform(0, 2 * np.pi, (3, 3)), rng.uniform(0.6, 2.2, 3))


@dataclass(frozen=True)
class VehiclePath:
    """A LiDAR `height` m above the ground on a vehicle that follows `curve`.

    travelled : distance along the curve over time, a smooth function of s; duration : s it is defined for
    """

    curve: Curve
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
        return se3.make(R @ so3.exp(np.column_stack([roll, pitch, np.zeros_like(roll)])), position)


def drive(
    curve: Curve, terrain: Terrain, speed: SpeedProfile, distance: float, height: float, shaking: Suspension
) -> VehiclePath:
    """Drive `distance` m along `curve`, lap after lap on a closed one."""
    from scipy.interpolate import CubicSpline

    s = np.linspace(0, distance, int(np.ceil(distance / 0.25)) + 1)
    v = _speeds(curve, s, speed)
    t = np.concatenate([[0.0], np.cumsum(2 * np.diff(s) / (v[:-1] + v[1:]))])
    travelled = CubicSpline(t, s, bc_type=((1, v[0]), (1, v[-1])))
    return VehiclePath(curve, terrain, travelled, float(t[-1]), height, shaking)


def _speeds(curve: Curve, s: Floats, speed: SpeedProfile) -> Floats:
    """Speed at each distance: the cruise, less in bends, reached with bounded acceleration and braking."""
    bend = np.maximum(np.abs(curve.curvature(s)), 1e-9)
    v = np.minimum(speed.cruise, np.sqrt(speed.lateral / bend))
    step = np.diff(s)
    v[0] = min(v[0], speed.start)
    for i in range(len(step)):
        v[i + 1] = min(v[i + 1], np.sqrt(v[i] ** 2 + 2 * speed.acceleration * step[i]))
    for i in range(len(step) - 1, -1, -1):
        v[i] = min(v[i], np.sqrt(v[i + 1] ** 2 + 2 * speed.braking * step[i]))
    return np.asarray(v)
