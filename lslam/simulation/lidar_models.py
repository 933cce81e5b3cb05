"""Spinning LiDARs by their data sheets."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lslam.errors import UsageError, nearest

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class LidarModel:
    """A LiDAR that turns `columns` times a revolution and fires one ray per ring each time.

    elevations_deg : of each ring, from the top ring (0) downwards; columns : firings per revolution
    range_min, range_max : m; range_noise : standard deviation, m; range_step : resolution, m
    angle_noise_deg : standard deviation of azimuth and elevation
    range_10pct : m at which a surface of 10 % reflectivity, met squarely, is seen 94 % of the time
    dropout : share of returns lost for no reason; order : of the points, ring after ring or column after column
    start_deg : azimuth of the first column, 0 forward, counter-clockwise; clockwise : sense of turning, from above
    """

    name: str
    elevations_deg: tuple[float, ...]
    columns: int
    range_min: float
    range_max: float
    range_noise: float
    range_step: float
    angle_noise_deg: float
    range_10pct: float
    dropout: float
    order: Literal["ring", "column"] = "ring"
    start_deg: float = 0.0
    clockwise: bool = False

    @property
    def rings(self) -> int:
        """Number of rings."""
        return len(self.elevations_deg)

    @property
    def rays(self) -> int:
        """Rays per revolution."""
        return self.rings * self.columns

    @cached_property
    def angles(self) -> tuple[Floats, Floats]:
        """Azimuth (columns,) and elevation (rings,), rad."""
        turn = 2 * np.pi * np.arange(self.columns) / self.columns
        azimuth = np.radians(self.start_deg) + (-turn if self.clockwise else turn)
        return azimuth, np.radians(np.array(self.elevations_deg))


def _even(top_deg: float, bottom_deg: float, count: int) -> tuple[float, ...]:
    return tuple(float(e) for e in np.linspace(top_deg, bottom_deg, count))


LIDARS = {
    model.name: model
    for model in (
        # Small on purpose: 6,400 rays, the sensor of sample_data.
        LidarModel("sample", _even(25.0, -20.0, 16), 400, 0.9, 80.0, 0.015, 0.005, 0.01, 45.0, 0.03),
        LidarModel("vlp16", _even(15.0, -15.0, 16), 1800, 0.5, 100.0, 0.015, 0.002, 0.01, 50.0, 0.02, "column", 0.0, True),
        # KITTI's sensor: 32 lasers 1/3 deg apart above 32 lasers 1/2 deg apart; points ring after ring, from ahead to the left.
        LidarModel(
            "hdl64", (*_even(2.0, -8.33, 32), *_even(-8.83, -24.33, 32)), 2000, 0.9, 120.0, 0.02, 0.002, 0.01, 50.0, 0.03,
        ),
        LidarModel(
            "os1-32", _even(22.5, -22.5, 32), 1024, 0.3, 100.0, 0.03, 0.01, 0.01, 45.0, 0.02, "column", 180.0, True
        ),
    )
}  # fmt: skip


def lidar_named(name: str) -> LidarModel:
    """The ready model called `name`. Raises UsageError naming the nearest one."""
    if name not in LIDARS:
        raise UsageError(f"no LiDAR {name!r}; {nearest(name, LIDARS)}")
    return LIDARS[name]
