"""Construction of a scenario's place: street and path, town, and moving objects."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.errors import UsageError
from lslam.simulation.city import City, build_city
from lslam.simulation.countryside import build_carpark, build_corridor, build_motorway, build_woods
from lslam.simulation.curve import RouteCurve, Terrain, rolling, stretch
from lslam.simulation.indoors import build_hall, build_room, build_stairwell
from lslam.simulation.kinematics import PosePath
from lslam.simulation.moving import Mover, add_queue, add_traffic
from lslam.simulation.osm_city import OsmCity
from lslam.simulation.osm_place import MapExtract, city_of_map, keep_out_of_walls, route_in_map
from lslam.simulation.path import (
    EightFlight,
    FreePath,
    SpeedProfile,
    VehiclePath,
    buffeting,
    climb_spline,
    drive,
    eight_flight,
    fly,
    gait,
    suspension,
)
from lslam.simulation.routes import (
    FIRST_VISIT,
    SPARE,
    TIGHTEST,
    Route,
    Visit,
    WayPoints,
    given_route,
    own_route,
    revisit,
    speed_profile,
)
from lslam.simulation.scenario_files import INDOORS, Scenario
from lslam.simulation.scene_mesh import RayScene, Surface
from lslam.simulation.town import build_town

CORRIDOR_SPARE = 130.0  # m, so that no LiDAR here sees an end of the corridor
SOLID = (Surface.ROAD, Surface.PAVEMENT, Surface.LAWN, Surface.WALL, Surface.GLASS, Surface.PANE, Surface.ROOF)
NAMES = {Surface.ROAD: "the ground", Surface.PAVEMENT: "the ground", Surface.LAWN: "the ground"}
HALF_WIDTH = 0.7  # m on both sides of the path that must be free as well
LOWEST = 0.3  # m above the ground
STEP_S = 0.05  # s
CarrierPath = VehiclePath | FreePath | EightFlight


@dataclass(frozen=True)
class BuiltScenario:
    """A built scenario: the city, the path of the LiDAR through it, and the number of scans."""

    city: City
    path: CarrierPath
    scans: int


def build_scenario(
    scenario: Scenario,
    seed: int,
    count: int | None = None,
    way_points: WayPoints | None = None,
    extract: MapExtract | None = None,
    standing: int = 0,
    visit: Visit = FIRST_VISIT,
) -> BuiltScenario:
    """Build the place of `scenario`.

    Each part has a random generator of its own, so another LiDAR or speed leaves the city unchanged. Only an out-and-back
    line and its surroundings grow with the speed or `count`. `way_points` replace the scenario's own line, `extract` its
    town. `standing` of the `count` scans pass before the vehicle moves off; `visit` is another drive. Raises UsageError for
    bends too tight and more scans than fit, InputError for an extract that is far from the way-points.
    """
    if scenario.world.kind in INDOORS and (way_points is not None or extract is not None):
        raise UsageError(
            f"scenario {scenario.name!r} has a line of its own in a {scenario.world.kind}: leave out --path and --osm"
        )
    place, build, shake = (np.random.default_rng([seed, 2**32 - k]) for k in (1, 2, 3))
    if extract is not None:
        route = route_in_map(scenario, extract, way_points)
    else:
        moving = None if count is None else count - standing
        route = given_route(scenario, way_points) if way_points is not None else own_route(scenario, place, moving)
    terrain = _terrain(scenario, place)
    way = revisit(route, scenario, visit)
    _check_radius(scenario, way.line)
    if visit.number:
        shake = np.random.default_rng([*visit.seeds(seed), 2**32 - 3])
    path, scans = _move(scenario, way, terrain, count, standing, shake)
    if extract is not None:
        return BuiltScenario(city_of_map(scenario, extract, terrain, build, route), path, scans)
    return BuiltScenario(_city(scenario, route.street, terrain, build), path, scans)


def whole_map(scenario: Scenario, seed: int, extract: MapExtract) -> tuple[OsmCity, Floats]:
    """City of the whole `extract`, and the line (N, 3) along its streets that a drive would take; no points if there is none.

    It is drawn on a plan for picking way-points.
    """
    place, build = (np.random.default_rng([seed, 2**32 - k]) for k in (1, 2))
    terrain = _terrain(scenario, place)
    try:
        line = route_in_map(scenario, extract, None).line
        xy = line.position(line.sample(1.0))
    except UsageError:
        xy = np.zeros((0, 2))
    return city_of_map(scenario, extract, terrain, build, None), np.column_stack([xy, np.zeros(len(xy))])


def populate(scenario: Scenario, city: City, path: PosePath, seeds: tuple[int, ...]) -> list[Mover]:
    """Moving objects in `city` while the LiDAR is on `path`."""
    traffic, queue = scenario.traffic, []
    if traffic.queue_s is not None:
        rng = np.random.default_rng([*seeds, 2**32 - 5])
        queue = add_queue(city.streets, city.terrain, path.poses(np.zeros(1))[0], traffic.queue_s, rng)
    pavement = scenario.layout.road + 0.6 * scenario.layout.pavement
    rng = np.random.default_rng([*seeds, 2**32 - 4])
    movers = add_traffic(city.streets, city.terrain, path.poses, path.duration, rng, traffic, pavement)
    movers = keep_out_of_walls(movers, city, path.duration) if isinstance(city, OsmCity) else movers
    return [*movers, *queue]


def _terrain(scenario: Scenario, rng: np.random.Generator) -> Terrain:
    """Random ground of the scenario's relief."""
    world = scenario.world
    return rolling(rng, world.relief, world.unevenness, world.swell, world.slope)


