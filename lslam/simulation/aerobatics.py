"""How a racing quadrotor flies: eights in the air, tilted as its thrust needs, from a hover."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.errors import UsageError
from lslam.geometry import portable, se3, so3
from lslam.simulation.flight import GRAVITY, Swing
from lslam.simulation.splines import interpolating_spline

Floats = NDArray[np.float64]

HOVER = 2.0  # s before it moves
GROWING = 2.5  # s until the eights are as large as they get
VIOLENT = 10.0  # s of them after that
HALF = np.array([10.0, 4.2])  # m, of an eight along the hall and across
DIP = 1.05  # m up and down: through the middle it swoops, or its thrust would vanish where the eight straightens
LOOK = 0.6  # rad, by which it looks to both sides
UPWARDS = np.array([0.0, 0.0, GRAVITY])
STEP = 0.01  # s between the knots of its spline


@dataclass(frozen=True)
class EightFlight:
    """A LiDAR on a quadrotor whose thrust is along its z axis; what it flies is a function of time alone.

    position : spline of T_city_lidar's origin over s; its second derivative says how it is tilted (Mellinger and Kumar 2011)
    heading : spline of the direction in which it looks, rad; duration : s, from 0
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
    """Hover at `middle` (3,), then fly eights round it, at most at `speed` m/s.

    Raises UsageError where that needs more than `limit` m/s2 of thrust.
    """
    duration = HOVER + GROWING + VIOLENT
    t = np.arange(0.0, duration + 6 * STEP, STEP)
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
