"""Places with few features: a motorway through fields, a corridor between plain walls, woods, and an open car park."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.errors import UsageError
from lslam.core.geometry import portable
from lslam.simulation import furniture
from lslam.simulation.city import City, Layout, StreetSite, add_ground, lot
from lslam.simulation.curve import RouteCurve, Terrain, smooth_curve
from lslam.simulation.scene_mesh import MeshBuilder, Surface, grid_faces

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
# A LiDAR's beam of 3 mrad lights a spot some 3 cm wide and 20 cm long on the ground 10 m away: smaller bumps it averages.
BUMP = 0.25  # m from one bump of the car park's ground to the next
BUMPS_M = 35.0  # m round the path with every bump: as far as rays 3 deg below level meet the ground
COARSE = 1.0  # m between bumps farther away
MOST_BUMPS = 4_000_000  # bumps that fit into memory
MARGIN_M = 80.0  # m of ground round the path: to behind the houses
ENDS = 40.0  # m that the wall of the car park goes on beyond the path
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
Houses = list[tuple[Floats, float]]  # outline (4, 2) and height of each, m


def _city(site: StreetSite, houses: Houses) -> City:
    """The city of what stands on the site; houses : outlines and heights."""
    outlines, heights = [outline for outline, _ in houses], [height for _, height in houses]
    return City(site.builder.build(), site.terrain, site.street, outlines, heights, [site.street])


def build_motorway(street: RouteCurve, terrain: Terrain, layout: Layout, rng: np.random.Generator) -> City:
    """Build two carriageways with guard rails, delineators, gantries and a noise barrier; beyond them trees and bushes."""
    site = StreetSite.begin(street, terrain, layout, rng)
    _add_strip(site, [0.0, 3.0, 6.0, 9.0, layout.road, layout.band])
    add_ground(site, [street], 1.2, VERGE)
    for offset in (-layout.road - 0.6, 0.0, layout.road + 0.6):
        _add_rail(site, offset)
    for s in np.arange(10.0, street.length, 50.0):
        for side in (1, -1):
            _add_box(site, s, side * (layout.road + 1.2), [-0.06, -0.06, -0.3], [0.06, 0.06, 1.0], Surface.POLE)
    for s in np.arange(90.0, street.length, 240.0):
        _add_gantry(site, s + rng.uniform(-40, 40), layout.road + 1.4)
    barrier = rng.uniform(0.3, 0.5) * street.length
    s = np.arange(barrier, min(barrier + 0.15 * street.length, street.length), 4.0)
    _add_wall(site, s, -layout.band - 2.5, rng.uniform(2.5, 4.0), Surface.FENCE)
    return _city(site, _add_country(site))


def build_corridor(street: RouteCurve, terrain: Terrain, layout: Layout, rng: np.random.Generator) -> City:
    """Build a street between two smooth noise barriers, without features for more than 100 m at a time.

    Only the openings between the barriers, with houses, trees and lamps, make the position along the street observable.
    """
    site = StreetSite.begin(street, terrain, layout, rng)
    _add_strip(site, [0.0, 2.0, layout.road, layout.band])
    add_ground(site, [street], 1.2, VERGE)
    inside = layout.band - 0.3
    middles = rng.uniform(-10, 0) + np.cumsum(rng.uniform(*OPENINGS, int(street.length / OPENINGS[0]) + 1))
    openings = middles[middles < street.length - OPENING] if layout.poles else middles[:0]
    ends = np.concatenate([[0.0], np.sort(np.append(openings - OPENING / 2, openings + OPENING / 2)), [street.length]])
    houses: Houses = []
    for side in (1, -1):
        for start, end in ends.reshape(-1, 2):
            s = np.append(np.arange(start, end - 1.0, 2.0), end)
            _add_wall(site, s, side * inside, WALL_HEIGHT_M, Surface.WALL)
            near, far = street.beside(s, side * (inside - 0.2)), street.beside(s, side * (inside + 0.2))
            houses.append((np.concatenate([near, far[::-1]]), WALL_HEIGHT_M))
            for s_end in (start + 0.2, end - 0.2):
                low, high = [-0.25, -0.3, -0.5], [0.25, 0.3, WALL_HEIGHT_M + 0.1]
                _add_box(site, s_end, side * inside, low, high, Surface.WALL)
        houses += [_fill_opening(site, middle, side) for middle in openings.tolist()]
    return _city(site, houses)


def _fill_opening(site: StreetSite, s: float, side: int) -> tuple[Floats, float]:
    """Add a house behind an opening at `s` m, side 1 or -1, and lamps, a cabinet, two trees; returns outline and height."""
    layout, rng = site.layout, site.rng
    for lamp in (s + rng.uniform(-12, -6), s + rng.uniform(6, 12)):
        _add_box(site, lamp, side * layout.band, [-0.08, -0.08, -0.3], [0.08, 0.08, 7.0], Surface.POLE)
    low, high = [-0.6, -0.25, -0.3], [0.6, 0.25, 1.5]
    _add_box(site, s + rng.uniform(-4, 4), side * (layout.band + 0.5), low, high, Surface.FENCE)
    for tree in (s + rng.uniform(-11, -3), s + rng.uniform(3, 11)):
        xy = site.beside(tree, side * (layout.band + rng.uniform(2.5, 4.0)))
        site.stand(furniture.tree(rng, layout.volumes), xy)
    width, depth = rng.uniform(*layout.house_width), rng.uniform(*layout.house_depth)
    return _add_house(site, s + rng.uniform(-5, 5), side * (layout.band + 7.0), width, depth)


def _add_house(site: StreetSite, s: float, offset: float, width: float, depth: float) -> tuple[Floats, float]:
    """Add a house that faces the street, its front `offset` m to the left. Returns its outline (4, 2) and height."""
    side = np.sign(offset)
    front, tangent = site.beside(s, offset), side * site.street.tangent(np.array([s]))[0]
    building = furniture.house(site.rng, width, depth, site.layout.storeys)
    site.stand(building, front, float(portable.arctan2(tangent[1], tangent[0])))
    return lot(front, tangent, width, depth), float(building.vertices[:, 2].max())


def _add_strip(site: StreetSite, half: list[float]) -> None:
    """Add a road without kerbs, as wide as the largest of `half`, m, on both sides."""
    s = site.street.sample(1.0)
    xy = np.stack([site.street.beside(s, d) for d in [-d for d in half[:0:-1]] + half])
    z = site.terrain.height(xy) + site.rng.normal(0, 0.003, xy.shape[:2])
    site.builder.add_grid(xy, z, Surface.ROAD)


def _add_rail(site: StreetSite, offset: float) -> None:
    """Add a guard rail: a band along the road and a post every 4 m."""
    _add_wall(site, site.street.sample(4.0), offset, RAIL[1], Surface.FENCE, RAIL[0], 0.1)
    for s in site.street.sample(4.0):
        _add_box(site, s, offset, [-0.05, -0.05, -0.3], [0.05, 0.05, RAIL[1]], Surface.POLE)


def _add_wall(
    site: StreetSite,
    s: Floats,
    offset: float,
    top: float,
    surface: Surface,
    bottom: float = -1.0,
    thickness: float = 0.4,
) -> None:
    """Add a wall along the street, `offset` m to its left, from `bottom` to `top` m above the ground."""
    rows, street = [], site.street
    for side, edge in ((-0.5, bottom), (-0.5, top), (0.5, top), (0.5, bottom)):
        xy = street.beside(s, offset + side * thickness)
        rows.append(np.column_stack([xy, site.terrain.height(street.beside(s, offset)) + edge]))
    site.builder.add(np.concatenate(rows), grid_faces(4, len(s)), surface)


def _add_box(site: StreetSite, s: float, offset: float, low: list[float], high: list[float], surface: Surface) -> None:
    """Add a box in the street's frame, `s` m along and `offset` m to the left."""
    part = MeshBuilder()
    part.add_box(low, high, surface)
    site.stand(part.build(), site.beside(s, offset), site.yaw(s))


