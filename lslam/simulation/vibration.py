"""A LiDAR that shakes on its mount: small, quick turns and lifts that its rays feel and nothing else knows of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from lslam.config.section import Section
from lslam.geometry import se3, so3

Floats = NDArray[np.float64]

SINES = 12  # on each axis


class Vibration(Section):
    """Shaking of the LiDAR on its mount, in its rays and not in the truth.

    angle_deg, height_mm : root mean square of roll, pitch and yaw each, and up and down; band_hz : lowest and highest frequency
    """

    angle_deg: float = Field(0.0, ge=0, le=2)
    height_mm: float = Field(0.0, ge=0, le=50)
    band_hz: tuple[float, float] = (8.0, 25.0)

    @model_validator(mode="after")
    def _band_is_ordered(self) -> Vibration:
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
        return np.asarray(np.sin(angle).sum(axis=2) * self.amplitudes)

    def shaken(self, poses: NDArray[Any], times: NDArray[Any]) -> Floats:
        """Poses (M, 4, 4), or one (4, 4), of a LiDAR at rest on its mount as they are at `times` (M,), s: (M, 4, 4)."""
        off = self.at(times)
        lift = np.column_stack([np.zeros((len(off), 2)), off[:, 3]])
        return np.asarray(np.asarray(poses, np.float64) @ se3.make(so3.exp(off[:, :3]), lift))


def shaking(vibration: Vibration, rng: np.random.Generator) -> Shaking | None:
    """The shaking of one drive; None when there is none."""
    if not (vibration.angle_deg or vibration.height_mm):
        return None
    rms = np.array([*[np.radians(vibration.angle_deg)] * 3, vibration.height_mm * 1e-3])
    # A sine's root mean square is its amplitude over sqrt(2); independent ones add up in squares.
    shape = (4, SINES)
    frequencies, phases = rng.uniform(*vibration.band_hz, shape), rng.uniform(0, 2 * np.pi, shape)
    return Shaking(rms * np.sqrt(2 / SINES), frequencies, phases)
