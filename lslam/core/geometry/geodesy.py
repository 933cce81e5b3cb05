"""Positions on the Earth: local frames, transverse Mercator at the first fix, and exact operations between coordinates."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.errors import UsageError
from lslam.core.geometry import se3, so3
from lslam.core.geometry.crs_names import crs_name

# deg; about the places for which an operation is chosen.
MARGIN_DEG = 0.01


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


def installed_grids() -> dict[str, Any]:
    """PROJ on this machine: version, folders, whether it may use the network, and installed grids by purpose.

    `vertical` are grids of heights by PROJ's database, `others` those of positions and unlisted ones.
    """
    import sqlite3
    from contextlib import closing

    import pyproj
    import pyproj.network

    stubs: Any = pyproj  # two of these names are missing in its own
    folders = [Path(text) for text in pyproj.datadir.get_data_dir().split(os.pathsep)]
    folders.append(Path(stubs.datadir.get_user_data_dir()))
    found = {file.name for folder in folders for file in folder.glob("*") if file.suffix in (".tif", ".gtx", ".gsb")}
    database = next((folder / "proj.db" for folder in folders if (folder / "proj.db").is_file()), None)
    of_heights: set[str] = set()
    if database is not None:
        query = (
            "SELECT proj_grid_name, old_proj_grid_name FROM grid_alternatives "
            "WHERE proj_method IN ('geoid_like', 'vgridshift')"
        )
        with closing(sqlite3.connect(f"{database.as_uri()}?mode=ro", uri=True)) as known:
            of_heights = {name for row in known.execute(query) for name in row}
    return {
        "version": pyproj.proj_version_str,
        "folders": [str(folder) for folder in folders],
        "network": stubs.network.is_network_enabled(),
        "vertical": sorted(found & of_heights),
        "others": sorted(found - of_heights),
    }


def crs_of(epsg: int, height_epsg: int | None = None) -> Any:
    """pyproj's `CRS` of these codes; raises UsageError for codes that PROJ does not know."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    name = crs_name(epsg, height_epsg)
    try:
        return CRS.from_user_input(name)
    except CRSError:
        raise UsageError(f"--crs {name}: PROJ knows no such coordinate reference system") from None


def has_heights(crs: Any) -> bool:
    """Whether a coordinate reference system has a vertical datum of its own, so that heights need a geoid."""
    from pyproj import CRS

    return isinstance(crs, CRS) and bool(crs.is_compound)


def exact_transformer(source: Any, target: Any, lat_lon: NDArray[Any], name: str) -> Any:
    """pyproj's most accurate transformer between two coordinate reference systems at positions (N, 2) lat, lon, deg.

    It takes and gives easting or longitude first. Ballpark operations, which ignore the geoid, are never used, nor is a coarser
    one if the best lacks a grid. Raises UsageError, which begins with `name`, for a lacking grid and where there is none.
    """
    from pyproj.aoi import AreaOfInterest
    from pyproj.transformer import TransformerGroup

    places = np.asarray(lat_lon, np.float64).reshape(-1, lat_lon.shape[-1])
    (south, west), (north, east) = places[:, :2].min(axis=0) - MARGIN_DEG, places[:, :2].max(axis=0) + MARGIN_DEG
    area: Any = AreaOfInterest(max(west, -180.0), max(south, -90.0), min(east, 180.0), min(north, 90.0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        group = TransformerGroup(source, target, always_xy=True, area_of_interest=area, allow_ballpark=False)
    best = group.transformers[0] if group.transformers else None
    grids = _missing_grids(group.unavailable_operations, None if best is None else best.accuracy)
    if grids:
        is_vertical = has_heights(source) or has_heights(target)
        coarser = "" if best is None or is_vertical else f", without which it is accurate to {best.accuracy:g} m"
        way_out = (
            "or name one with --geoid" if is_vertical else "or choose a plane that needs none, as that of a UTM zone"
        )
        raise UsageError(f"{name}: PROJ lacks the grid {' and '.join(grids)}{coarser}: {_how_to_get(grids)}, {way_out}")
    if best is None and not (has_heights(source) or has_heights(target)):
        raise UsageError(
            f"{name}: PROJ knows no operation at {places[0, 0]:.2f}, {places[0, 1]:.2f} deg: it is a plane of another place, "
            "or easting does not come first; choose one that covers it, as that of a UTM zone"
        )
    if best is None:
        raise UsageError(
            f"{name}: PROJ knows no exact operation between the WGS84 ellipsoid and its heights: name a grid of its geoid "
            "with --geoid, or a plane without heights"
        )
    return best


def geoid_heights(geoid: str, lat_lon: NDArray[Any]) -> Floats:
    """(N,) m, heights of the geoid above the WGS84 ellipsoid at (N, 2) lat, lon, deg, by a grid file (GTX, GeoTIFF).

    Raises UsageError when PROJ cannot read it, or outside of its area.
    """
    from pyproj import Transformer
    from pyproj.exceptions import ProjError

    places = np.asarray(lat_lon, np.float64).reshape(-1, np.shape(lat_lon)[-1])
    path = Path(geoid).expanduser()
    grid = str(path.absolute()) if path.exists() else geoid
    units = "+step +proj=unitconvert +xy_in={} +xy_out={}"
    shift = f'+step +proj=vgridshift +grids="{grid}" +multiplier=1'
    try:
        transformer = Transformer.from_pipeline(
            " ".join(["+proj=pipeline", units.format("deg", "rad"), shift, units.format("rad", "deg")])
        )
    except ProjError:
        raise UsageError(
            f"--geoid {geoid}: PROJ cannot read it as a grid of heights (GTX or GeoTIFF, undulation in m, deg)"
        ) from None
    heights = transformer.transform(places[:, 1], places[:, 0], np.zeros(len(places)))[2]
    outside = np.flatnonzero(~np.isfinite(heights))
    if len(outside):
        lat, lon = places[outside[0], :2]
        raise UsageError(f"--geoid {geoid} has no height at {lat:.4f}, {lon:.4f} deg: it is a grid of another place")
    return np.asarray(heights, np.float64)


def _missing_grids(operations: Any, accuracy: float | None) -> list[str]:
    """Names of the grids that the best of the unavailable operations lacks, where it is better than `accuracy`, m."""
    for operation in operations:
        lacking = [grid for grid in operation.grids if not grid.available]
        is_better = accuracy is None or (operation.accuracy >= 0 and (accuracy < 0 or operation.accuracy < accuracy))
        if is_better and lacking and all(grid.direct_download for grid in lacking):
            return [grid.short_name for grid in lacking]
    return []


def _how_to_get(grids: list[str]) -> str:
    """The commands that install the grids, for a message."""
    files = " and ".join(f"`pyproj sync --file {grid}`" for grid in grids)
    return f"get it by {files} (or projsync), or let PROJ fetch it with PROJ_NETWORK=ON"


def _projection(origin: NDArray[Any]) -> Any:
    """pyproj's `Proj` of the local frame about `origin`."""
    from pyproj import Proj

    return Proj(local_crs(origin))