def _add_gantry(site: StreetSite, s: float, reach: float) -> None:
    """Add a bridge of signs over the right carriageway."""
    for offset in (-reach, 0.0):
        _add_box(site, s, offset, [-0.2, -0.2, -0.5], [0.2, 0.2, 7.2], Surface.POLE)
    _add_box(site, s, 0.0, [-0.25, -reach, 6.6], [0.25, 0.0, 7.2], Surface.POLE)
    _add_box(site, s, -0.5 * reach, [-0.35, -3.0, 5.6], [-0.25, 3.0, 8.0], Surface.FENCE)


def _add_country(site: StreetSite) -> Houses:
    """Add clumps of trees, bushes, and a few farms. Returns outlines and heights of the farms."""
    layout, rng = site.layout, site.rng
    houses: Houses = []
    for s in np.arange(5.0, site.street.length, 9.0):
        if rng.random() < layout.trees:
            for _ in range(int(rng.integers(1, 5))):
                side = 1 if rng.random() < 0.5 else -1
                xy = site.beside(s + rng.uniform(-6, 6), side * rng.uniform(layout.band + 6, layout.band + 38))
                if rng.random() < 0.7:
                    part = furniture.tree(rng, layout.volumes)
                else:
                    part = furniture.hedge(rng, rng.uniform(3, 12), layout.volumes)
                site.stand(part, xy, rng.uniform(0, np.pi))
    for s in np.arange(60.0, site.street.length, 150.0):
        side = 1 if rng.random() < 0.5 else -1
        width, depth = rng.uniform(*layout.house_width), rng.uniform(*layout.house_depth)
        houses.append(_add_house(site, s, side * rng.uniform(48, 58), width, depth))
    return houses


