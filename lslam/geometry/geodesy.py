"""Positions on the Earth in local frames: transverse Mercator at the first fix."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


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


def _projection(origin: NDArray[Any]) -> Any:
    from pyproj import Proj

    return Proj(local_crs(origin))
