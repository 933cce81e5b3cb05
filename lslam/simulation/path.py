"""Motion of a vehicle, a walker or a drone along a curve by a speed profile, over the ground or at heights; poses are exact."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.errors import UsageError
from lslam.core.geometry import portable, se3, so3
from lslam.simulation.curve import RouteCurve, Terrain, flat, gaussian_smooth, interpolating_spline


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
class Swing:
    """Sines over time on the axes of a carried sensor, in its own frame: K of them on each of A axes, m and rad.

    amplitudes, phases : (K, A); frequencies : (K, A), or (K, 1) of all axes, Hz
    """

    amplitudes: Floats
    frequencies: Floats
    phases: Floats

    def at(self, times: NDArray[Any]) -> Floats:
        """(M, A) displacements at `times` (M,), s."""
        angle = 2 * np.pi * np.asarray(times)[:, None, None] * self.frequencies + self.phases
        return np.asarray(np.sum(self.amplitudes * portable.sin(angle), axis=1))


def suspension(rng: np.random.Generator, angle_deg: float = 0.15, heave: float = 0.004) -> Swing:
    """Roll, pitch (rad) and heave (m) of a car on its springs: three sines of 0.6 to 2.2 Hz on each axis."""
    amplitudes = rng.uniform(0.3, 1.0, (3, 3)) * [np.radians(angle_deg), np.radians(angle_deg), heave]
    phases = rng.uniform(0, 2 * np.pi, (3, 3))
    return Swing(amplitudes, rng.uniform(0.6, 2.2, (3, 1)), phases)


@dataclass(frozen=True)
class VehiclePath:
    """A LiDAR `height` m above the ground on a vehicle that follows `curve`.

    distance : distance along the curve, a smooth function of s; duration : s, range of that function
    """

    curve: RouteCurve
    terrain: Terrain
    distance: Any
    duration: float
    height: float
    shaking: Swing

    def poses(self, times: NDArray[Any]) -> Floats:
        """(M, 4, 4) exact T_city_lidar at `times` (M,), s since the start."""
        times = np.asarray(times, np.float64)
        s = np.asarray(self.distance(times))
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
    curve: RouteCurve, terrain: Terrain, speed: SpeedProfile, distance: float, height: float, shaking: Swing
) -> VehiclePath:
    """Path along `distance` m of `curve`, in laps on a closed one, by the speed profile; height : of the LiDAR, m."""
    s = np.linspace(0, distance, int(np.ceil(distance / 0.25)) + 1)
    v = _speeds(curve, s, speed)
    t = np.concatenate([[0.0], np.cumsum(2 * np.diff(s) / (v[:-1] + v[1:]))])
    times, travelled = _ease(t, s, v, speed.easing if speed.start > 0 else -speed.easing)
    duration = float(np.interp(distance, travelled, times))
    return VehiclePath(curve, terrain, interpolating_spline(times, travelled), duration, height, shaking)


def _speeds(curve: RouteCurve, s: Floats, speed: SpeedProfile) -> Floats:
    """Speed at each distance s (N,), m, in m/s: `speed`, lower in bends, with bounded acceleration and braking."""
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


GRAVITY = 9.81  # m/s2, for the bank of a turn


def gait(rng: np.random.Generator, strength: float = 1.0) -> Swing:
    """Motion of a hand-held sensor at a walk: steps of 1.9 Hz, sways of half that, and yaw to both sides at up to 150 deg/s.

    The axes are x, y, z (m), roll, pitch and yaw (rad); strength : factor on all.
    Two slow yaw oscillations of similar frequency alternate between looking about and looking ahead.
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
    """A drone in light wind: centimetres and a degree or so at 0.2 to 1.5 Hz; more with `strength`. Axes as of `gait`."""
    size = np.array([0.05, 0.05, 0.04, *np.radians([0.8, 0.8, 1.0])]) * strength
    frequencies = np.stack([rng.uniform(0.2, 0.5, 6), rng.uniform(0.6, 1.5, 6)])
    return Swing(size * np.array([[1.0], [0.35]]), frequencies, rng.uniform(0, 2 * np.pi, (2, 6)))


@dataclass(frozen=True)
class FreePath:
    """Path of a LiDAR along `curve`, carried by a drone or a walker.

    distance : horizontal distance over time, a spline; duration : s it is defined for
    climb : height over distance, a spline as of `climb_spline`, m above level ground or, when `terrain` is given, that ground
    bank : share of the tilt that balances the turn, 1 for a coordinated one; swing : motion added to it
    """

    curve: RouteCurve
    distance: Any
    duration: float
    climb: Any
    bank: float
    swing: Swing
    terrain: Terrain | None = None

    def poses(self, times: NDArray[Any]) -> Floats:
        """(M, 4, 4) exact T_city_lidar at `times` (M,), s since the start."""
        times = np.asarray(times, np.float64)
        s = np.asarray(self.distance(times))
        speed, gain = np.asarray(self.distance(times, nu=1)), np.asarray(self.distance(times, nu=2))
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
        z = gaussian_smooth(z[:-1], sigma, "wrap")
        z = np.append(z, z[0])
    else:
        # Mirroring the differences keeps the ends and a constant slope.
        reach = min(int(np.ceil(4 * sigma)), len(z) - 1)
        z = np.concatenate([2 * z[0] - z[reach:0:-1], z, 2 * z[-1] - z[-2 : -reach - 2 : -1]])
        z = gaussian_smooth(z, sigma)[reach:-reach]
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
    """Path along `distance` m of `curve`; speed counts along its mean slope. bank : share of the tilt that balances a turn."""
    rise = float(climb(curve.length) - climb(0.0))
    level = curve.length / float(portable.hypot(curve.length, rise))
    pace = replace(speed, cruise=speed.cruise * level, start=speed.start * level)
    still = suspension(np.random.default_rng(0), 0.0, 0.0)
    timed = drive(curve, flat(), pace, distance, 0.0, still)
    return FreePath(curve, timed.distance, timed.duration, climb, bank, swing, terrain)


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