def build_woods(street: RouteCurve, terrain: Terrain, layout: Layout, rng: np.random.Generator) -> City:
    """Build a path through woods or a park along `street`; the same generator state gives the same woods.

    `layout` defines the road's half width and verge (`pavement`), `garden_trees` per 5 m of way and side, of which the
    share `trees` grows, hedges along the way by the share of `gardens`, bins, lamps, and houses by `openings`.
    """
    site = StreetSite.begin(street, terrain, layout, rng)
    _add_strip(site, sorted({0.0, 0.5 * layout.road, layout.road, layout.band}))
    add_ground(site, [street], 0.6 * layout.pavement, VERGE)
    way = street.position(street.sample(0.5))
    houses = _add_lodges(site, way)
    _add_hedges(site)
    _add_trees(site, way, [outline for outline, _ in houses])
    _add_objects(site)
    return _city(site, houses)


def _add_trees(site: StreetSite, way: Floats, outlines: list[Floats]) -> None:
    """Add random trees and bushes, denser near the path `way` (N, 2), m, none on it or in `outlines` of houses."""
    from scipy.spatial import cKDTree

    layout, rng, length = site.layout, site.rng, site.street.length
    count = int(layout.garden_trees * length / 5.0)
    tree, trunks = cKDTree(way), np.zeros((0, 2))
    houses = np.array([[*f.mean(axis=0), np.linalg.norm(f - f.mean(axis=0), axis=1).max()] for f in outlines])
    for side in (1, -1):
        for s in np.sort(rng.uniform(0, length, count)):
            xy = site.beside(s, side * (layout.band + NEAREST_TRUNK_M + DEEP * rng.uniform() ** 1.5))
            part = furniture.tree(rng, layout.volumes)
            if rng.random() >= layout.trees or float(tree.query(xy)[0]) < layout.band + NEAREST_TRUNK_M:
                continue
            if len(trunks) and portable.hypot(*(trunks[-64:] - xy).T).min() < TRUNKS_APART_M:
                continue
            if len(houses) and (portable.hypot(*(houses[:, :2] - xy).T) < houses[:, 2] + 1.5).any():
                continue
            trunks = np.concatenate([trunks, xy[None]])
            site.stand(part, xy, rng.uniform(0, 2 * np.pi), VERGE)