def _city(scenario: Scenario, street: RouteCurve, terrain: Terrain, rng: np.random.Generator) -> City:
    """Build the city of the scenario's kind of world along the street."""
    world = scenario.world
    if world.kind == "street":
        return build_city(street, terrain, scenario.layout, rng)
    if world.kind == "motorway":
        return build_motorway(stretch(street, SPARE), terrain, scenario.layout, rng)
    if world.kind == "corridor":
        return build_corridor(stretch(street, CORRIDOR_SPARE), terrain, scenario.layout, rng)
    if world.kind == "woods":
        return build_woods(stretch(street, SPARE), terrain, scenario.layout, rng)
    if world.kind == "carpark":
        return build_carpark(street, terrain, scenario.layout, world.roughness, rng)
    if world.kind == "hall":
        return build_hall(street, terrain, rng)
    if world.kind == "stairwell":
        return build_stairwell(street, terrain, rng)
    if world.kind == "room":
        return build_room(street, terrain, rng)
    return build_town([stretch(street, SPARE)], terrain, scenario.layout, rng, world.spacing, world.levels)


def _check_radius(scenario: Scenario, line: RouteCurve) -> None:
    """Raise UsageError for bends too tight for the carrier, or for a drone's lateral acceleration."""
    s = line.sample(0.25)
    curvature = line.curvature(s)
    least, worst = TIGHTEST[scenario.carrier], int(np.argmax(np.abs(curvature)))
    if abs(curvature[worst]) * least > 1:
        raise UsageError(
            f"the path bends with a radius of {1 / abs(curvature[worst]):.1f} m at {s[worst]:.0f} m along, a "
            f"{scenario.carrier} needs {least:g} m: use way-points farther apart or more --set path.smoothing"
        )
    if scenario.carrier == "drone" and scenario.path.shape != "eights":
        check_bends(curvature, s, scenario.speed, scenario.lateral)


def _move(
    scenario: Scenario, route: Route, terrain: Terrain, count: int | None, standing: int, rng: np.random.Generator
) -> tuple[CarrierPath, int]:
    """Path and number of scans: `count`, one lap, or all on an open line; UsageError if `count` does not fit."""
    line, rate = route.line, scenario.rate_hz
    distance = line.length
    if line.closed:
        wanted = distance + scenario.overlap if count is None else scenario.speed * count / rate
        # The columns of the last scan need its whole period on the path.
        distance = wanted + 2 * scenario.speed / rate
    path = _make_path(scenario, route, terrain, distance, rng)
    fits = int(np.floor(path.duration * rate + 1e-6))
    if not line.closed:
        if count is not None and count - standing > fits:
            raise UsageError(
                f"scenario {scenario.name!r} ends after {fits + standing} scans at {scenario.speed:g} m/s: ask for fewer with "
                "--count, or drive slower with --speed"
            )
        return path, fits if count is None else count
    if count is None:
        assert not isinstance(path, EightFlight)  # whose line is open
        reached = path.distance(np.arange(fits) / rate)
        count = int(np.searchsorted(reached, line.length + scenario.overlap)) + 1
    return path, min(count, fits)


