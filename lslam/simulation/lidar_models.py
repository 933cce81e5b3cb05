"""LiDAR models by their data sheets: spinning ones, and one with a non-repetitive pattern."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from lslam.core.arrays import Floats
from lslam.core.config.input import Section
from lslam.core.errors import UsageError, nearest
from lslam.core.geometry import portable, se3, so3


@dataclass(frozen=True)
class Rosette:
    """Two counter-rotating prisms whose pattern never closes: every scan covers a little more of the view.

    half_view_deg : from the middle to the rim; turns : of the two prisms per scan, incommensurable
    """

    half_view_deg: float
    turns: tuple[float, float]

    def beams(self, index: int, columns: int, lines: Floats) -> tuple[Floats, Floats]:
        """Azimuth and elevation (columns, rings) of scan `index`, rad; `lines` (rings,) fan out upright."""
        scans = index + np.arange(columns) / columns
        a, b = (2 * np.pi * np.mod(scans * turns, 1.0) for turns in self.turns)
        half = np.radians(self.half_view_deg) / 2
        azimuth = half * (portable.cos(a) + portable.cos(b))
        elevation = half * (portable.sin(a) + portable.sin(b))
        return np.broadcast_to(azimuth[:, None], (columns, len(lines))), elevation[:, None] + lines


@dataclass(frozen=True)
class LidarModel:
    """A LiDAR that fires `columns` times per scan, one ray per ring each time, evenly round its axis.

    elevations_deg : of each ring, from the top ring (0) downwards; columns : firings per scan, a revolution
    range_min, range_max : m; range_noise : standard deviation, m; range_step : resolution, m
    angle_noise_deg : standard deviation of azimuth and elevation
    range_10pct : m at which a surface of 10 % reflectivity, at normal incidence, is detected in 94 % of cases
    dropout : share of returns lost for no reason; order : of the points, ring after ring or column after column
    start_deg : azimuth of the first column, 0 forward, counter-clockwise; clockwise : sense of turning, from above
    rosette : if set, the LiDAR does not spin but looks forward through two rotating prisms
    ring_bias, ring_tilt_deg : standard deviations over the rings of calibration errors: range, m, and elevation
    firing_us : microseconds from the start of a column until each ring fires, shorter than a column lasts; empty: all at once
    ring_heights : m of each laser above the LiDAR's origin; empty: all rays leave from there
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
    rosette: Rosette | None = None
    ring_bias: float = 0.0
    ring_tilt_deg: float = 0.0
    firing_us: tuple[float, ...] = ()
    ring_heights: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for name in ("firing_us", "ring_heights"):
            given = len(getattr(self, name))
            if given not in (0, self.rings):
                raise ValueError(f"{name} of {self.name!r}: {given} values for {self.rings} rings")

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

    @cached_property
    def firing(self) -> Floats:
        """(rings,) s from the start of a column until each ring fires."""
        return np.array(self.firing_us) * 1e-6 if self.firing_us else np.zeros(self.rings)

    @cached_property
    def heights(self) -> Floats:
        """(rings,) m of each laser above the LiDAR's origin."""
        return np.array(self.ring_heights) if self.ring_heights else np.zeros(self.rings)

    @cached_property
    def sequence(self) -> NDArray[np.intp]:
        """(rays,) the order in which points are reported, as indices of rays counted column after column, ring after ring."""
        if self.order == "ring":
            return np.arange(self.rays).reshape(self.columns, self.rings).T.ravel()
        # A column comes as it is fired.
        fired = np.argsort(self.firing, kind="stable")
        return np.asarray((np.arange(self.columns)[:, None] * self.rings + fired).ravel())

    @cached_property
    def ring_errors(self) -> tuple[Floats, Floats]:
        """Constant calibration errors of each ring: range (rings,), m, and elevation (rings,), rad."""
        bias, tilt = np.random.default_rng(self.rings).standard_normal((2, self.rings))
        return self.ring_bias * bias, np.radians(self.ring_tilt_deg) * tilt

    def beams(self, index: int, period: float = 0.1) -> tuple[Floats, Floats]:
        """Azimuth and elevation of every ray of scan `index`, which lasts `period` s: rad, broadcasting to (columns, rings)."""
        if self.rosette is not None:
            return self.rosette.beams(index, self.columns, np.radians(np.array(self.elevations_deg)))
        azimuth, elevation = self.angles
        # It turns on while one ring fires after the other.
        turned = (-2 if self.clockwise else 2) * np.pi / period * self.firing
        return azimuth[:, None] + turned, elevation