def _add_hedges(site: StreetSite) -> None:
    """Add hedges along both edges of the path."""
    layout, rng = site.layout, site.rng
    for side in (1, -1):
        for s in np.arange(HEDGE, site.street.length - HEDGE, HEDGE):
            if rng.random() < layout.gardens:
                at, length = s + rng.uniform(-2, 2), rng.uniform(0.4, 0.8) * HEDGE
                part = furniture.hedge(rng, length, layout.volumes)
                site.stand(part, site.beside(at, side * (layout.band + 0.8)), site.yaw(at), VERGE)


def _add_objects(site: StreetSite) -> None:
    """Add lamps and bins beside the path."""
    layout, rng, length = site.layout, site.rng, site.street.length
    for is_there, part, apart in ((layout.poles, furniture.pole, 35.0), (layout.bins, furniture.bins, 60.0)):
        for s in np.arange(0.5 * apart, length, apart) if is_there else ():
            side = 1 if rng.random() < 0.5 else -1
            at = np.clip(s + rng.uniform(-8, 8), 0, length)
            xy = site.beside(at, side * (layout.band + 0.4))
            site.stand(part(rng), xy, rng.uniform(0, 2 * np.pi), VERGE)


def _add_lodges(site: StreetSite, way: Floats) -> Houses:
    """Add a few houses, clear of every bend of the path (N, 2), m. Returns outlines and heights."""
    layout, rng, length = site.layout, site.rng, site.street.length
    houses: Houses = []
    for s in np.arange(0.5 * LODGES, length, LODGES):
        width, depth = rng.uniform(*layout.house_width), rng.uniform(*layout.house_depth)
        offset = (1 if rng.random() < 0.5 else -1) * (layout.band + rng.uniform(*layout.setback))
        along = float(np.clip(s + rng.uniform(-20, 20), 0, length))
        if rng.random() >= layout.openings:
            continue
        middle = site.beside(along, offset + np.sign(offset) * depth / 2)
        if portable.hypot(*(way - middle).T).min() >= 0.5 * portable.hypot(width, depth) + layout.band:
            houses.append(_add_house(site, along, offset, width, depth))
    return houses


def build_carpark(
    line: RouteCurve, terrain: Terrain, layout: Layout, roughness: float, rng: np.random.Generator
) -> City:
    """Build a car park round the path `line`; `roughness` is the standard deviation of the ground's surface, m.

    Rough sloping ground, a low wall and trees on one side, distant houses on the other, a few cars. Objects are placed in order
    along x, each kind by its own generator, so a longer path has the same beginning. Raises UsageError for a path that is
    too long.
    """
    walls, trees, cars, houses, ground = rng.spawn(5)
    at = line.position(line.sample(0.5))
    low, high = at.min(axis=0), at.max(axis=0)
    middle, half = 0.5 * (low[1] + high[1]), 0.5 * float(high[1] - low[1])
    axis = smooth_curve(np.array([[low[0] - ENDS, middle], [high[0] + ENDS, middle]]), closed=False)
    side, away = (1 if walls.random() < 0.5 else -1), half + walls.uniform(*WALL_AWAY)
    site = StreetSite.begin(axis, terrain, layout, ground)
    _add_bumps(site, low, high, roughness)
    top = walls.uniform(*WALL_HEIGHTS_M)
    _add_wall(site, axis.sample(2.0), side * away, top, Surface.WALL, thickness=WALL_THICKNESS)
    _add_tree_row(replace(site, rng=trees), side * away)
    first = half + cars.uniform(*FIRST_ROW)
    rows = (side * (away - 1.0 - BAY_DEPTH / 2), -side * first, -side * (first + ROWS))
    for row, generator in zip(rows, cars.spawn(3), strict=True):
        _add_cars(replace(site, rng=generator), row)
    return _city(replace(site, street=line), _add_house_row(replace(site, rng=houses), -side, half))


