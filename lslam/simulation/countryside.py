"""Places with few features: a motorway through fields, and a corridor between plain walls."""

from __future__ import annotations

import numpy as np

from lslam.core.geometry import portable
from lslam.core.types.arrays import Floats
from lslam.simulation import furniture
from lslam.simulation.city import City, Layout, add_ground
from lslam.simulation.curve import RouteCurve
from lslam.simulation.houses import house
from lslam.simulation.scene_mesh import MeshBuilder, Surface, grid_faces
from lslam.simulation.terrain import Terrain

RAIL = (0.45, 0.75)  # m, the lower and the upper edge of a guard rail
VERGE = -0.06  # m, of grass beside a road without kerbs
WALL_HEIGHT_M = 6.0  # m, of a corridor
OPENINGS = (135.0, 155.0)  # m from the middle of one opening of a corridor to the next
OPENING = 28.0  # m of an opening
DEEP = 32.0  # m on both sides in which trees stand
TRUNKS_APART_M = 1.1  # m from one trunk to the next, at least
NEAREST_TRUNK_M = 1.0  # m from the edge of the way
HEDGE = 12.0  # m of way for every hedge that may stand beside it
LODGES = 90.0  # m of way from one house to the next


def build_motorway(street: RouteCurve, terrain: Terrain, layout: Layout, rng: np.random.Generator) -> City:
    """Build two carriageways with guard rails, delineators, gantries and a noise barrier; beyond them trees and bushes."""
    builder = MeshBuilder()
    add_strip(builder, street, terrain, [0.0, 3.0, 6.0, 9.0, layout.road, layout.band], rng)
    add_ground(builder, [street], terrain, layout, rng, 1.2, VERGE)
    for offset in (-layout.road - 0.6, 0.0, layout.road + 0.6):
        _add_rail(builder, street, terrain, offset)
    for s in np.arange(10.0, street.length, 50.0):
        for side in (1, -1):
            _put(
                builder,
                street,
                terrain,
                s,
                side * (layout.road + 1.2),
                [-0.06, -0.06, -0.3],
                [0.06, 0.06, 1.0],
                Surface.POLE,
            )
    for s in np.arange(90.0, street.length, 240.0):
        _add_gantry(builder, street, terrain, s + rng.uniform(-40, 40), layout.road + 1.4)
    barrier = rng.uniform(0.3, 0.5) * street.length
    s = np.arange(barrier, min(barrier + 0.15 * street.length, street.length), 4.0)
    add_wall(builder, street, terrain, s, -layout.band - 2.5, rng.uniform(2.5, 4.0), Surface.FENCE)
    footprints, heights = _add_country(builder, street, terrain, layout, rng)
    return City(builder.build(), terrain, street, footprints, heights, [street])


def build_corridor(street: RouteCurve, terrain: Terrain, layout: Layout, rng: np.random.Generator) -> City:
    """Build a street between two smooth noise barriers, without features for more than 100 m at a time.

    Only the openings between the barriers, with houses, trees and lamps, make the position along the street observable.
    """
    builder = MeshBuilder()
    add_strip(builder, street, terrain, [0.0, 2.0, layout.road, layout.band], rng)
    add_ground(builder, [street], terrain, layout, rng, 1.2, VERGE)
    inside = layout.band - 0.3
    middles = rng.uniform(-10, 0) + np.cumsum(rng.uniform(*OPENINGS, int(street.length / OPENINGS[0]) + 1))
    openings = middles[middles < street.length - OPENING] if layout.poles else middles[:0]
    ends = np.concatenate([[0.0], np.sort(np.append(openings - OPENING / 2, openings + OPENING / 2)), [street.length]])
    footprints, heights = [], []
    for side in (1, -1):
        for start, end in ends.reshape(-1, 2):
            s = np.append(np.arange(start, end - 1.0, 2.0), end)
            add_wall(builder, street, terrain, s, side * inside, WALL_HEIGHT_M, Surface.WALL)
            near, far = street.beside(s, side * (inside - 0.2)), street.beside(s, side * (inside + 0.2))
            footprints.append(np.concatenate([near, far[::-1]]))
            heights.append(WALL_HEIGHT_M)
            for s_end in (start + 0.2, end - 0.2):
                low, high = [-0.25, -0.3, -0.5], [0.25, 0.3, WALL_HEIGHT_M + 0.1]
                _put(builder, street, terrain, s_end, side * inside, low, high, Surface.WALL)
        for middle in openings.tolist():
            outline, height = _fill_opening(builder, street, terrain, layout, middle, side, rng)
            footprints.append(outline)
            heights.append(height)
    return City(builder.build(), terrain, street, footprints, heights, [street])