# A VLP-16 fires every 2.304 us (manual, "firing sequence"): -15, 1, -13, 3 ... -1, 15 deg; rings here run from the top.
_VLP16_FIRING = tuple(2.304 * (15 - 2 * k if k < 8 else 2 * (15 - k)) for k in range(16))
# An HDL-64E fires one laser of its upper and one of its lower block at once, every 0.728 us (S2 manual, appendix G: 23.3 us
# for a block). Which laser looks where differs from unit to unit: taken as from the top down.
_HDL64_FIRING = tuple(0.728 * (k % 32) for k in range(64))
# Of the unit on KITTI's car: every ring of its recordings fits one elevation and one height of its laser to better than 0.1 deg.
_KITTI_DEG = (
    2.14, 1.78, 1.51, 1.08, 0.78, 0.39, 0.12, -0.25,
    -0.60, -1.00, -1.29, -1.63, -2.00, -2.34, -2.67, -3.03,
    -3.33, -3.73, -4.01, -4.38, -4.71, -5.05, -5.41, -5.75,
    -6.12, -6.47, -6.79, -7.08, -7.47, -7.85, -8.11, -8.51,
    -8.82, -9.37, -9.86, -10.27, -10.75, -11.39, -11.91, -12.36,
    -12.84, -13.28, -13.84, -14.39, -14.98, -15.45, -15.97, -16.35,
    -16.98, -17.53, -18.12, -18.59, -19.12, -19.53, -20.02, -20.58,
    -21.11, -21.73, -22.23, -22.65, -23.12, -23.77, -24.30, -24.79,
)  # fmt: skip
_KITTI_HEIGHTS = (0.21,) * 10 + (0.20,) * 22 + (0.12,) * 32


def _even(top_deg: float, bottom_deg: float, count: int) -> tuple[float, ...]:
    """Elevations, deg, of `count` evenly spaced rings."""
    return tuple(float(e) for e in np.linspace(top_deg, bottom_deg, count))


LIDARS = {
    model.name: model
    for model in (
        # Small on purpose: 6,400 rays, the sensor of sample_data.
        LidarModel("sample", _even(25.0, -20.0, 16), 400, 0.9, 80.0, 0.015, 0.005, 0.01, 45.0, 0.03),
        LidarModel(
            "vlp16", _even(15.0, -15.0, 16), 1800, 0.5, 100.0, 0.015, 0.002, 0.01, 50.0, 0.02, "column", 0.0, True,
            firing_us=_VLP16_FIRING,
        ),
        # KITTI's sensor: 32 lasers 1/3 deg apart above 32 lasers 1/2 deg apart; points ring after ring, from ahead to the left.
        LidarModel(
            "hdl64", (*_even(2.0, -8.33, 32), *_even(-8.83, -24.33, 32)), 2000, 0.9, 120.0, 0.02, 0.002, 0.01, 50.0, 0.03,
            firing_us=_HDL64_FIRING,
        ),
        # As its recordings show it: up to 2,170 returns in a ring, roads seen to 50 m.
        LidarModel(
            "hdl64-kitti", _KITTI_DEG, 2170, 0.9, 120.0, 0.02, 0.002, 0.01, 45.0, 0.015,
            ring_bias=0.012, ring_tilt_deg=0.03, firing_us=_HDL64_FIRING, ring_heights=_KITTI_HEIGHTS,
        ),
        LidarModel(
            "os1-16", _even(22.5, -22.5, 16), 1024, 0.3, 100.0, 0.03, 0.01, 0.01, 45.0, 0.02, "column", 180.0, True,
            ring_bias=0.01, ring_tilt_deg=0.02,
        ),
        LidarModel(
            "os1-32", _even(22.5, -22.5, 32), 1024, 0.3, 100.0, 0.03, 0.01, 0.01, 45.0, 0.02, "column", 180.0, True,
            ring_bias=0.01, ring_tilt_deg=0.02,
        ),
        LidarModel(
            "os1-64", _even(22.5, -22.5, 64), 1024, 0.3, 100.0, 0.03, 0.01, 0.01, 45.0, 0.02, "column", 180.0, True,
            ring_bias=0.01, ring_tilt_deg=0.02,
        ),
        # Like an Avia: 240,000 rays/s in six lines through a round view of 70 degrees. Its prisms turn like a Mid-40's, at 7294
        # and -4664 per minute (Brazeal, Wilkinson and Hochmair 2021): shots of a line are half a degree apart at most.
        LidarModel(
            "livox", _even(0.7, -0.7, 6), 4000, 1.0, 190.0, 0.02, 0.01, 0.05, 90.0, 0.02, "column",
            rosette=Rosette(35.2, (12.157, -7.773)),
        ),
    )
}  # fmt: skip


class LidarMount(Section):
    """Further LiDAR on the vehicle, placed in the frame of the leading one.

    name : of its folder; lidar : a name of `LIDARS`, by default the leading one's
    place : x, y, z, m; rpy_deg : roll, pitch, yaw; offset_ms : its sweeps begin so much after those of the leading one
    """

    name: str = Field(pattern=r"^[A-Za-z][A-Za-z0-9_-]*$")
    lidar: str | None = None
    place: tuple[float, float, float]
    rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    offset_ms: float = Field(0.0, ge=0)

    @property
    def T_lidar_other(self) -> Floats:
        """(4, 4) transform from its frame to that of the leading LiDAR, m."""
        return se3.make(so3.from_euler_rpy(np.radians(self.rpy_deg)), np.array(self.place))


def find_lidar(name: str) -> LidarModel:
    """Model called `name`. Raises UsageError naming the nearest one."""
    if name not in LIDARS:
        raise UsageError(f"no LiDAR {name!r}; {nearest(name, LIDARS)}")
    return LIDARS[name]
