"""Boxes of latitude and longitude: about a place, about a path, and whether one contains another."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.errors import InputError, UsageError
from lslam.core.geometry.geodesy import from_local
from lslam.io.formats.geojson import read_line
from lslam.io.formats.stamped_csv import read_gnss_csv
from lslam.io.formats.trajectory_files import read_trajectory

METRES_PER_DEGREE = 111_320.0
DECIMALS = 6  # docs/conventions.md: a cached reply is found by the rounded box
LARGEST_KM2 = 600.0
OTHER_WAYS = "say where it is with --around LAT,LON or --bbox"


@dataclass(frozen=True)
class Bounds:
    """South, west, north, east in deg, WGS84, rounded to 6 decimals; west > east crosses the antimeridian.

    Raises UsageError when it is no box on the Earth, or too large for a request to a public server.
    """

    south: float
    west: float
    north: float
    east: float

    def __post_init__(self) -> None:
        for name in ("south", "west", "north", "east"):
            object.__setattr__(self, name, round(float(getattr(self, name)), DECIMALS) + 0.0)
        if not (-90 <= self.south < self.north <= 90 and abs(self.west) <= 180 and abs(self.east) <= 180):
            raise UsageError(f"{self} is no box SOUTH,WEST,NORTH,EAST in degrees, for example 49.00,8.40,49.01,8.42")
        if self.west == self.east:
            raise UsageError(f"{self} is a box without width")
        if self.area_km2 > LARGEST_KM2 and self.west > self.east:
            raise UsageError(
                f"{self} goes from west to east almost round the Earth: the order is SOUTH,WEST,NORTH,EAST"
            )
        if self.area_km2 > LARGEST_KM2:
            raise UsageError(
                f"{self} covers {self.area_km2:.0f} km2, public servers are asked for at most {LARGEST_KM2:.0f}: take "
                "a smaller box, or the region's file of download.geofabrik.de, cut out with osmium extract"
            )

    def __str__(self) -> str:
        return ",".join(f"{v:.{DECIMALS}f}" for v in (self.south, self.west, self.north, self.east))

    @property
    def width(self) -> float:
        """Degrees of longitude from west to east, also over the antimeridian."""
        return (self.east - self.west) % 360

    @property
    def area_km2(self) -> float:
        """Ground covered, km2, on a sphere."""
        height, middle = self.north - self.south, np.radians((self.north + self.south) / 2)
        return float(height * self.width * np.cos(middle) * (METRES_PER_DEGREE / 1000) ** 2)

    def holds(self, other: Bounds) -> bool:
        """True when `other` lies inside."""
        gap = (other.west - self.west) % 360
        return self.south <= other.south and other.north <= self.north and gap + other.width <= self.width + 1e-9

    def share_inside(self, lat_lon: NDArray[Any], margin: float) -> float:
        """Share of the positions (N, 2), deg, inside the box with a margin of `margin`, m; 1 without positions."""
        places = np.asarray(lat_lon, np.float64).reshape(-1, 2)
        if not len(places):
            return 1.0
        up = margin / METRES_PER_DEGREE
        aside = up / max(float(np.cos(np.radians(max(abs(self.south), abs(self.north))))), 1e-3)
        east = (places[:, 1] - self.west + aside) % 360
        inside = (places[:, 0] >= self.south - up) & (places[:, 0] <= self.north + up)
        return float(np.mean(inside & (east <= self.width + 2 * aside)))


def around(lat_lon: NDArray[Any], radius: float) -> Bounds:
    """The smallest box that contains the circles of `radius`, m, about the positions (N, 2), lat, lon in deg.

    Raises UsageError for positions off the Earth, and when the box would be too large.
    """
    places = np.asarray(lat_lon, np.float64).reshape(-1, 2)
    if not len(places) or not (np.isfinite(places).all() and (np.abs(places) <= [90, 180]).all()):
        raise UsageError("a place is LAT,LON in degrees, for example 49.0112,8.4229")
    if not 0 < radius < 1e5:
        raise UsageError(f"a radius of {radius:g} m makes no sense")
    up = radius / METRES_PER_DEGREE
    south, north = max(float(places[:, 0].min()) - up, -90.0), min(float(places[:, 0].max()) + up, 90.0)
    aside = up / max(float(np.cos(np.radians(max(abs(south), abs(north))))), 1e-3)
    first = places[0, 1]
    east = (places[:, 1] - first + 180) % 360 - 180
    sides = (first + east.min() - aside, first + east.max() + aside)
    west, east_side = ((side + 180) % 360 - 180 for side in sides)
    return Bounds(south, west, north, east_side)


def positions_along(what: str, data_root: Path | None = None, origin: NDArray[Any] | None = None) -> Floats:
    """(N, 2) lat, lon in deg, WGS84, of `what`: a run folder or GeoJSON line, fixes as CSV, a trajectory, or a sequence.

    A trajectory in metres (TUM, EuRoC, KITTI) is in a georeferenced world, x east and y north of `origin` (3,) lat, lon,
    height. The positions of a sequence are its satellite fixes.

    Raises InputError with the file's name when it has no positions on the Earth, UsageError when `origin` is missing.
    """
    path = Path(what)
    line = path / "trajectory.geojson" if path.is_dir() else path
    if line.is_file() and line.suffix.lower() in (".geojson", ".json"):
        return read_line(line)[:, :2]
    if path.is_file() and path.suffix.lower() == ".csv" and _names_latitude(path):
        return read_gnss_csv(path).lat_lon_alt[:, :2]
    if path.is_file() and path.suffix.lower() in (".tum", ".txt", ".csv"):
        if origin is None:
            raise UsageError(f"{path} is in metres: --origin LAT,LON says where its x = y = 0 lies, x east and y north")
        return np.asarray(from_local(read_trajectory(path).positions, origin)[:, :2])
    from lslam.io.readers import open_sequence

    gnss = open_sequence(what, data_root=data_root).gnss
    if gnss is None or not len(gnss):
        raise InputError(f"{what} has no satellite fixes: {OTHER_WAYS}")
    fixes = gnss.lat_lon_alt[:, :2]
    valid = np.isfinite(fixes).all(1) & (np.abs(fixes) <= [90, 180]).all(1) & fixes.any(1)
    if not valid.any():
        raise InputError(f"{what} has no satellite fix that is a place on the Earth: {OTHER_WAYS}")
    return np.asarray(fixes[valid])


def _names_latitude(path: Path) -> bool:
    """Whether the first line of a file contains `lat`: a header of fixes."""
    with path.open(errors="replace") as stream:
        return "lat" in stream.readline().lower()
