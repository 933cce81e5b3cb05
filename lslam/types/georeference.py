"""Where the world of a run lies on the Earth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Georeference:
    """From the coordinates of a run's trajectory and map to the Earth.

    origin : (3,) lat, lon (deg), height (m), WGS84, of the local frame: east, north, up in m on the transverse Mercator
        projection there with scale 1 (`geometry.geodesy`)
    T_enu_world : (4, 4) from the run's world into that frame; the identity when the run's world is that frame
    epsg : the code outputs are to be written in; None leaves it to the writer, which takes the UTM zone of the origin
    method : `fit` one rigid transform of the finished trajectory to all fixes; `graph` fixes were factors; `osm` the
        buildings of OpenStreetMap were
    fixes, used : fixes that were given, and the inliers
    rmse_horizontal, rmse_vertical : m, of the inliers against the trajectory's antenna
    """

    origin: NDArray[np.float64]
    T_enu_world: NDArray[np.float64]
    epsg: int | None = None
    method: Literal["fit", "graph", "osm"] = "fit"
    fixes: int = 0
    used: int = 0
    rmse_horizontal: float = float("nan")
    rmse_vertical: float = float("nan")
