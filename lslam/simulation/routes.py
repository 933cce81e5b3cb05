"""Paths of a LiDAR and their streets: a scenario's own shape, or given way-points."""

from __future__ import annotations

import csv
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.errors import InputError, UsageError, input_errors, nearest
from lslam.core.geometry import portable
from lslam.core.geometry.geodesy import to_local
from lslam.core.untrusted import MISFIT, parse_json, parse_toml
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.simulation.curve import RouteCurve, flat, rounded_rectangle, smooth_curve, winding_line
from lslam.simulation.indoors import room_line, stairs_line
from lslam.simulation.path import SpeedProfile, drive, suspension
from lslam.simulation.scenario_files import SHAPES, Scenario, out_and_back

SPARE = 60.0  # m of street before the start and after the end of an open line
TURN_RADIUS_M = 6.0  # m, radius of the U-turn of an out-and-back: a car on full lock
HALL = 46.0  # m that eights are flown in, when no length is given
HOLD = 5.0  # s at full speed on each of its straights, at least
LONGEST_M = 3000.0  # m that many scans make of it: the fine ground beside it must fit into memory
TIGHTEST = {"car": 3.0, "drone": 1.0, "walker": 0.3}  # m, radius of a bend
WAYPOINTS_APART_M = 3.0  # m between the way-points taken from a trajectory
LONGEST_STEP_M = 50_000.0  # m between neighbours


@dataclass(frozen=True)
class Route:
    """Middle of a street, path along it, and heights of way-points over the distance along the path, if any."""

    street: RouteCurve
    line: RouteCurve
    climb: tuple[Floats, Floats] | None = None


@dataclass(frozen=True)
class Visit:
    """Another drive through the town of a seed.

    number : of the visit; seeds the traffic and all noise. 0 is the drive that the town was built for
    is_reversed : along the other lane in the opposite direction
    shift : m; the drive begins so far along the line
    """

    number: int = 0
    is_reversed: bool = False
    shift: float = 0.0

    def seeds(self, seed: int) -> tuple[int, ...]:
        """Seeds of everything that differs between visits, in the town of `seed`."""
        return (seed, self.number) if self.number else (seed,)


FIRST_VISIT = Visit()


def revisit(route: Route, scenario: Scenario, visit: Visit) -> Route:
    """Route of a visit; the street, and with it the town, is unchanged.

    Raises UsageError for a shift beyond the line, and for a line in three dimensions, which has no other visit.
    """
    if not visit.is_reversed and visit.shift == 0:
        return route
    if route.climb is not None or scenario.path.shape in ("eights", "out-and-back"):
        raise UsageError(f"scenario {scenario.name!r} can only be visited as it is: leave out --reverse and --from")
    line = beside(route.street, scenario.path.lane) if visit.is_reversed and scenario.path.lane else route.line
    if not 0 <= visit.shift < line.length - SPARE:
        raise UsageError(f"--from {visit.shift:g} is out of range: 0 to {line.length - SPARE:.0f} m of the line")
    s = line.sample(0.5)
    s = line.length - s if visit.is_reversed else s
    travelled = (np.arange(len(s)) * line.length / len(s)) if line.closed else np.abs(s - s[0])
    points = line.position(s)
    if line.closed:
        points = np.roll(points, -int(np.searchsorted(travelled, visit.shift)), axis=0)
    else:
        points = points[travelled >= visit.shift]
    return Route(route.street, smooth_curve(points, line.closed))


def speed_profile(scenario: Scenario) -> SpeedProfile:
    """Limits of a car in this scenario."""
    return SpeedProfile(scenario.speed, scenario.start_speed, lateral=scenario.lateral)


def own_route(scenario: Scenario, rng: np.random.Generator, scans: int | None = None) -> Route:
    """Scenario's street and path, scaled, an out-and-back long enough for `scans`; UsageError if a closed one climbs."""
    path = scenario.path
    if path.shape == "block":
        return _block(rng)
    if path.shape == "street":
        return _street(rng)
    if path.shape == "out-and-back":
        return _out_and_back(scenario, scans)
    if path.shape == "stairs":
        line, heights = stairs_line(path.heights[0])
        return Route(line, line, heights)
    if path.shape == "room":
        line = room_line()
        return Route(line, line)
    if path.shape == "eights":
        line = smooth_curve(np.array([[0.0, 0.0], [path.length or HALL, 0.0]]), closed=False)
        return Route(line, line)
    shape, closed = SHAPES[path.shape]
    points = shape(rng)
    climb = path.heights[1] - path.heights[0] if scenario.carrier == "drone" else 0.0
    if closed and climb:
        raise UsageError(f"path.heights {list(path.heights)} of a closed path differ: its end would not meet its start")
    wanted = None if path.length is None else float(np.sqrt(path.length**2 - climb**2))
    scale = 1.0
    while True:
        street = smooth_curve(scale * points, closed, path.smoothing)
        line = beside(street, -path.lane)
        if wanted is None or abs(line.length / wanted - 1) < 1e-4:
            return Route(street, line)
        scale *= wanted / line.length


