"""Moving cars and pedestrians: their poses over time, and those within range of the LiDAR."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.geometry import portable, se3
from lslam.simulation import furniture
from lslam.simulation.city import KERB
from lslam.simulation.curve import RouteCurve, Terrain
from lslam.simulation.lidar import MovingMesh
from lslam.simulation.scenario_files import TrafficSection
from lslam.simulation.scene_mesh import MeshBuilder, RayScene, SceneMesh, Surface, tube

MODELS = 6  # different cars and different people
BUS = (11.0, 2.5, 3.3)  # m
LANE = 3.2  # m
NEAREST_M = 2.3  # m that the middle of anything moving keeps from the LiDAR's line on the ground


@dataclass(frozen=True)
class Mover:
    """Body that moves on a street: at `begin` m along it at 0 s, `speed` m/s (negative: backwards), `offset` m to the left.

    On a closed street it drives laps. On an open one it enters and leaves, and outside it is placed far below the ground.

    start : time, s, and acceleration, m/s2, of driving off; None: it has its speed from the beginning
    """

    scene: RayScene
    radius: float
    street: RouteCurve
    terrain: Terrain
    begin: float
    speed: float
    offset: float
    lift: float = 0.0
    start: tuple[float, float] | None = None

    def along(self, times: NDArray[Any]) -> Floats:
        """(M,) distance along the street, m, at `times` (M,), s."""
        t = np.asarray(times, np.float64)
        if self.start is None:
            return self.begin + self.speed * t
        begin, gain = self.start
        t = np.maximum(t - begin, 0.0)
        gaining = np.minimum(t, self.speed / gain)
        return np.asarray(self.begin + 0.5 * gain * gaining**2 + self.speed * (t - gaining))

    def poses(self, times: NDArray[Any]) -> Floats:
        """(M, 4, 4) T_city_body at `times` (M,), s."""
        at, tangent, slope = _on_street(self.street, self.terrain, self.along(times), self.offset, self.lift)
        tangent = np.sign(self.speed) * tangent
        up = np.column_stack([-slope, np.ones(len(at))])
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        ahead = np.column_stack([tangent, np.sum(tangent * slope, axis=1)])
        ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
        return se3.make(np.stack([ahead, _cross(up, ahead), up], axis=-1), at)


def add_traffic(
    streets: list[RouteCurve],
    terrain: Terrain,
    line: Callable[[NDArray[Any]], Floats],
    duration: float,
    rng: np.random.Generator,
    traffic: TrafficSection,
    pavement: float,
) -> list[Mover]:
    """Cars and pedestrians on `streets`; none comes within `NEAREST_M` m of the LiDAR's `line`.

    line : (M, 4, 4) T_city_lidar at times (M,), s, from 0 to `duration`; pavement : offset of pedestrians, m, on either side
    """
    cars = [RayScene(furniture.parked_car(rng)) for _ in range(MODELS if traffic.cars else 0)]
    people = [RayScene(pedestrian(rng)) for _ in range(MODELS if traffic.people else 0)]
    times = np.arange(0.0, duration, 0.1)
    ego = line(times)
    movers = []
    for street in streets:
        for kind, per_km in ((cars, traffic.cars), (people, traffic.people)):
            for _ in range(int(rng.poisson(per_km * street.length / 1000))):
                scene = kind[int(rng.integers(len(kind)))]
                body = _body(scene, kind is cars, street, terrain, rng, traffic, pavement)
                if _keeps_clear(body, times, ego):
                    movers.append(body)
    return movers


def add_queue(
    streets: list[RouteCurve], terrain: Terrain, T_city_lidar: Floats, starts: float, rng: np.random.Generator
) -> list[Mover]:
    """Two buses on either side of a LiDAR at (4, 4) and a truck ahead, which drive off within half a second after `starts`, s."""
    place = T_city_lidar[:2, 3]

    def nearest(street: RouteCurve) -> tuple[float, float]:
        s = street.sample(0.5)
        away = portable.hypot(*(street.position(s) - place).T)
        return float(away.min()), float(s[int(np.argmin(away))])

    street = min(streets, key=lambda one: nearest(one)[0])
    at = nearest(street)[1]
    left = np.array([-street.tangent(np.array([at]))[0, 1], street.tangent(np.array([at]))[0, 0]])
    own = float((place - street.position(np.array([at]))[0]) @ left)
    movers = []
    for ahead, offset in (
        (rng.uniform(-2, 3), LANE),
        (rng.uniform(-2, 3), -LANE),
        (rng.uniform(6, 9) + BUS[0] / 2, 0.0),
    ):
        scene = RayScene(bus(rng))
        radius = float(np.linalg.norm(scene.mesh.vertices, axis=1).max())
        start = starts + rng.uniform(0, 0.5), rng.uniform(1.0, 2.0)
        movers.append(Mover(scene, radius, street, terrain, at + ahead, 9.0, own + offset, start=start))
    return movers


def bus(rng: np.random.Generator) -> SceneMesh:
    """A bus or a truck along x: a box; the wheels are not modelled."""
    length, width, height = np.array(BUS) * rng.uniform([0.9, 0.95, 0.9], [1.1, 1.05, 1.1])
    builder = MeshBuilder()
    builder.add_box([-length / 2, -width / 2, 0.3], [length / 2, width / 2, height], Surface.CAR)
    return builder.build()


def pedestrian(rng: np.random.Generator) -> SceneMesh:
    """A pedestrian in mid-step along +x."""
    builder = MeshBuilder()
    height, stride = rng.uniform(1.55, 1.9), rng.uniform(0.15, 0.3)
    hip, shoulder = 0.5 * height, 0.83 * height
    for side in (1, -1):
        foot, top = np.array([side * stride, 0.1 * side, 0.0]), np.array([0.0, 0.09 * side, hip])
        builder.add_quads(_limb(foot, top, 0.08), Surface.PERSON)
        hand, arm = np.array([-side * 0.8 * stride, 0.25 * side, hip]), np.array([0.0, 0.23 * side, shoulder])
        builder.add_quads(_limb(hand, arm, 0.05), Surface.PERSON)
    builder.add_box([-0.13, -0.21, hip - 0.05], [0.13, 0.21, shoulder], Surface.PERSON)
    builder.add(*tube(0.1, 0.09, shoulder, height, 8), Surface.PERSON)
    return builder.build()


def moving_meshes(movers: list[Mover], position: NDArray[Any], time: float, reach: float) -> list[MovingMesh]:
    """Those of `movers` within `reach` m of `position` (3,) at `time`, s, as meshes with poses over time."""
    centres = _centres(movers, time)
    near = np.linalg.norm(centres - position, axis=1) < reach + np.array([mover.radius for mover in movers])
    return [
        MovingMesh(movers[i].scene, movers[i].poses, movers[i].radius, abs(movers[i].speed), centres[i])
        for i in np.flatnonzero(near)
    ]


def _centres(movers: list[Mover], time: float) -> Floats:
    """(N, 3) positions of the movers at `time`, s; those of one street are computed together."""
    streets: dict[tuple[int, int], list[int]] = {}
    for i, mover in enumerate(movers):
        streets.setdefault((id(mover.street), id(mover.terrain)), []).append(i)
    centres = np.zeros((len(movers), 3))
    for members in streets.values():
        some = [movers[i] for i in members]
        s, offset, lift = np.array([(float(m.along(time)), m.offset, m.lift) for m in some]).T  # type: ignore[arg-type]
        centres[members] = _on_street(some[0].street, some[0].terrain, s, offset, lift)[0]
    return centres


def _on_street(
    street: RouteCurve, terrain: Terrain, s: Floats, offset: float | Floats, lift: float | Floats
) -> tuple[Floats, Floats, Floats]:
    """Positions (M, 3) of bodies `s` m along the street, its tangents (M, 2) and the ground's slopes (M, 2) there."""
    present = np.ones(len(s), np.bool_) if street.closed else (s >= 0) & (s <= street.length)
    s = s if street.closed else np.clip(s, 0, street.length)
    tangent = street.tangent(s)
    left = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    xy = street.position(s) + np.broadcast_to(np.asarray(offset, np.float64), len(s))[:, None] * left
    z = np.where(present, terrain.height(xy) + lift, -1e4)
    return np.column_stack([xy, z]), tangent, terrain.slope(xy)