def _fill_opening(
    builder: MeshBuilder,
    street: RouteCurve,
    terrain: Terrain,
    layout: Layout,
    s: float,
    side: int,
    rng: np.random.Generator,
) -> tuple[Floats, float]:
    """Add a house behind an opening of the barrier, and lamps, a cabinet and two trees before it.

    Returns the house's outline and height.
    """
    for lamp in (s + rng.uniform(-12, -6), s + rng.uniform(6, 12)):
        _put(builder, street, terrain, lamp, side * layout.band, [-0.08, -0.08, -0.3], [0.08, 0.08, 7.0], Surface.POLE)
    low, high = [-0.6, -0.25, -0.3], [0.6, 0.25, 1.5]
    _put(builder, street, terrain, s + rng.uniform(-4, 4), side * (layout.band + 0.5), low, high, Surface.FENCE)
    for tree in (s + rng.uniform(-11, -3), s + rng.uniform(3, 11)):
        xy = street.beside(np.array([tree]), side * (layout.band + rng.uniform(2.5, 4.0)))[0]
        builder.add_mesh(furniture.tree(rng, layout.volumes), [*xy, float(terrain.height(xy))])
    width, depth = rng.uniform(*layout.house_width), rng.uniform(*layout.house_depth)
    return add_house(
        builder, street, terrain, layout, s + rng.uniform(-5, 5), side * (layout.band + 7.0), width, depth, rng
    )


def add_house(
    builder: MeshBuilder,
    street: RouteCurve,
    terrain: Terrain,
    layout: Layout,
    s: float,
    offset: float,
    width: float,
    depth: float,
    rng: np.random.Generator,
) -> tuple[Floats, float]:
    """Add a house that faces the street, its front `offset` m to the left. Returns its outline (4, 2) and height."""
    at, side = np.array([s]), np.sign(offset)
    front, tangent = street.beside(at, offset)[0], side * street.tangent(at)[0]
    inward, half = np.array([-tangent[1], tangent[0]]), width / 2 * tangent
    building = house(rng, width, depth, layout.storeys)
    builder.add_mesh(building, [*front, float(terrain.height(front))], float(portable.arctan2(tangent[1], tangent[0])))
    outline = np.array([front - half, front + half, front + half + depth * inward, front - half + depth * inward])
    return outline, float(building.vertices[:, 2].max())


def add_strip(
    builder: MeshBuilder, street: RouteCurve, terrain: Terrain, half: list[float], rng: np.random.Generator
) -> None:
    """Add a road without kerbs, as wide as the largest of `half`, m, on both sides."""
    s = street.sample(1.0)
    offsets = np.array([-d for d in half[:0:-1]] + half)
    xy = np.stack([street.beside(s, d) for d in offsets])
    z = terrain.height(xy) + rng.normal(0, 0.003, xy.shape[:2])
    vertices = np.concatenate([xy, z[..., None]], -1).reshape(-1, 3)
    builder.add(vertices, grid_faces(len(offsets), len(s)), Surface.ROAD)


def _add_rail(builder: MeshBuilder, street: RouteCurve, terrain: Terrain, offset: float) -> None:
    """Add a guard rail: a band along the road and a post every 4 m."""
    add_wall(builder, street, terrain, street.sample(4.0), offset, RAIL[1], Surface.FENCE, RAIL[0], 0.1)
    for s in street.sample(4.0):
        _put(builder, street, terrain, s, offset, [-0.05, -0.05, -0.3], [0.05, 0.05, RAIL[1]], Surface.POLE)