def given_route(scenario: Scenario, way_points: WayPoints) -> Route:
    """Path through way-points (N, 2), m, unscaled, and a street on its left."""
    points = way_points.points
    line = smooth_curve(points[:, :2], way_points.closed, scenario.path.smoothing)
    street = beside(line, scenario.path.lane)
    if points.shape[1] == 2:
        return Route(street, line)
    z = np.append(points[:, 2], points[0, 2]) if way_points.closed else points[:, 2]
    xy = np.concatenate([points[:, :2], points[:1, :2]]) if way_points.closed else points[:, :2]
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
    return Route(street, line, (s * line.length / s[-1], z))


def beside(curve: RouteCurve, offset: float) -> RouteCurve:
    """The curve `offset` m to the left of `curve`."""
    return smooth_curve(curve.beside(curve.sample(0.5), offset), curve.closed) if offset else curve


def _block(rng: np.random.Generator) -> Route:
    """Path round one block counter-clockwise, right of the middle of the street."""
    size = rounded_rectangle(35.5 + rng.uniform(-0.5, 0.5), 28.0 + rng.uniform(-0.5, 0.5), 11.0)
    street = smooth_curve(size, closed=True)
    return Route(street, smooth_curve(street.beside(street.sample(0.5), -0.8), closed=True))


def _street(rng: np.random.Generator) -> Route:
    """Path along a winding street that changes lanes at times."""
    street = smooth_curve(winding_line(rng, 320 + 2 * SPARE), closed=False)
    s = np.arange(SPARE, street.length - SPARE, 1.0)
    sway = -0.4 + 0.5 * portable.sin(2 * np.pi * s / rng.uniform(80, 120) + rng.uniform(0, 2 * np.pi))
    return Route(street, smooth_curve(street.beside(s, sway), closed=False))


def _out_and_back(scenario: Scenario, scans: int | None) -> Route:
    """Path of the scenario's length, extended so that it reaches its speed, brakes for the turn, and lasts for `scans`."""
    profile, path = speed_profile(scenario), scenario.path
    slow = min(profile.cruise, float(np.sqrt(profile.lateral * TURN_RADIUS_M)))
    speeding = (profile.cruise**2 - profile.start**2) / (2 * profile.acceleration)
    braking = (profile.cruise**2 - slow**2) / (2 * profile.braking)
    length = max(path.length or 0.0, 2 * (speeding + HOLD * profile.cruise + braking) + np.pi * TURN_RADIUS_M)
    longest = max(LONGEST_M, length)
    while True:
        street = smooth_curve(out_and_back(length, TURN_RADIUS_M), False, path.smoothing)
        line = beside(street, -path.lane)
        still = suspension(np.random.default_rng(0), 0.0, 0.0)
        takes = drive(line, flat(), profile, line.length, scenario.lidar_height, still).duration
        # Every further metre is driven at full speed.
        missing = 0.0 if scans is None else (scans + 1) / scenario.rate_hz - takes
        if missing <= 1e-3 or length == longest:
            return Route(street, line)
        length = min(length + missing * profile.cruise, longest)


@dataclass(frozen=True)
class WayPoints:
    """Points (N, 2) or (N, 3), m, x and y level and z up when it is given; a closed line does not repeat its first point.

    origin : (3,) lat, lon (deg), height (m) of x = y = 0 where the points are positions on the Earth
    has_place : False for a shape that may be rotated and shifted
    """

    points: Floats
    closed: bool = False
    origin: Floats | None = None
    has_place: bool = True


def read_way_points(path: Path, origin: NDArray[Any] | None = None) -> WayPoints:
    """Read way-points by the ending of the file: .toml, .csv, .geojson or .json; anything else is a trajectory.

    TOML has `points = [[x, y], ...]` and `closed = true`; CSV has x, y and perhaps z per line, m; GeoJSON has one LineString
    or Polygon in degrees, x east and y north of `origin` (3,) lat, lon (deg), height (m), else of its first point. For a
    trajectory (KITTI, TUM, EuRoC) its horizontal shape is used, rotated to begin along +x.
    Raises InputError naming the file and the position in it : missing, unreadable, unknown keys, fewer than three points.
    """
    if not path.is_file():
        raise InputError(f"{path} does not exist: --path takes a trajectory or a file of way-points")
    if path.suffix == ".csv" and _is_table(path):
        way_points = _from_csv(path)
    elif path.suffix == ".toml":
        way_points = _from_toml(path)
    elif path.suffix in (".geojson", ".json"):
        way_points = _from_geojson(path, origin)
    else:
        way_points = _from_trajectory(path)
    return _require_usable(path, way_points)


