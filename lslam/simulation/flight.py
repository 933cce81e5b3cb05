"""How a drone flies and a walker carries a LiDAR: along a curve at a height, banking or swinging, with exact poses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.geometry import se3, so3
from lslam.simulation.curve import Curve
from lslam.simulation.path import SpeedProfile, drive, suspension
from lslam.simulation.terrain import Terrain, flat

Floats = NDArray[np.float64]

GRAVITY = 9.81  # m/s2, for the bank of a turn


@dataclass(frozen=True)
class Swing:
    """Sines over time on (x, y, z, roll, pitch, yaw) of a carried sensor, m and rad, in its own frame.

    amplitudes, frequencies, phases : (K, 6); Hz and rad
    """

    amplitudes: Floats
    frequencies: Floats
    phases: Floats

    def at(self, times: NDArray[Any]) -> Floats:
        """(M, 6) displacements at `times` (M,), s."""
        angle = 2 * np.pi * np.asarray(times)[:, None, None] * self.frequencies + self.phases
        return np.asarray(np.sum(self.amplitudes * np.sin(angle), axis=1))


def gait(rng: np.random.Generator, strength: float = 1.0) -> Swing:
    """A hand-held sensor at a walk: steps of 1.8 Hz, sways of half that, looks to both sides, up to about 110 deg/s."""
    amplitudes = np.array([[0.015, 0.03, 0.03, 0.05, 0.05, 0.75], [0.01, 0.01, 0.006, 0.03, 0.03, 0.25]]) * strength
    frequencies = np.array([[1.8, 0.9, 1.8, 0.45, 0.6, 0.3], [0.7, 1.8, 3.6, 0.9, 1.8, 0.8]])
    return Swing(amplitudes, frequencies * rng.uniform(0.93, 1.07, (2, 6)), rng.uniform(0, 2 * np.pi, (2, 6)))


def buffeting(rng: np.random.Generator, strength: float = 1.0) -> Swing:
    """A drone in light wind: centimetres and a degree or so at 0.2 to 1.5 Hz; more with `strength`."""
    size = np.array([0.05, 0.05, 0.04, *np.radians([0.8, 0.8, 1.0])]) * strength
    frequencies = np.stack([rng.uniform(0.2, 0.5, 6), rng.uniform(0.6, 1.5, 6)])
    return Swing(size * np.array([[1.0], [0.35]]), frequencies, rng.uniform(0, 2 * np.pi, (2, 6)))


@dataclass(frozen=True)
class FreePath:
    """A LiDAR carried along `curve` by what does not stand on wheels.

    travelled : horizontal distance over time, a spline; duration : s it is defined for
    heights : at the first scan and after `reach` m of curve, linear between, m above level ground or, when `terrain` is
        given, above that ground
    bank : share of the tilt that balances the turn, 1 for a coordinated one; swing : what shakes it
    """

    curve: Curve
    travelled: Any
    duration: float
    heights: tuple[float, float]
    reach: float
    bank: float
    swing: Swing
    terrain: Terrain | None = None

    def poses(self, times: NDArray[Any]) -> Floats:
        """(M, 4, 4) exact T_city_lidar at `times` (M,), s since the start."""
        times = np.asarray(times, np.float64)
        s = np.asarray(self.travelled(times))
        speed, gain = np.asarray(self.travelled(times, nu=1)), np.asarray(self.travelled(times, nu=2))
        xy, tangent = self.curve.position(s), self.curve.tangent(s)
        left = np.column_stack([-tangent[:, 1], tangent[:, 0]])
        pull = gain[:, None] * tangent + (speed**2 * self.curve.curvature(s))[:, None] * left
        # The rotors push against gravity and into the turn: that direction is up for the body.
        up = np.column_stack([self.bank * pull, np.full(len(s), GRAVITY)])
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        ahead = np.column_stack([tangent, np.zeros(len(s))])
        ahead -= np.sum(ahead * up, axis=1, keepdims=True) * up
        ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
        R = np.stack([ahead, np.cross(up, ahead), up], axis=-1)
        z = self.heights[0] + (self.heights[1] - self.heights[0]) * s / self.reach
        if self.terrain is not None:
            z = z + self.terrain.height(xy)
        shake = self.swing.at(times)
        T = se3.make(R, np.column_stack([xy, z]))
        return np.asarray(T @ se3.make(so3.exp(shake[:, 3:]), shake[:, :3]))


def fly(
    curve: Curve,
    speed: SpeedProfile,
    distance: float,
    heights: tuple[float, float],
    bank: float,
    swing: Swing,
    terrain: Terrain | None = None,
) -> FreePath:
    """Carry a LiDAR `distance` m along `curve`; on a climb `speed` counts along the slope."""
    slope = (heights[1] - heights[0]) / curve.length
    level = 1 / np.hypot(1.0, slope)
    flat_speed = SpeedProfile(
        speed.cruise * level, speed.start * level, speed.acceleration, speed.braking, speed.lateral
    )
    still = suspension(np.random.default_rng(0), 0.0, 0.0)
    timed = drive(curve, flat(), flat_speed, distance, 0.0, still)
    return FreePath(curve, timed.travelled, timed.duration, heights, curve.length, bank, swing, terrain)
