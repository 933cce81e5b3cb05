"""Satellite position fixes, and where the world of a run lies on the Earth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from lslam.core.arrays import Bools, Floats, Longs


@dataclass(frozen=True)
class GnssStream:
    """Fixes of a receiver: stamps (M,) int64, WGS84 (M, 3), deg, deg, m, and one sigma (M,), m."""

    stamps_ns: Longs
    lat_lon_alt: Floats
    sigma: Floats

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def is_place(self) -> Bools:
        """(M,) whether each fix is a place on the Earth; receivers without one write zeros."""
        lat, lon = self.lat_lon_alt[:, 0], self.lat_lon_alt[:, 1]
        finite = np.isfinite(self.lat_lon_alt).all(axis=1)
        return np.asarray(finite & (np.abs(lat) <= 90) & (np.abs(lon) <= 180) & ((lat != 0) | (lon != 0)))


@dataclass(frozen=True)
class OutputCrs:
    """Coordinates that a map is asked for in; what is None or empty stays as the run has it, as `Georeference` names them."""

    epsg: int | None = None
    height_epsg: int | None = None
    geoid: str = ""


@dataclass(frozen=True)
class Georeference:
    """From the coordinates of a run's trajectory and map to the Earth.

    origin : (3,) lat, lon (deg), height (m), WGS84, of the local frame: east, north, up in m on the transverse Mercator
        projection there with scale 1 (`geometry.geodesy`)
    T_enu_world : (4, 4) from the run's world into that frame; the identity when the run's world is that frame
    epsg : the code outputs are to be written in; None leaves it to the writer, which takes the UTM zone of the origin
    height_epsg : code of their vertical coordinate reference system, None for that of `epsg`, which may have none
    geoid : grid of a geoid above which their heights are, empty for none
    method : `fit` one rigid transform of the finished trajectory to all fixes; `graph` fixes were factors; `osm` the
        buildings of OpenStreetMap were, `control` surveyed points
    fixes, used : fixes that were given, and the inliers
    rmse_horizontal, rmse_vertical : m, of the inliers against the trajectory's antenna
    """

    origin: Floats
    T_enu_world: Floats
    epsg: int | None = None
    method: Literal["fit", "graph", "osm", "control"] = "fit"
    fixes: int = 0
    used: int = 0
    rmse_horizontal: float = float("nan")
    rmse_vertical: float = float("nan")
    height_epsg: int | None = None
    geoid: str = ""

    @property
    def is_in_graph(self) -> bool:
        """Whether factors of the pose graph made the run's world that frame."""
        return self.method != "fit"
