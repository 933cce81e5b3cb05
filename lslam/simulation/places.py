"""From a scenario to a place: the street and the line along it, the town round it, the path through it, what moves in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.errors import UsageError
from lslam.simulation import path as paths
from lslam.simulation.city import City, build_city
from lslam.simulation.clearance import check_bends
from lslam.simulation.countryside import build_corridor, build_motorway
from lslam.simulation.curve import Curve, rounded_rectangle, smooth_curve, stretched, winding_line
from lslam.simulation.flight import FreePath, buffeting, climb_spline, fly, gait
from lslam.simulation.motion import PosePath
from lslam.simulation.moving import Mover, add_traffic
from lslam.simulation.scenario_files import Scenario
from lslam.simulation.shapes import SHAPES
from lslam.simulation.terrain import Terrain, rolling
from lslam.simulation.town import build_town
from lslam.simulation.waypoints import WayPoints

Floats = NDArray[np.float64]

SPARE = 60.0  # m of street before the start and after the end of an open line
CORRIDOR_SPARE = 130.0  # m, so that no LiDAR here sees an end of the corridor
TIGHTEST = {"car": 3.0, "drone": 1.0, "walker": 0.3}  # m, radius of a bend


@dataclass(frozen=True)
class Place:
    """A built scenario: the city, the path of the LiDAR through it, and how many scans it gives."""

    city: City
    path: paths.VehiclePath | FreePath
    scans: int


@dataclass(frozen=True)
class Route:
    """The middle of a street, the line along it, and heights of way-points over the distance along the line, if they have any."""

    street: Curve
    line: Curve
    climb: tuple[Floats, Floats] | None = None


def build_place(scenario: Scenario, seed: int, count: int | None = None, way_points: WayPoints | None = None) -> Place:
    """Build the place of `scenario`; one generator per part, so that another LiDAR or speed leaves the city as it is.

    `way_points` replace the scenario's own line. Raises UsageError for bends too tight and more scans than fit.
    """
    place, build, shake = (np.random.default_rng([seed, 2**32 - k]) for k in (1, 2, 3))
    route = _given(scenario, way_points) if way_points is not None else _route(scenario, place)
    terrain = rolling(place, scenario.world.relief, scenario.world.unevenness)
    _check_radius(scenario, route.line)
    path, scans = _move(scenario, route, terrain, count, shake)
    city = _city(scenario, route.street, terrain, build)
    return Place(city, path, scans)


def populate(scenario: Scenario, city: City, path: PosePath, seed: int) -> list[Mover]:
    """What moves in `city` while the LiDAR is on `path`."""
    traffic = scenario.traffic
    return add_traffic(
        city.streets, city.terrain, path.poses, path.duration, np.random.default_rng([seed, 2**32 - 4]),
        cars_per_km=traffic.cars, people_per_km=traffic.people, lanes=traffic.lanes,
        pavement=scenario.layout.road + 0.6 * scenario.layout.pavement, speed=traffic.speed,
    )  # fmt: skip


def _city(scenario: Scenario, street: Curve, terrain: Terrain, rng: np.random.Generator) -> City:
    world = scenario.world
    if world.kind == "street":
        return build_city(street, terrain, scenario.layout, rng)
    if world.kind == "motorway":
        return build_motorway(stretched(street, SPARE), terrain, scenario.layout, rng)
    if world.kind == "corridor":
        return build_corridor(stretched(street, CORRIDOR_SPARE), terrain, scenario.layout, rng)
    return build_town([stretched(street, SPARE)], terrain, scenario.layout, rng, world.spacing, world.levels)


def _route(scenario: Scenario, rng: np.random.Generator) -> Route:
    """The scenario's own street and line, scaled to its length."""
    path = scenario.path
    if path.shape == "block":
        return _block(rng)
    if path.shape == "street":
        return _street(rng)
    shape, closed = SHAPES[path.shape]
    points = shape(rng)
    climb = path.heights[1] - path.heights[0] if scenario.carrier == "drone" else 0.0
    if closed and climb:
        raise UsageError(f"path.heights {list(path.heights)} of a closed path differ: its end would not meet its start")
    wanted = None if path.length is None else float(np.sqrt(path.length**2 - climb**2))
    scale = 1.0
    while True:
        street = smooth_curve(scale * points, closed, path.smoothing)
        line = _beside(street, -path.lane)
        if wanted is None or abs(line.length / wanted - 1) < 1e-4:
            return Route(street, line)
        scale *= wanted / line.length