def _cross(a: Floats, b: Floats) -> Floats:
    """As `np.cross` of (M, 3), three times as fast for small M."""
    return np.stack([a[:, i] * b[:, j] - a[:, j] * b[:, i] for i, j in ((1, 2), (2, 0), (0, 1))], axis=1)


def _body(
    scene: RayScene,
    is_car: bool,
    street: RouteCurve,
    terrain: Terrain,
    rng: np.random.Generator,
    traffic: TrafficSection,
    pavement: float,
) -> Mover:
    """A car in a lane, or a pedestrian on a pavement, at a random position and speed."""
    radius = float(np.linalg.norm(scene.mesh.vertices, axis=1).max())
    begin = rng.uniform(0, street.length)
    if is_car:
        lane = traffic.lanes[int(rng.integers(len(traffic.lanes)))]
        pace = traffic.speed * rng.uniform(0.8, 1.15) * (-1 if lane > 0 else 1)
        return Mover(scene, radius, street, terrain, begin, pace, lane)
    side, pace = (1 if rng.random() < 0.5 else -1), rng.uniform(1.0, 1.7) * (1 if rng.random() < 0.5 else -1)
    return Mover(scene, radius, street, terrain, begin, pace, side * (pavement + rng.uniform(-0.2, 0.2)), KERB)


def _keeps_clear(body: Mover, times: Floats, ego: Floats) -> bool:
    """Whether a body stays at least `NEAREST_M` away from the LiDAR's poses `ego` (M, 4, 4) at the times."""
    at = body.poses(times)[:, :3, 3]
    apart = portable.hypot(*(at - ego[:, :3, 3])[:, :2].T)
    # What flies high above is in nobody's way.
    beside = np.abs(at[:, 2] - ego[:, 2, 3]) < 3.5
    return not bool(np.any(beside & (apart < NEAREST_M)))


def _limb(low: Floats, high: Floats, half: float) -> list[list[Floats]]:
    """Four upright sides of a prism between squares of half width `half`, m, about the centres `low` and `high` (3,)."""
    square = half * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float64)
    return [[low + square[k], low + square[k - 3], high + square[k - 3], high + square[k]] for k in range(4)]
