"""An open car park: rough sloping ground, a low wall and trees on one side, distant houses on the other, a few cars."""

from __future__ import annotations

import numpy as np

from lslam.core.errors import UsageError
from lslam.core.types.arrays import Floats
from lslam.simulation import furniture
from lslam.simulation.city import City, Layout
from lslam.simulation.countryside import add_house, add_wall
from lslam.simulation.curve import RouteCurve, smooth_curve
from lslam.simulation.scene_mesh import MeshBuilder, Surface, grid_faces
from lslam.simulation.terrain import Terrain

# A LiDAR's beam of 3 mrad lights a spot some 3 cm wide and 20 cm long on the ground 10 m away: smaller bumps it averages.
BUMP = 0.25  # m from one bump of the ground to the next
BUMPS_M = 35.0  # m round the path with every bump: as far as rays 3 deg below level meet the ground
COARSE = 1.0  # m between bumps farther away
MOST_BUMPS = 4_000_000  # bumps that fit into memory
MARGIN_M = 80.0  # m of ground round the path: to behind the houses
ENDS = 40.0  # m that the wall goes on beyond the path
WALL_AWAY = (12.0, 22.0)  # m from the path
WALL_HEIGHTS_M = (0.9, 1.1)
WALL_THICKNESS = 0.24
TREES_BEHIND = (2.5, 4.5)  # m
TREES_APART = (6.0, 11.0)
BAY_WIDTH, BAY_DEPTH = 2.5, 5.0  # m, of one parked car, as drawn on most car parks of Europe
ROWS = 2 * BAY_DEPTH + 6.0  # m from a row to the next but one: two bays and the aisle between
FIRST_ROW = (9.0, 14.0)  # m from the path to the middle of the row on the far side
BLOCK, ROW = 60.0, (12.0, 25.0)  # m in which a row has one stretch of bays in use, and its length
IN_USE = 0.7  # share of blocks with such a stretch


def build_carpark(
    line: RouteCurve, terrain: Terrain, layout: Layout, roughness: float, rng: np.random.Generator
) -> City:
    """Build a car park round the path `line`; `roughness` is the standard deviation of the ground's surface, m.

    Objects are placed in order along x, each kind with a generator of its own, so a longer path has the same beginning.
    Raises UsageError for a path that is too long.
    """
    walls, trees, cars, houses, ground = rng.spawn(5)
    at = line.position(line.sample(0.5))
    low, high = at.min(axis=0), at.max(axis=0)
    middle, half = 0.5 * (low[1] + high[1]), 0.5 * float(high[1] - low[1])
    axis = smooth_curve(np.array([[low[0] - ENDS, middle], [high[0] + ENDS, middle]]), closed=False)
    side, away = (1 if walls.random() < 0.5 else -1), half + walls.uniform(*WALL_AWAY)
    builder = MeshBuilder()
    _add_ground(builder, low, high, terrain, roughness, ground)
    top = walls.uniform(*WALL_HEIGHTS_M)
    add_wall(builder, axis, terrain, axis.sample(2.0), side * away, top, Surface.WALL, thickness=WALL_THICKNESS)
    _add_trees(builder, axis, terrain, layout, side * away, trees)
    first = half + cars.uniform(*FIRST_ROW)
    for row, generator in zip(
        (side * (away - 1.0 - BAY_DEPTH / 2), -side * first, -side * (first + ROWS)), cars.spawn(3), strict=True
    ):
        _add_cars(builder, axis, terrain, layout, row, generator)
    footprints, heights = _add_houses(builder, axis, terrain, layout, -side, half, houses)
    return City(builder.build(), terrain, line, footprints, heights, [line])


def _add_ground(
    builder: MeshBuilder, low: Floats, high: Floats, terrain: Terrain, roughness: float, rng: np.random.Generator
) -> None:
    """Add ground without holes, with random bumps."""
    x, y = (_grid_lines(float(low[k]), float(high[k])) for k in (0, 1))
    if len(x) * len(y) > MOST_BUMPS:
        raise UsageError(
            f"a car park of {np.ptp(x):.0f} x {np.ptp(y):.0f} m with a bump every {BUMP:g} m is too large: choose a shorter path"
        )
    xy = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    # Between three corners of variance v the variance of a triangle is v / 2 in the mean.
    z = terrain.height(xy) + rng.normal(0, np.sqrt(2) * roughness, xy.shape[:2])
    builder.add(np.concatenate([xy, z[..., None]], -1).reshape(-1, 3), grid_faces(len(x), len(y)), Surface.ROAD)


def _grid_lines(low: float, high: float) -> Floats:
    """Coordinates of the ground's grid lines along one axis: dense up to `BUMPS_M` m beyond `low` and `high`."""
    count = int(np.ceil((high - low + 2 * BUMPS_M) / BUMP))
    fine = low - BUMPS_M + BUMP * np.arange(count + 1)
    beyond = np.arange(COARSE, MARGIN_M - BUMPS_M + COARSE, COARSE)
    return np.concatenate([fine[0] - beyond[::-1], fine, fine[-1] + beyond])


def _add_trees(
    builder: MeshBuilder, axis: RouteCurve, terrain: Terrain, layout: Layout, wall: float, rng: np.random.Generator
) -> None:
    """Add a row of trees behind the wall, which is `wall` m to the left of the axis."""
    s = rng.uniform(*TREES_APART)
    while s < axis.length:
        offset = wall + np.sign(wall) * rng.uniform(*TREES_BEHIND)
        if rng.random() < layout.trees:
            xy = axis.beside(np.array([s]), offset)[0]
            builder.add_mesh(furniture.tree(rng, layout.volumes), [*xy, float(terrain.height(xy))])
        s += rng.uniform(*TREES_APART)


def _add_cars(
    builder: MeshBuilder, axis: RouteCurve, terrain: Terrain, layout: Layout, offset: float, rng: np.random.Generator
) -> None:
    """Add a row of parking bays across the axis, their middles `offset` m to its left; some hold a car."""
    for block in np.arange(0.0, axis.length, BLOCK):
        is_used, length = rng.random() < IN_USE, rng.uniform(*ROW)
        first = block + rng.uniform(0, BLOCK - length)
        for s in np.arange(first, first + length, BAY_WIDTH) if is_used else ():
            if rng.random() < layout.parked and s < axis.length:
                xy = axis.beside(np.array([s]), offset + rng.uniform(-0.2, 0.2))[0]
                yaw = (1 if rng.random() < 0.5 else -1) * np.pi / 2 + rng.normal(0, 0.03)
                builder.add_mesh(furniture.parked_car(rng), [*xy, float(terrain.height(xy))], yaw)


def _add_houses(
    builder: MeshBuilder,
    axis: RouteCurve,
    terrain: Terrain,
    layout: Layout,
    side: int,
    half: float,
    rng: np.random.Generator,
) -> tuple[list[Floats], list[float]]:
    """Add houses that face the car park, `layout.setback` m from the path. Returns their outlines and heights."""
    footprints: list[Floats] = []
    heights: list[float] = []
    s = rng.uniform(0, layout.gap[1])
    while True:
        width, depth = rng.uniform(*layout.house_width), rng.uniform(*layout.house_depth)
        if s + width > axis.length:
            return footprints, heights
        front = side * (half + rng.uniform(*layout.setback))
        outline, height = add_house(builder, axis, terrain, layout, s + width / 2, front, width, depth, rng)
        footprints.append(outline)
        heights.append(height)
        s += width + rng.uniform(*layout.gap)
