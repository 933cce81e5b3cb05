"""Where a recording or a trajectory lies on the Earth, so that the buildings round it can be fetched."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError, UsageError
from lslam.formats.geojson import read_line
from lslam.formats.stamped_csv import read_gnss_csv
from lslam.formats.trajectory_files import read_trajectory
from lslam.geometry.geodesy import from_local

OTHER_WAYS = "say where it is with --around LAT,LON or --bbox"


def positions_along(
    what: str, data_root: Path | None = None, origin: NDArray[Any] | None = None
) -> NDArray[np.float64]:
    """(N, 2) lat, lon in deg, WGS84, of `what`: a run folder or GeoJSON line, fixes as CSV, a trajectory, or a sequence.

    A trajectory in metres (TUM, EuRoC, KITTI) has to be that of a georeferenced world, x east and y north of `origin`
    (3,) lat, lon, height; of a sequence its satellite fixes are taken.

    Raises InputError naming the file when it says no place, UsageError when `origin` is needed.
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
    from lslam.readers import open_sequence

    gnss = open_sequence(what, data_root=data_root).gnss
    if gnss is None or not len(gnss):
        raise InputError(f"{what} has no satellite fixes: {OTHER_WAYS}")
    fixes = gnss.lat_lon_alt[:, :2]
    valid = np.isfinite(fixes).all(1) & (np.abs(fixes) <= [90, 180]).all(1) & fixes.any(1)
    if not valid.any():
        raise InputError(f"{what} has no satellite fix that is a place on the Earth: {OTHER_WAYS}")
    return np.asarray(fixes[valid])


def _names_latitude(path: Path) -> bool:
    with path.open(errors="replace") as stream:
        return "lat" in stream.readline().lower()