def add_wall(
    builder: MeshBuilder,
    street: RouteCurve,
    terrain: Terrain,
    s: Floats,
    offset: float,
    top: float,
    surface: Surface,
    bottom: float = -1.0,
    thickness: float = 0.4,
) -> None:
    """Add a wall along the street, `offset` m to its left, from `bottom` to `top` m above the ground."""
    rows = []
    for side, edge in ((-0.5, bottom), (-0.5, top), (0.5, top), (0.5, bottom)):
        xy = street.beside(s, offset + side * thickness)
        rows.append(np.column_stack([xy, terrain.height(street.beside(s, offset)) + edge]))
    builder.add(np.concatenate(rows), grid_faces(4, len(s)), surface)


def _put(
    builder: MeshBuilder,
    street: RouteCurve,
    terrain: Terrain,
    s: float,
    offset: float,
    low: list[float],
    high: list[float],
    surface: Surface,
) -> None:
    """Add a box in the street's frame, `s` m along and `offset` m to the left."""
    part = MeshBuilder()
    part.add_box(low, high, surface)
    at = np.array([s])
    xy, tangent = street.beside(at, offset)[0], street.tangent(at)[0]
    yaw = float(portable.arctan2(tangent[1], tangent[0]))
    builder.add_mesh(part.build(), [*xy, float(terrain.height(xy))], yaw)


def _add_gantry(builder: MeshBuilder, street: RouteCurve, terrain: Terrain, s: float, reach: float) -> None:
    """Add a bridge of signs over the right carriageway."""
    for offset in (-reach, 0.0):
        _put(builder, street, terrain, s, offset, [-0.2, -0.2, -0.5], [0.2, 0.2, 7.2], Surface.POLE)
    _put(builder, street, terrain, s, 0.0, [-0.25, -reach, 6.6], [0.25, 0.0, 7.2], Surface.POLE)
    _put(builder, street, terrain, s, -0.5 * reach, [-0.35, -3.0, 5.6], [-0.25, 3.0, 8.0], Surface.FENCE)


def _add_country(
    builder: MeshBuilder, street: RouteCurve, terrain: Terrain, layout: Layout, rng: np.random.Generator
) -> tuple[list[Floats], list[float]]:
    """Add clumps of trees, bushes, and a few farms. Returns outlines and heights of the farms."""
    footprints, heights = [], []
    for s in np.arange(5.0, street.length, 9.0):
        if rng.random() < layout.trees:
            for _ in range(int(rng.integers(1, 5))):
                side = 1 if rng.random() < 0.5 else -1
                xy = street.beside(
                    np.array([s + rng.uniform(-6, 6)]), side * rng.uniform(layout.band + 6, layout.band + 38)
                )[0]
                part = (
                    furniture.tree(rng, layout.volumes)
                    if rng.random() < 0.7
                    else furniture.hedge(rng, rng.uniform(3, 12), layout.volumes)
                )
                builder.add_mesh(part, [*xy, float(terrain.height(xy))], rng.uniform(0, np.pi))
    for s in np.arange(60.0, street.length, 150.0):
        side, width, depth = (
            (1 if rng.random() < 0.5 else -1),
            rng.uniform(*layout.house_width),
            rng.uniform(*layout.house_depth),
        )
        outline, height = add_house(builder, street, terrain, layout, s, side * rng.uniform(48, 58), width, depth, rng)
        footprints.append(outline)
        heights.append(height)
    return footprints, heights


def build_woods(street: RouteCurve, terrain: Terrain, layout: Layout, rng: np.random.Generator) -> City:
    """Build a path through woods or a park along `street`; the same generator state gives the same woods.

    Of `layout` it takes the road's half width and verge (`pavement`), `garden_trees` per 5 m of way and side, of which the
    share `trees` grows, and hedges beside the way by the share of `gardens`; bins and lamps; a house by `openings`.
    """
    builder = MeshBuilder()
    half = sorted({0.0, 0.5 * layout.road, layout.road, layout.band})
    add_strip(builder, street, terrain, half, rng)
    add_ground(builder, [street], terrain, layout, rng, 0.6 * layout.pavement, VERGE)
    way = street.position(street.sample(0.5))
    footprints, heights = _add_lodges(builder, street, terrain, layout, rng, way)
    _add_hedges(builder, street, terrain, layout, rng)
    _add_trees(builder, street, terrain, layout, rng, way, footprints)
    _add_things(builder, street, terrain, layout, rng)
    return City(builder.build(), terrain, street, footprints, heights, [street])


