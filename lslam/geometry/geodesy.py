"""Positions on the Earth in local frames: transverse Mercator at the first fix."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.geometry import se3, so3

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


def frame_change(old: NDArray[Any], new: NDArray[Any]) -> Floats:
    """(4, 4) from the local frame about `old` (3,) lat, lon (deg), height (m) to that about `new`, near both.

    Meridians converge: the norths of the two differ by a little turn about up.
    """
    at = to_local(np.asarray(new, np.float64)[None], old)[0]
    ahead = to_local(from_local(at[None] + [[0.0, 1000.0, 0.0]], old), new)[0]
    R = so3.exp(np.array([0.0, 0.0, np.arctan2(-ahead[0], ahead[1])]))
    return se3.make(R, -R @ at)


def _projection(origin: NDArray[Any]) -> Any:
    from pyproj import Proj

    return Proj(local_crs(origin))
