"""Positions on the Earth in local frames: transverse Mercator at the first fix, and the KITTI devkit's own projection."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# The sphere of the KITTI devkit (convertOxtsToPose.m).
_DEVKIT_RADIUS = 6378137.0


def local_crs(lat_lon: NDArray[Any]) -> str:
    """PROJ string of the transverse Mercator projection with scale 1 at (lat, lon), deg, WGS84."""
    lat, lon = (float(v) for v in np.asarray(lat_lon)[:2])
    return f"+proj=tmerc +lat_0={lat!r} +lon_0={lon!r} +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs"


def to_local(lat_lon_alt: NDArray[Any], origin: NDArray[Any]) -> Floats:
    """(N, 3) lat, lon (deg), height (m), WGS84, to (N, 3) east, north, up in m from `origin` (3,).

    x and y are the transverse Mercator projection at the origin (k = 1), z is the difference of heights (docs/conventions.md).
    """
    fixes = np.asarray(lat_lon_alt, np.float64).reshape(-1, 3)
    x, y = _projection(origin)(fixes[:, 1], fixes[:, 0])
    return np.column_stack([x, y, fixes[:, 2] - float(np.asarray(origin)[2])])


def from_local(enu: NDArray[Any], origin: NDArray[Any]) -> Floats:
    """The inverse of `to_local`: (N, 3) m to (N, 3) lat, lon (deg), height (m)."""
    points = np.asarray(enu, np.float64).reshape(-1, 3)
    lon, lat = _projection(origin)(points[:, 0], points[:, 1], inverse=True)
    return np.column_stack([lat, lon, points[:, 2] + float(np.asarray(origin)[2])])


def to_kitti_mercator(lat_lon_alt: NDArray[Any], origin: NDArray[Any]) -> Floats:
    """(N, 3) lat, lon (deg), height (m) to (N, 3) m as KITTI's devkit does (spherical Mercator, scale cos(lat0)).

    It is off by +0.11 % northwards and -0.19 % eastwards at Karlsruhe: only for agreement with official KITTI poses.
    """
    fixes = np.asarray(lat_lon_alt, np.float64).reshape(-1, 3)

    def project(values: Floats) -> Floats:
        x = scale * _DEVKIT_RADIUS * np.radians(values[:, 1])
        y = scale * _DEVKIT_RADIUS * np.log(np.tan(np.radians(90 + values[:, 0]) / 2))
        return np.column_stack([x, y, values[:, 2]])

    first = np.asarray(origin, np.float64).reshape(1, 3)
    scale = float(np.cos(np.radians(first[0, 0])))
    return np.asarray(project(fixes) - project(first))


def _projection(origin: NDArray[Any]) -> Any:
    from pyproj import Proj

    return Proj(local_crs(origin))
