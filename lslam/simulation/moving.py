"""Moving cars and pedestrians: where each of them is at any instant, and what the LiDAR may meet of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.geometry import se3
from lslam.simulation import furniture
from lslam.simulation.city import KERB
from lslam.simulation.curve import Curve
from lslam.simulation.lidar import MovingMesh, RayScene
from lslam.simulation.mesh import Mesh, MeshBuilder, Surface, tube
from lslam.simulation.terrain import Terrain

Floats = NDArray[np.float64]

MODELS = 6  # different cars and different people
NEAREST = 2.3  # m that the middle of anything moving keeps from the LiDAR's line on the ground


@dataclass(frozen=True)
class Mover:
    """A body on a street: `begin` m along at 0 s, `speed` m/s along it (negative: against it), `offset` m to the left.

    On a closed street it goes round and round; an open one it enters and leaves, and where it is not, it is far below.
    """

    scene: RayScene
    radius: float
    street: Curve
    terrain: Terrain
    begin: float
    speed: float
    offset: float
    lift: float = 0.0

    def poses(self, times: NDArray[Any]) -> Floats:
        """(M, 4, 4) T_city_body at `times` (M,), s."""
        s = self.begin + self.speed * np.asarray(times, np.float64)
        present = np.ones(len(s), np.bool_) if self.street.closed else (s >= 0) & (s <= self.street.length)
        s = s if self.street.closed else np.clip(s, 0, self.street.length)
        xy, tangent = self.street.beside(s, self.offset), np.sign(self.speed) * self.street.tangent(s)
        slope = self.terrain.slope(xy)
        up = np.column_stack([-slope, np.ones(len(s))])
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        ahead = np.column_stack([tangent, np.sum(tangent * slope, axis=1)])
        ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
        z = np.where(present, self.terrain.height(xy) + self.lift, -1e4)
        return se3.make(np.stack([ahead, np.cross(up, ahead), up], axis=-1), np.column_stack([xy, z]))


def add_traffic(
    streets: list[Curve],
    terrain: Terrain,
    line: Callable[[NDArray[Any]], Floats],
    duration: float,
    rng: np.random.Generator,
    *,
    cars_per_km: float,
    people_per_km: float,
    lanes: tuple[float, ...],
    pavement: float,
    speed: float,
) -> list[Mover]:
    """Cars and people on `streets`; none comes within `NEAREST` m of the LiDAR's `line` on its way.

    Parameters
    ----------
    line : (M, 4, 4) T_city_lidar at times (M,), s, from 0 to `duration`
    lanes : offsets of the lanes, m to the left of the middle; a car in a lane on the left comes towards us
    pavement : offset of those who walk, m, on either side; speed : of the cars, m/s, about
    """
    cars = [RayScene(furniture.parked_car(rng)) for _ in range(MODELS if cars_per_km else 0)]
    people = [RayScene(pedestrian(rng)) for _ in range(MODELS if people_per_km else 0)]
    times = np.arange(0.0, duration, 0.1)
    ego = line(times)
    movers = []
    for street in streets:
        for kind, density in ((cars, cars_per_km), (people, people_per_km)):
            for _ in range(int(rng.poisson(density * street.length / 1000))):
                body = _body(kind, kind is cars, street, terrain, rng, lanes, pavement, speed)
                if _keeps_clear(body, times, ego):
                    movers.append(body)
    return movers


def pedestrian(rng: np.random.Generator) -> Mesh:
    """Somebody in the middle of a step along +x."""
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
    """Those of `movers` within `reach` m of `position` (3,) at `time` s."""
    near = []
    for mover in movers:
        at = mover.poses(np.array([time]))[0, :3, 3]
        if np.linalg.norm(at - position) < reach + mover.radius:
            near.append(MovingMesh(mover.scene, mover.poses, mover.radius, abs(mover.speed)))
    return near


def _body(
    kind: list[RayScene],
    is_car: bool,
    street: Curve,
    terrain: Terrain,
    rng: np.random.Generator,
    lanes: tuple[float, ...],
    pavement: float,
    speed: float,
) -> Mover:
    scene = kind[int(rng.integers(len(kind)))]
    radius = float(np.linalg.norm(scene.mesh.vertices, axis=1).max())
    begin = rng.uniform(0, street.length)
    if is_car:
        lane = lanes[int(rng.integers(len(lanes)))]
        pace = speed * rng.uniform(0.8, 1.15) * (-1 if lane > 0 else 1)
        return Mover(scene, radius, street, terrain, begin, pace, lane)
    side, pace = (1 if rng.random() < 0.5 else -1), rng.uniform(1.0, 1.7) * (1 if rng.random() < 0.5 else -1)
    return Mover(scene, radius, street, terrain, begin, pace, side * (pavement + rng.uniform(-0.2, 0.2)), KERB)


def _keeps_clear(body: Mover, times: Floats, ego: Floats) -> bool:
    at = body.poses(times)[:, :3, 3]
    apart = np.hypot(*(at - ego[:, :3, 3])[:, :2].T)
    # What flies high above is in nobody's way.
    beside = np.abs(at[:, 2] - ego[:, 2, 3]) < 3.5
    return not bool(np.any(beside & (apart < NEAREST)))


def _limb(low: Floats, high: Floats, half: float) -> list[list[Floats]]:
    """Four upright sides between two squares."""
    square = half * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float64)
    return [[low + square[k], low + square[k - 3], high + square[k - 3], high + square[k]] for k in range(4)]