def _make_path(
    scenario: Scenario, route: Route, terrain: Terrain, distance: float, rng: np.random.Generator
) -> CarrierPath:
    """Path of the LiDAR along the route, `distance` m, by its carrier: car, walker or drone."""
    line, section = route.line, scenario.path
    if section.shape == "eights":
        above = line.position(np.array([0.5 * line.length]))[0]
        swing = buffeting(rng, section.swing)
        return eight_flight(rng, np.array([*above, section.heights[0]]), scenario.speed, scenario.lateral, swing)
    profile = speed_profile(scenario)
    if scenario.carrier == "car":
        return drive(line, terrain, profile, distance, scenario.lidar_height, suspension(rng))
    nodes: tuple[Any, Any] = route.climb or (np.array([0.0, line.length]), np.array(section.heights))
    climb = climb_spline(line, *nodes, section.smoothing)
    if scenario.carrier == "walker":
        profile = SpeedProfile(scenario.speed, scenario.start_speed, 0.8, 0.8, scenario.lateral)
        return fly(line, profile, distance, climb, 0.0, gait(rng, section.swing), terrain)
    # A drone holds its speed through the bends it was allowed.
    steady = SpeedProfile(scenario.speed, scenario.start_speed, lateral=1e6)
    return fly(line, steady, distance, climb, section.bank, buffeting(rng, section.swing))


def check_path(scene: RayScene, city: City, poses: Callable[[NDArray[Any]], Floats], duration: float) -> None:
    """Raise UsageError naming the place where a path, 0..`duration` s, enters the ground or a building.

    Rays are cast between successive instants along the path and along one line on either side of it.
    """
    times = np.arange(0.0, duration, STEP_S)
    T = poses(times)
    height = T[:, 2, 3] - city.terrain.height(T[:, :2, 3])
    low = np.flatnonzero(height < LOWEST)
    if len(low):
        _fail("comes within 0.3 m of the ground or below it", T, int(low[0]))
    _check_start(scene, T[0])
    for aside in (0.0, HALF_WIDTH, -HALF_WIDTH):
        line = T[:, :3, 3] + aside * T[:, :3, 1]
        step = np.diff(line, axis=0)
        length = np.linalg.norm(step, axis=1)
        moving = np.flatnonzero(length > 1e-6)
        rays = (step[moving] / length[moving, None]).astype(np.float32)
        far, face = scene.cast(line[moving].astype(np.float32), rays)
        met = np.flatnonzero((far < length[moving]) & np.isin(scene.mesh.surfaces[face], SOLID))
        if len(met):
            surface = Surface(scene.mesh.surfaces[face[met[0]]])
            _fail(f"crosses {NAMES.get(surface, 'a building')}", T, int(moving[met[0]]))


def check_bends(curvature: Floats, s: Floats, speed: float, limit: float) -> None:
    """Raise UsageError where a bend taken at `speed` m/s needs more than `limit` m/s2 lateral acceleration.

    Curvatures (M,), 1/m, at distances (M,), m.
    """
    needed = speed**2 * np.abs(curvature)
    worst = int(np.argmax(needed))
    if needed[worst] > limit:
        raise UsageError(
            f"the path bends with a radius of {1 / abs(curvature[worst]):.1f} m at {s[worst]:.0f} m along: {speed:g} m/s needs "
            f"{needed[worst]:.1f} m/s2 there, more than the {limit:g} allowed: use a lower --speed, or way-points farther apart"
        )


def _check_start(scene: RayScene, T: Floats) -> None:
    """Raise UsageError if anything solid is above the start: then it lies inside a building."""
    up = np.array([[0.0, 0.0, 1.0]], np.float32)
    _, face = scene.cast(T[None, :3, 3].astype(np.float32), up)
    if face[0] >= 0 and scene.mesh.surfaces[face[0]] in (Surface.WALL, Surface.ROOF, Surface.LAWN):
        _fail("starts inside a building or below the ground", T[None], 0)


def _fail(what: str, T: Floats, index: int) -> None:
    """Raise UsageError that the path does `what` at its pose number `index`."""
    along = float(np.linalg.norm(np.diff(T[: index + 1, :3, 3], axis=0), axis=1).sum())
    x, y, z = T[index, :3, 3]
    raise UsageError(
        f"the path {what}, {along:.0f} m along at x = {x:.1f}, y = {y:.1f}, z = {z:.1f} m: move its way-points"
    )
