"""Way-points from files: TOML, CSV, GeoJSON, or the shape of a trajectory."""

from __future__ import annotations

import csv
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.errors import InputError, cause, nearest
from lslam.core.geometry import portable
from lslam.core.geometry.geodesy import to_local
from lslam.core.types.arrays import Floats
from lslam.core.untrusted import MISFIT, parse_json, parse_toml
from lslam.io.formats.trajectory_files import read_trajectory

APART = 3.0  # m between the way-points taken from a trajectory
LONGEST = 50_000.0  # m between neighbours


@dataclass(frozen=True)
class WayPoints:
    """Points (N, 2) or (N, 3), m, x and y level and z up when it is given; a closed line does not repeat its first point.

    origin : (3,) lat, lon (deg), height (m) of x = y = 0 where the points are positions on the Earth
    is_placed : False for a mere shape, which may be turned and shifted
    """

    points: Floats
    closed: bool = False
    origin: Floats | None = None
    is_placed: bool = True


def read_way_points(path: Path, origin: NDArray[Any] | None = None) -> WayPoints:
    """Read way-points by the ending of the file: .toml, .csv, .geojson or .json; anything else is a trajectory.

    TOML has `points = [[x, y], ...]` and `closed = true`; CSV has x, y and perhaps z per line, m; GeoJSON has one LineString
    or Polygon in degrees, x east and y north of `origin` (3,) lat, lon (deg), height (m), else of its first point. Of a
    trajectory (KITTI, TUM, EuRoC) the level shape is taken, beginning along +x.

    Raises
    ------
    InputError naming the file and the place : missing, unreadable, unknown keys, fewer than three points
    """
    if not path.is_file():
        raise InputError(f"{path} does not exist: --path takes a trajectory or a file of way-points")
    if path.suffix == ".csv" and _is_table(path):
        found = _from_csv(path)
    elif path.suffix == ".toml":
        found = _from_toml(path)
    elif path.suffix in (".geojson", ".json"):
        found = _from_geojson(path, origin)
    else:
        found = _from_trajectory(path)
    return _checked(path, found)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read: {cause(error)}") from None


def _from_toml(path: Path) -> WayPoints:
    try:
        tree = parse_toml(_text(path))
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path} is not valid TOML: {error}") from None
    known = ("points", "closed")
    for key in tree:
        if key not in known:
            raise InputError(f"{path}: unknown key {key!r}; {nearest(key, known)}")
    closed = tree.get("closed", False)
    if not isinstance(closed, bool):
        raise InputError(f"{path}: closed = {closed!r}, expected true or false")
    return WayPoints(_array(path, tree.get("points")), closed)


def _rows(path: Path) -> list[list[str]]:
    lines = (line for line in _text(path).splitlines() if line.strip() and not line.lstrip().startswith("#"))
    try:
        return [[cell.strip() for cell in row] for row in csv.reader(lines)]
    except csv.Error as error:
        raise InputError(f"{path} cannot be read: {error}") from None


def _is_table(path: Path) -> bool:
    """Two or three columns: way-points; trajectories have more."""
    rows = _rows(path)
    return not rows or len(rows[0]) <= 3


def _from_csv(path: Path) -> WayPoints:
    rows = _rows(path)
    if rows and not _is_number(rows[0][0]):
        if [name.lower() for name in rows[0]] not in (["x", "y"], ["x", "y", "z"]):
            raise InputError(f"{path}: the columns are {', '.join(rows[0])}; expected x,y or x,y,z")
        rows = rows[1:]
    return WayPoints(_array(path, [[float(c) if _is_number(c) else c for c in row] for row in rows]))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _from_geojson(path: Path, origin: NDArray[Any] | None) -> WayPoints:
    try:
        tree = parse_json(_text(path))
    except ValueError as error:
        raise InputError(f"{path} is not valid JSON: {error}") from None
    try:
        lines = [g for g in _geometries(tree) if g["type"] in ("LineString", "Polygon")]
        shown = [line["coordinates"][0] if line["type"] == "Polygon" else line.get("coordinates") for line in lines]
    except MISFIT:
        raise InputError(f"{path} is no GeoJSON of one line or one polygon") from None
    if len(lines) != 1:
        raise InputError(f"{path} holds {len(lines)} lines: way-points are one LineString or one Polygon")
    degrees = _array(path, shown[0])
    if not ((np.abs(degrees[:, 0]) <= 180) & (np.abs(degrees[:, 1]) <= 90)).all():
        raise InputError(f"{path}: coordinates of GeoJSON are longitude and latitude in degrees")
    fixes = np.column_stack([degrees[:, 1], degrees[:, 0], np.zeros(len(degrees))])
    at = fixes[0] if origin is None else np.asarray(origin, np.float64)
    local = to_local(fixes, at)[:, :2]
    points = np.column_stack([local, degrees[:, 2]]) if degrees.shape[1] == 3 else local
    closed = len(points) > 3 and bool(portable.norm(local[0] - local[-1]) < 0.1)
    return WayPoints(points[:-1] if closed else points, closed, at)


def _geometries(tree: Any) -> Any:
    if not isinstance(tree, dict):
        return
    if tree.get("type") == "FeatureCollection":
        for feature in tree.get("features") or ():
            yield from _geometries(feature)
    elif tree.get("type") == "Feature":
        yield from _geometries(tree.get("geometry"))
    else:
        yield tree


def _from_trajectory(path: Path) -> WayPoints:
    trajectory = read_trajectory(path)
    p = trajectory.positions
    # Camera 0 looks along z with x to the right.
    xy = np.column_stack([p[:, 2], -p[:, 0]]) if trajectory.frame == "cam0" else p[:, :2]
    kept = [0]
    for i in range(len(xy)):
        if portable.norm(xy[i] - xy[kept[-1]]) >= APART:
            kept.append(i)
    xy = xy[kept] - xy[0]
    if len(xy) > 1:
        c, s = xy[1] / portable.norm(xy[1])
        xy = portable.product(xy, np.array([[c, -s], [s, c]]))
    return WayPoints(xy, is_placed=False)


def _array(path: Path, values: Any) -> Floats:
    try:
        points = np.array(values, np.float64)
    except MISFIT:
        points = np.zeros(0)
    if points.ndim != 2 or points.shape[1] not in (2, 3) or not np.isfinite(points).all():
        raise InputError(f"{path}: way-points are rows of two or three numbers, x, y and perhaps z")
    return points


def _checked(path: Path, found: WayPoints) -> WayPoints:
    points = found.points
    ring = np.concatenate([points, points[:1]]) if found.closed else points
    steps = np.linalg.norm(np.diff(ring[:, :2], axis=0), axis=1)
    needed = 3 if found.closed else 2
    if len(points) < needed:
        what = "a closed path" if found.closed else "a path"
        raise InputError(f"{path} holds too few way-points: {len(points)}, {what} needs {needed}")
    if steps.sum() < 15:
        raise InputError(f"{path} holds a path of {steps.sum():.1f} m: at least 15 m are needed")
    if steps.min() < 1e-6:
        raise InputError(f"{path}: way-point {int(np.argmin(steps)) + 2} is the same as the one before")
    if steps.max() > LONGEST:
        raise InputError(f"{path}: {steps.max() / 1000:.0f} km between neighbours: way-points are in metres")
    return found
