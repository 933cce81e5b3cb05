"""Paths of a LiDAR carried by a drone or a walker: a curve with heights, banking and swinging, with exact poses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.errors import UsageError
from lslam.core.geometry import portable, se3, so3
from lslam.core.types.arrays import Floats
from lslam.simulation.curve import RouteCurve, interpolating_spline, smoothed
from lslam.simulation.path import SpeedProfile, drive, suspension
from lslam.simulation.terrain import Terrain, flat

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
        return np.asarray(np.sum(self.amplitudes * portable.sin(angle), axis=1))


def gait(rng: np.random.Generator, strength: float = 1.0) -> Swing:
    """A hand-held sensor at a walk: steps of 1.9 Hz, sways of half that, and looks to both sides at up to 150 deg/s.

    Two slow sweeps of the head that are nearly in step make it look about for a while and straight ahead for a while.
    """
    amplitudes = np.array(
        [
            [0.015, 0.03, 0.02, 0.04, 0.04, 0.45],
            [0.01, 0.01, 0.004, 0.03, 0.03, 0.45],
            [0.0, 0.0, 0.0, 0.01, 0.015, 0.16],
        ]
    )
    frequencies = np.array(
        [
            [1.9, 0.95, 1.9, 0.45, 0.6, 0.28],
            [0.7, 1.9, 3.8, 0.95, 1.9, 0.34],
            [1.0, 1.0, 1.0, 1.9, 3.8, 0.8],
        ]
    )
    return Swing(
        strength * amplitudes, frequencies * rng.uniform(0.95, 1.05, (3, 6)), rng.uniform(0, 2 * np.pi, (3, 6))
    )


def buffeting(rng: np.random.Generator, strength: float = 1.0) -> Swing:
    """A drone in light wind: centimetres and a degree or so at 0.2 to 1.5 Hz; more with `strength`."""
    size = np.array([0.05, 0.05, 0.04, *np.radians([0.8, 0.8, 1.0])]) * strength
    frequencies = np.stack([rng.uniform(0.2, 0.5, 6), rng.uniform(0.6, 1.5, 6)])
    return Swing(size * np.array([[1.0], [0.35]]), frequencies, rng.uniform(0, 2 * np.pi, (2, 6)))


@dataclass(frozen=True)
class FreePath:
    """Path of a LiDAR along `curve`, carried by a drone or a walker.

    travelled : horizontal distance over time, a spline; duration : s it is defined for
    climb : height over distance, a spline as of `climb_spline`, m above level ground or, when `terrain` is given, that ground
    bank : share of the tilt that balances the turn, 1 for a coordinated one; swing : motion added to it
    """

    curve: RouteCurve
    travelled: Any
    duration: float
    climb: Any
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
        z = np.asarray(self.climb(np.mod(s, self.curve.length) if self.curve.closed else s))
        if self.terrain is not None:
            z = z + self.terrain.height(xy)
        shake = self.swing.at(times)
        T = se3.make(R, np.column_stack([xy, z]))
        return portable.product(T, se3.make(so3.exp(shake[:, 3:]), shake[:, :3]))


def climb_spline(curve: RouteCurve, s: NDArray[Any], heights: NDArray[Any], smoothing: float) -> Any:
    """Height over distance along `curve` through `heights` (N,), m, at distances `s` (N,), smoothed by `smoothing` m."""
    along = np.linspace(0, curve.length, max(int(curve.length / 0.5), 64) + 1)
    z, sigma = np.interp(along, s, heights), smoothing / along[1]
    if curve.closed:
        z = smoothed(z[:-1], sigma, "wrap")
        z = np.append(z, z[0])
    else:
        # Mirroring the differences keeps the ends and a constant slope.
        reach = min(int(np.ceil(4 * sigma)), len(z) - 1)
        z = np.concatenate([2 * z[0] - z[reach:0:-1], z, 2 * z[-1] - z[-2 : -reach - 2 : -1]])
        z = smoothed(z, sigma)[reach:-reach]
    return interpolating_spline(along, z, curve.closed)


def fly(
    curve: RouteCurve,
    speed: SpeedProfile,
    distance: float,
    climb: Any,
    bank: float,
    swing: Swing,
    terrain: Terrain | None = None,
) -> FreePath:
    """Path along `distance` m of `curve`; on a climb the speed counts along its mean slope."""
    rise = float(climb(curve.length) - climb(0.0))
    level = curve.length / float(portable.hypot(curve.length, rise))
    pace = replace(speed, cruise=speed.cruise * level, start=speed.start * level)
    still = suspension(np.random.default_rng(0), 0.0, 0.0)
    timed = drive(curve, flat(), pace, distance, 0.0, still)
    return FreePath(curve, timed.travelled, timed.duration, climb, bank, swing, terrain)


HOVER = 2.0  # s before it moves
GROWING = 2.5  # s until the eights are as large as they get
VIOLENT = 10.0  # s of them after that
HALF = np.array([10.0, 4.2])  # m, of an eight along the hall and across
DIP = 1.05  # m up and down: through the middle it swoops, or its thrust would vanish where the eight straightens
LOOK = 0.6  # rad, by which it looks to both sides
UPWARDS = np.array([0.0, 0.0, GRAVITY])
KNOT_STEP_S = 0.01  # s between the knots of its spline


@dataclass(frozen=True)
class EightFlight:
    """Flight of a quadrotor whose thrust is along its z axis, as a function of time.

    position : spline of T_city_lidar's origin over s; its second derivative says how it is tilted (Mellinger and Kumar 2011)
    heading : spline of the yaw, rad; duration : s, from 0
    """

    position: Any
    heading: Any
    duration: float
    swing: Swing

    def poses(self, times: NDArray[Any]) -> Floats:
        """(M, 4, 4) exact T_city_lidar at `times` (M,), s since the start."""
        times = np.asarray(times, np.float64)
        up = self.position(times, nu=2) + UPWARDS
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        # The shortest turn from upright to there: any other would spin it where it is tilted most.
        half = up + UPWARDS / GRAVITY
        tilt = np.column_stack([-half[:, 1], half[:, 0], np.zeros(len(up)), half[:, 2]])
        look = so3.exp(np.column_stack([np.zeros((len(up), 2)), self.heading(times)]))
        R = portable.product(so3.from_quaternion(tilt / np.linalg.norm(tilt, axis=1, keepdims=True)), look)
        shake = self.swing.at(times)[:, :3]
        return se3.make(R, np.asarray(self.position(times)) + shake)


def eight_flight(
    rng: np.random.Generator, middle: NDArray[Any], speed: float, limit: float, swing: Swing
) -> EightFlight:
    """Flight that hovers at `middle` (3,), then flies figures of eight round it, at most at `speed` m/s.

    Raises UsageError where that needs more than `limit` m/s2 of thrust.
    """
    duration = HOVER + GROWING + VIOLENT
    t = np.arange(0.0, duration + 6 * KNOT_STEP_S, KNOT_STEP_S)
    half = HALF * rng.uniform(0.97, 1.03, 2)
    side, phase = (1.0 if rng.random() < 0.5 else -1.0), rng.uniform(0, 2 * np.pi)
    pulse = speed / float(portable.hypot(half[0], 2 * half[1]))
    angle = pulse * (t - HOVER)
    u = np.clip((t - HOVER) / GROWING, 0, 1)
    grown = (u * u) ** 2 * (35 - 84 * u + 70 * u**2 - 20 * u * u * u)
    x, y = half[0] * portable.sin(angle), side * half[1] * portable.sin(2 * angle)
    path = middle + grown[:, None] * np.stack([x, y, -DIP * portable.cos(2 * angle)], axis=1)
    look = grown * LOOK * (portable.sin(0.9 * t + phase) - portable.sin(phase))
    flight = EightFlight(interpolating_spline(t, path), interpolating_spline(t, look), duration, swing)
    needed = float(np.linalg.norm(flight.position(t, nu=2) + UPWARDS, axis=1).max())
    if needed > limit:
        raise UsageError(
            f"eights at {speed:g} m/s need a thrust of {needed:.1f} m/s2, more than the {limit:g} allowed: use a lower --speed"
        )
    return flight