def _add_trees(
    builder: MeshBuilder,
    street: RouteCurve,
    terrain: Terrain,
    layout: Layout,
    rng: np.random.Generator,
    way: Floats,
    footprints: list[Floats],
) -> None:
    """Add random trees and bushes, denser near the path, none on it or in a house."""
    from scipy.spatial import cKDTree

    count = int(layout.garden_trees * street.length / 5.0)
    tree, taken = cKDTree(way), np.zeros((0, 2))
    houses = np.array([[*f.mean(axis=0), np.linalg.norm(f - f.mean(axis=0), axis=1).max()] for f in footprints])
    for side in (1, -1):
        for s in np.sort(rng.uniform(0, street.length, count)):
            offset = layout.band + NEAREST_TRUNK_M + DEEP * rng.uniform() ** 1.5
            xy = street.beside(np.array([s]), side * offset)[0]
            part = furniture.tree(rng, layout.volumes)
            if rng.random() >= layout.trees or float(tree.query(xy)[0]) < layout.band + NEAREST_TRUNK_M:
                continue
            if len(taken) and portable.hypot(*(taken[-64:] - xy).T).min() < TRUNKS_APART_M:
                continue
            if len(houses) and (portable.hypot(*(houses[:, :2] - xy).T) < houses[:, 2] + 1.5).any():
                continue
            taken = np.concatenate([taken, xy[None]])
            builder.add_mesh(part, [*xy, float(terrain.height(xy)) + VERGE], rng.uniform(0, 2 * np.pi))


def _add_hedges(
    builder: MeshBuilder, street: RouteCurve, terrain: Terrain, layout: Layout, rng: np.random.Generator
) -> None:
    """Add hedges along both edges of the path."""
    for side in (1, -1):
        for s in np.arange(HEDGE, street.length - HEDGE, HEDGE):
            if rng.random() >= layout.gardens:
                continue
            at, length = np.array([s + rng.uniform(-2, 2)]), rng.uniform(0.4, 0.8) * HEDGE
            xy, tangent = street.beside(at, side * (layout.band + 0.8))[0], street.tangent(at)[0]
            yaw = float(portable.arctan2(tangent[1], tangent[0]))
            part = furniture.hedge(rng, length, layout.volumes)
            builder.add_mesh(part, [*xy, float(terrain.height(xy)) + VERGE], yaw)


def _add_things(
    builder: MeshBuilder, street: RouteCurve, terrain: Terrain, layout: Layout, rng: np.random.Generator
) -> None:
    """Add lamps and bins beside the path."""
    for is_there, part, apart in ((layout.poles, furniture.pole, 35.0), (layout.bins, furniture.bins, 60.0)):
        for s in np.arange(0.5 * apart, street.length, apart) if is_there else ():
            side = 1 if rng.random() < 0.5 else -1
            at = np.array([s + rng.uniform(-8, 8)])
            xy = street.beside(np.clip(at, 0, street.length), side * (layout.band + 0.4))[0]
            builder.add_mesh(part(rng), [*xy, float(terrain.height(xy)) + VERGE], rng.uniform(0, 2 * np.pi))


def _add_lodges(
    builder: MeshBuilder, street: RouteCurve, terrain: Terrain, layout: Layout, rng: np.random.Generator, way: Floats
) -> tuple[list[Floats], list[float]]:
    """Add a few houses, clear of every bend of the path. Returns outlines and heights."""
    footprints: list[Floats] = []
    heights: list[float] = []
    for s in np.arange(0.5 * LODGES, street.length, LODGES):
        width, depth = rng.uniform(*layout.house_width), rng.uniform(*layout.house_depth)
        offset = (1 if rng.random() < 0.5 else -1) * (layout.band + rng.uniform(*layout.setback))
        along = np.clip(np.array([s + rng.uniform(-20, 20)]), 0, street.length)
        if rng.random() >= layout.openings:
            continue
        middle = street.beside(along, offset + np.sign(offset) * depth / 2)[0]
        if portable.hypot(*(way - middle).T).min() < 0.5 * portable.hypot(width, depth) + layout.band:
            continue
        outline, height = add_house(builder, street, terrain, layout, float(along[0]), offset, width, depth, rng)
        footprints.append(outline)
        heights.append(height)
    return footprints, heights