def _given(scenario: Scenario, way_points: WayPoints) -> Route:
    """A line through way-points, in metres as they are, and a street on its left."""
    points = way_points.points
    line = smooth_curve(points[:, :2], way_points.closed, scenario.path.smoothing)
    street = _beside(line, scenario.path.lane)
    if points.shape[1] == 2:
        return Route(street, line)
    z = np.append(points[:, 2], points[0, 2]) if way_points.closed else points[:, 2]
    xy = np.concatenate([points[:, :2], points[:1, :2]]) if way_points.closed else points[:, :2]
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
    return Route(street, line, (s * line.length / s[-1], z))


def _beside(curve: Curve, offset: float) -> Curve:
    return smooth_curve(curve.beside(curve.sample(0.5), offset), curve.closed) if offset else curve


def _block(rng: np.random.Generator) -> Route:
    """Round one block counter-clockwise, right of the middle of the street."""
    size = rounded_rectangle(35.5 + rng.uniform(-0.5, 0.5), 28.0 + rng.uniform(-0.5, 0.5), 11.0)
    street = smooth_curve(size, closed=True)
    return Route(street, smooth_curve(street.beside(street.sample(0.5), -0.8), closed=True))


def _street(rng: np.random.Generator) -> Route:
    """Along a winding street, changing sides of the lane now and then."""
    street = smooth_curve(winding_line(rng, 320 + 2 * SPARE), closed=False)
    s = np.arange(SPARE, street.length - SPARE, 1.0)
    sway = -0.4 + 0.5 * np.sin(2 * np.pi * s / rng.uniform(80, 120) + rng.uniform(0, 2 * np.pi))
    return Route(street, smooth_curve(street.beside(s, sway), closed=False))


def _check_radius(scenario: Scenario, line: Curve) -> None:
    s = line.sample(0.25)
    curvature = line.curvature(s)
    least, worst = TIGHTEST[scenario.carrier], int(np.argmax(np.abs(curvature)))
    if abs(curvature[worst]) * least > 1:
        raise UsageError(
            f"the path bends with a radius of {1 / abs(curvature[worst]):.1f} m at {s[worst]:.0f} m along, a "
            f"{scenario.carrier} needs {least:g} m: use way-points farther apart or more --set path.smoothing"
        )
    if scenario.carrier == "drone":
        check_bends(curvature, s, scenario.speed, scenario.lateral)


def _move(
    scenario: Scenario, route: Route, terrain: Terrain, count: int | None, rng: np.random.Generator
) -> tuple[paths.VehiclePath | FreePath, int]:
    """The path, and how many scans there are: `count`, or one lap, or all that fit on an open line."""
    line, rate = route.line, scenario.rate_hz
    distance = line.length
    if line.closed:
        wanted = distance + scenario.overlap if count is None else scenario.speed * count / rate
        # The columns of the last scan need its whole period on the path.
        distance = wanted + 2 * scenario.speed / rate
    path = _carried(scenario, route, terrain, distance, rng)
    fits = int(np.floor(path.duration * rate + 1e-6))
    if not line.closed:
        if count is not None and count > fits:
            raise UsageError(
                f"scenario {scenario.name!r} ends after {fits} scans at {scenario.speed:g} m/s: ask for fewer with "
                "--count, or drive slower with --speed"
            )
        return path, fits if count is None else count
    if count is None:
        reached = path.travelled(np.arange(fits) / rate)
        count = int(np.searchsorted(reached, line.length + scenario.overlap)) + 1
    return path, min(count, fits)


def _carried(
    scenario: Scenario, route: Route, terrain: Terrain, distance: float, rng: np.random.Generator
) -> paths.VehiclePath | FreePath:
    line, section = route.line, scenario.path
    profile = paths.SpeedProfile(scenario.speed, scenario.start_speed, lateral=scenario.lateral)
    if scenario.carrier == "car":
        return paths.drive(line, terrain, profile, distance, scenario.lidar_height, paths.suspension(rng))
    nodes: tuple[Any, Any] = route.climb or (np.array([0.0, line.length]), np.array(section.heights))
    climb = climb_spline(line, *nodes, section.smoothing)
    if scenario.carrier == "walker":
        profile = paths.SpeedProfile(scenario.speed, scenario.start_speed, 0.8, 0.8, scenario.lateral)
        return fly(line, profile, distance, climb, 0.0, gait(rng, section.swing), terrain)
    # A drone holds its speed through the bends it was allowed.
    steady = paths.SpeedProfile(scenario.speed, scenario.start_speed, lateral=1e6)
    return fly(line, steady, distance, climb, section.bank, buffeting(rng, section.swing))