def _text(path: Path) -> str:
    """Text of a file. Raises InputError."""
    with input_errors(path, UnicodeDecodeError):
        return path.read_text(encoding="utf-8-sig")


def _from_toml(path: Path) -> WayPoints:
    """Way-points of a TOML file; raises InputError."""
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
    """Rows of cells of a CSV file, without comments. Raises InputError."""
    lines = (line for line in _text(path).splitlines() if line.strip() and not line.lstrip().startswith("#"))
    try:
        return [[cell.strip() for cell in row] for row in csv.reader(lines)]
    except csv.Error as error:
        raise InputError(f"{path} cannot be read: {error}") from None


def _is_table(path: Path) -> bool:
    """Whether rows have two or three columns, as way-points do; trajectories have more."""
    rows = _rows(path)
    return not rows or len(rows[0]) <= 3


def _from_csv(path: Path) -> WayPoints:
    """Way-points of a CSV file, with or without a header x,y or x,y,z; raises InputError."""
    rows = _rows(path)
    if rows and not _is_number(rows[0][0]):
        if [name.lower() for name in rows[0]] not in (["x", "y"], ["x", "y", "z"]):
            raise InputError(f"{path}: the columns are {', '.join(rows[0])}; expected x,y or x,y,z")
        rows = rows[1:]
    return WayPoints(_array(path, [[float(c) if _is_number(c) else c for c in row] for row in rows]))


def _is_number(text: str) -> bool:
    """Whether a text is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def _from_geojson(path: Path, origin: NDArray[Any] | None) -> WayPoints:
    """Way-points (N, 2), m from `origin` or the first, of a GeoJSON's only line or polygon; raises InputError."""
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
    """All geometries of a GeoJSON document."""
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
    """Way-points along the horizontal path of a trajectory file, `WAYPOINTS_APART_M` apart, rotated to begin along +x."""
    trajectory = read_trajectory(path)
    p = trajectory.positions
    # Camera 0 looks along z with x to the right.
    xy = np.column_stack([p[:, 2], -p[:, 0]]) if trajectory.frame == "cam0" else p[:, :2]
    kept = [0]
    for i in range(len(xy)):
        if portable.norm(xy[i] - xy[kept[-1]]) >= WAYPOINTS_APART_M:
            kept.append(i)
    xy = xy[kept] - xy[0]
    if len(xy) > 1:
        c, s = xy[1] / portable.norm(xy[1])
        xy = portable.product(xy, np.array([[c, -s], [s, c]]))
    return WayPoints(xy, has_place=False)


def _array(path: Path, values: Any) -> Floats:
    """(N, 2) or (N, 3) finite numbers; raises InputError naming the file for anything else."""
    try:
        points = np.array(values, np.float64)
    except MISFIT:
        points = np.zeros(0)
    if points.ndim != 2 or points.shape[1] not in (2, 3) or not np.isfinite(points).all():
        raise InputError(f"{path}: way-points are rows of two or three numbers, x, y and perhaps z")
    return points


def _require_usable(path: Path, way_points: WayPoints) -> WayPoints:
    """Way-points (N, 2) unchanged. Raises InputError if they are too few, too close or too short."""
    points = way_points.points
    ring = np.concatenate([points, points[:1]]) if way_points.closed else points
    steps = np.linalg.norm(np.diff(ring[:, :2], axis=0), axis=1)
    needed = 3 if way_points.closed else 2
    if len(points) < needed:
        what = "a closed path" if way_points.closed else "a path"
        raise InputError(f"{path} holds too few way-points: {len(points)}, {what} needs {needed}")
    if steps.sum() < 15:
        raise InputError(f"{path} holds a path of {steps.sum():.1f} m: at least 15 m are needed")
    if steps.min() < 1e-6:
        raise InputError(f"{path}: way-point {int(np.argmin(steps)) + 2} is the same as the one before")
    if steps.max() > LONGEST_STEP_M:
        raise InputError(f"{path}: {steps.max() / 1000:.0f} km between neighbours: way-points are in metres")
    return way_points