def _add_bumps(site: StreetSite, low: Floats, high: Floats, roughness: float) -> None:
    """Add ground from `low` to `high` (2,), m, with random bumps, rms `roughness`, m.

    Raises UsageError where it would be too large.
    """
    x, y = (_grid_lines(float(low[k]), float(high[k])) for k in (0, 1))
    if len(x) * len(y) > MOST_BUMPS:
        raise UsageError(
            f"a car park of {np.ptp(x):.0f} x {np.ptp(y):.0f} m with a bump every {BUMP:g} m is too large: choose a shorter path"
        )
    xy = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    # Between three corners of variance v the variance of a triangle is v / 2 in the mean.
    z = site.terrain.height(xy) + site.rng.normal(0, np.sqrt(2) * roughness, xy.shape[:2])
    site.builder.add_grid(xy, z, Surface.ROAD)


def _grid_lines(low: float, high: float) -> Floats:
    """Coordinates of the ground's grid lines along one axis: dense up to `BUMPS_M` m beyond `low` and `high`."""
    count = int(np.ceil((high - low + 2 * BUMPS_M) / BUMP))
    fine = low - BUMPS_M + BUMP * np.arange(count + 1)
    beyond = np.arange(COARSE, MARGIN_M - BUMPS_M + COARSE, COARSE)
    return np.concatenate([fine[0] - beyond[::-1], fine, fine[-1] + beyond])


def _add_tree_row(site: StreetSite, wall: float) -> None:
    """Add a row of trees behind the wall, which is `wall` m to the left of the axis."""
    layout, rng = site.layout, site.rng
    s = rng.uniform(*TREES_APART)
    while s < site.street.length:
        offset = wall + np.sign(wall) * rng.uniform(*TREES_BEHIND)
        if rng.random() < layout.trees:
            xy = site.beside(s, offset)
            site.stand(furniture.tree(rng, layout.volumes), xy)
        s += rng.uniform(*TREES_APART)


def _add_cars(site: StreetSite, offset: float) -> None:
    """Add a row of parking bays across the axis, their middles `offset` m to its left; some hold a car."""
    rng, end = site.rng, site.street.length
    for block in np.arange(0.0, end, BLOCK):
        is_used, length = rng.random() < IN_USE, rng.uniform(*ROW)
        first = block + rng.uniform(0, BLOCK - length)
        for s in np.arange(first, first + length, BAY_WIDTH) if is_used else ():
            if rng.random() < site.layout.parked and s < end:
                xy = site.beside(s, offset + rng.uniform(-0.2, 0.2))
                yaw = (1 if rng.random() < 0.5 else -1) * np.pi / 2 + rng.normal(0, 0.03)
                site.stand(furniture.parked_car(rng), xy, yaw)


def _add_house_row(site: StreetSite, side: int, half: float) -> Houses:
    """Add houses that face the car park, `layout.setback` m from the path. Returns their outlines and heights.

    side : 1 left of the street, -1 right; half : half the width of the car park, m
    """
    layout, rng = site.layout, site.rng
    houses: Houses = []
    s = rng.uniform(0, layout.gap[1])
    while True:
        width, depth = rng.uniform(*layout.house_width), rng.uniform(*layout.house_depth)
        if s + width > site.street.length:
            return houses
        front = side * (half + rng.uniform(*layout.setback))
        houses.append(_add_house(site, s + width / 2, front, width, depth))
        s += width + rng.uniform(*layout.gap)
