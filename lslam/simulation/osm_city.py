"""A city built from the buildings of a map, on uneven ground, with roads and street furniture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.errors import InputError
from lslam.core.geometry import portable
from lslam.core.types.building import Building, Footprint, footprint_polygon, is_canopy
from lslam.simulation.city import (
    KERB,
    MARGIN_M,
    City,
    Layout,
    Lots,
    StreetSite,
    add_garden_trees,
    add_road,
    add_street_furniture,
)
from lslam.simulation.curve import RouteCurve, Terrain
from lslam.simulation.scene_mesh import MeshBuilder, Surface
from lslam.simulation.town import CAR_LENGTH, Network, Places

GROUND_CELL_M = 1.0  # m, of the ground
MOST_CELLS = 1_500_000
BESIDE_KERB = 0.05  # m that the grass ends below the pavement
UNDER_ROAD = 0.2  # m that the ground lies lower where a road covers it
AIR = {True: 1.0, False: 0.5}  # m between walls and a parked car, or anything else
FOUNDATION_M = 0.5  # m, walls reach below the lowest ground at their foot
STOREY_M = 3.0  # m
PARAPET = 0.4  # m of wall above a flat roof
OVERHANG = 0.3  # m, eaves beyond the walls
SLAB = 0.2  # m, the roof of a canopy
GABLE_SHAPES = ("gabled", "hipped", "half-hipped", "saltbox")  # tags whose roof is drawn with two slopes
FLAT = ("flat", "skillion", "round", "dome")


@dataclass(frozen=True)
class OsmCity(City):
    """A `City` with its buildings; x is east and y north of the extract's origin.

    buildings : as built, every one with a height; attribution : what outputs made from it must carry (ODbL), if anything
    source : the file it was made from
    """

    buildings: list[Building] = field(default_factory=list)
    attribution: str | None = None
    source: str = "a map"


def build_osm_city(
    buildings: Sequence[Building],
    terrain: Terrain,
    rng: np.random.Generator,
    streets: Sequence[RouteCurve] = (),
    layout: Layout | None = None,
    attribution: str | None = None,
    source: str = "a map",
) -> OsmCity:
    """Build the city of `buildings` (m, x east, y north) on `terrain`. The same generator state gives the same city.

    A building's look does not depend on its neighbours. Heights that the map lacks are drawn at random. `streets` : axes
    of the roads to pave and furnish by `layout`, the main one first; without, all ground is lawn. Raises InputError when
    there are no buildings.
    """
    if not buildings:
        raise InputError("a city needs at least one building: the OpenStreetMap extract gives none here")
    builder, layout, roads = MeshBuilder(), layout or Layout(), list(streets)
    built = _raise_buildings(builder, buildings, terrain, int(rng.integers(2**32)))
    network = Network(roads) if roads else None
    _add_ground(builder, built, terrain, network, layout.band, rng)
    outlines = [(footprint.outer, building.height or 0.0) for building in built for footprint in building.footprints]
    if network is not None:
        _furnish(StreetSite(builder, roads[0], terrain, layout, rng), network, outlines)
    return OsmCity(
        builder.build(),
        terrain,
        roads[0] if roads else None,
        [outer for outer, _ in outlines],
        [height for _, height in outlines],
        roads,
        buildings=built,
        attribution=attribution,
        source=source,
    )


def _raise_buildings(
    builder: MeshBuilder, buildings: Sequence[Building], terrain: Terrain, seed: int
) -> list[Building]:
    """Add all buildings to `builder`; returns them with heights, drawn by `seed` and number where the map has none."""
    built = []
    for building in buildings:
        kind, number = building.osm_id.split("/")
        own = np.random.default_rng([seed, kind == "relation", int(number) < 0, abs(int(number))])
        height = building.height if building.height is not None else building.base + likely_height(building, own)
        building = replace(building, height=height)
        corners = np.concatenate([ring for footprint in building.footprints for ring in footprint.rings])
        ground = terrain.height(corners)
        extrude(builder, building, float(ground.min()), float(ground.max()), own)
        built.append(building)
    return built


def _add_ground(
    builder: MeshBuilder,
    buildings: list[Building],
    terrain: Terrain,
    network: Network | None,
    band: float,
    rng: np.random.Generator,
) -> None:
    """Add a grid of grass, lower where a road covers it, with larger cells under a whole district.

    network : of the streets, None without; band : m, half the width that a street covers
    """
    places = [footprint.outer for building in buildings for footprint in building.footprints]
    places += [street.position(street.sample(2.0)) for street in (network.streets if network else ())]
    everything = np.concatenate(places)
    low, high = everything.min(0) - MARGIN_M, everything.max(0) + MARGIN_M
    cell = max(GROUND_CELL_M, float(np.sqrt(np.prod(high - low) / MOST_CELLS)))
    x, y = (np.arange(low[k], high[k] + cell, cell) for k in (0, 1))
    xy = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    z = terrain.height(xy) + rng.normal(0, 0.01, xy.shape[:2])
    if network is not None:
        # No hole is cut, so that no ray falls through where the strips of two roads meet at an angle.
        z += KERB - BESIDE_KERB - UNDER_ROAD * (network.distance(xy) < band - 0.3)
    builder.add_grid(xy, z, Surface.LAWN)


def _furnish(site: StreetSite, network: Network, outlines: list[tuple[Floats, float]]) -> None:
    """Add roads with kerbs, and beside them cars, trees, poles and bins; outlines : (N, 2), m, of houses, and heights."""
    sites = [site.along(street) for street in network.streets]
    for road in sites:
        add_road(road, network.distance)
    is_free = _Gaps(network, site.layout, [outer for outer, _ in outlines])
    for road in sites:
        for side in (1, -1):
            add_street_furniture(road, side, is_free)
    lots = Lots(network.streets, site.layout)
    for outer, height in outlines:
        lots.take(outer, height)
    add_garden_trees(site, lots)


class _Gaps:
    """Test of free places beside a road: clear of other roads, of objects there and of walls."""

    def __init__(self, network: Network, layout: Layout, outlines: list[Floats]) -> None:
        from shapely import Polygon, STRtree

        self._places, self._road = Places(network, layout), layout.road
        self._walls = STRtree([Polygon(outer) for outer in outlines])

    def __call__(self, xy: Floats, offset: float, yaw: float) -> bool:
        """Whether an object at `xy` (2,), `offset` m from the road's axis, has room; then it is recorded as occupied.

        yaw : rad, along which a car is long; what stands on the road is a car
        """
        from shapely import points

        is_car = offset < self._road
        half = 0.5 * CAR_LENGTH * is_car * np.array([portable.cos(yaw), portable.sin(yaw)])
        ends = points(np.stack([xy - half, xy, xy + half]))
        near = self._walls.query(ends, predicate="dwithin", distance=AIR[is_car])
        return near.size == 0 and self._places(xy, offset, yaw)


@dataclass(frozen=True)
class _FacadeStyle:
    """What the facades of one building share, m."""

    window: float
    spacing: float
    sill: float
    head: float
    recess: float
    pitch: float
    likes_gables: bool


def likely_height(building: Building, rng: np.random.Generator) -> float:
    """Plausible height, m, for a building without height tags: small ones are garages, large ones have more storeys."""
    if building.area < 45:
        return round(float(rng.uniform(2.4, 3.0)), 1)
    return STOREY_M * float(rng.integers(2, 4 if building.area < 250 else 6))


def extrude(builder: MeshBuilder, building: Building, low: float, high: float, rng: np.random.Generator) -> None:
    """Add a building of known height to `builder`, in the frame of its footprints.

    low, high : m, lowest and highest ground along its outlines; heights count from `high`, walls reach below `low`
    """
    if building.height is None:
        raise ValueError(f"{building.osm_id} has no height: choose one first")
    style = _FacadeStyle(
        window=rng.uniform(0.9, 1.5),
        spacing=rng.uniform(2.2, 3.4),
        sill=rng.uniform(0.7, 1.0),
        head=rng.uniform(2.0, 2.4),
        recess=rng.uniform(0.12, 0.3),
        pitch=rng.uniform(0.5, 0.9),
        likes_gables=bool(rng.random() < 0.6),
    )
    top, base = high + building.height, high + building.base
    for footprint in building.footprints:
        if is_canopy(building):
            _canopy(builder, footprint, low - FOUNDATION_M, top)
            continue
        bottom = base if building.base > 0 else low - FOUNDATION_M
        gable = _gable(building, footprint, style)
        eaves = top if gable is None else top - gable.rise
        for ring in footprint.rings:
            for start, end in zip(ring, np.roll(ring, -1, axis=0), strict=True):
                _facade(builder, style, start, end, (bottom, base, eaves))
        if gable is None:
            _level(builder, footprint, top - min(PARAPET, 0.2 * building.height))
        else:
            _gabled_roof(builder, gable, eaves)
        if building.base > 0:
            _level(builder, footprint, bottom)


def _facade(
    builder: MeshBuilder, style: _FacadeStyle, start: Floats, end: Floats, levels: tuple[float, float, float]
) -> None:
    """Add a wall from `start` to `end` (2,), its outside to the right, with the heights `levels` from bottom to top."""
    bottom, floor, top = levels
    length = float(portable.norm(end - start))
    along = (end - start) / length
    outward = np.array([along[1], -along[0]])

    def quads(u0: Any, u1: Any, z: tuple[Any, Any, Any, Any], in0: Any, in1: Any) -> Floats:
        """(N, 4, 3) quads between u0 and u1, m along the wall, at heights z of the corners, inset at both ends, m."""
        u0, u1, *rest = np.broadcast_arrays(u0, u1, *z, in0, in1)
        z0, z1, z2, z3, i0, i1 = (np.ravel(v) for v in rest)

        def at(u: Any, inset: Any, height: Any) -> Floats:
            return np.column_stack([start + np.ravel(u)[:, None] * along - inset[:, None] * outward, height])

        return np.stack([at(u0, i0, z0), at(u1, i1, z1), at(u1, i1, z2), at(u0, i0, z3)], axis=1)

    count = int((length - 1.0) // style.spacing)
    storeys = int((top - floor - 0.2) // STOREY_M)
    if count < 1 or storeys < 1:
        builder.add_quads(quads(0.0, length, (bottom, bottom, top, top), 0.0, 0.0), Surface.WALL)
        return
    centres = length / 2 + (np.arange(count) - (count - 1) / 2) * style.spacing
    left, right = centres - style.window / 2, centres + style.window / 2
    sills = (floor + style.sill + STOREY_M * np.arange(storeys))[:, None]
    heads = sills + (style.head - style.sill)
    bands = np.append(bottom, heads), np.append(sills, top)
    r = style.recess
    walls = [
        quads(0.0, length, (bands[0], bands[0], bands[1], bands[1]), 0.0, 0.0),
        quads(np.append(0.0, right), np.append(left, length), (sills, sills, heads, heads), 0.0, 0.0),
        quads(left, left, (sills, sills, heads, heads), 0.0, r),
        quads(right, right, (sills, sills, heads, heads), 0.0, r),
    ]
    for z in (sills, heads):
        # Level: the far side lies behind the wall.
        near, far = quads(left, right, (z, z, z, z), 0.0, 0.0), quads(left, right, (z, z, z, z), r, r)
        walls.append(np.concatenate([near[:, :2], far[:, 1::-1]], axis=1))
    builder.add_quads(np.concatenate(walls), Surface.WALL)
    builder.add_quads(quads(left, right, (sills, sills, heads, heads), r, r), Surface.GLASS)


@dataclass(frozen=True)
class _Gable:
    """Roof of a nearly rectangular outline: four corners, with short sides 0-1 and 2-3, and the ridge's height above them, m."""

    corners: Floats
    rise: float


def _gable(building: Building, footprint: Footprint, style: _FacadeStyle) -> _Gable | None:
    """Gabled roof of a building with a suitable outline, None for a flat roof."""
    shape = building.tags.get("roof:shape", "")
    if footprint.holes or shape in FLAT or not (shape in GABLE_SHAPES or style.likes_gables):
        return None
    polygon = footprint_polygon(footprint).simplify(0.02)
    corners = np.array(polygon.exterior.coords)[:-1]
    if len(corners) != 4 or polygon.area < 0.9 * polygon.minimum_rotated_rectangle.area:
        return None
    sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    if sides[0] + sides[2] > sides[1] + sides[3]:
        corners, sides = np.roll(corners, -1, axis=0), np.roll(sides, -1)
    span, height = min(sides[0], sides[2]), (building.height or 0.0) - building.base
    # Halls have no gables; under the eaves people stand, and most of a house is wall.
    rise = min(span / 2 * style.pitch, height - 2.2, 0.4 * height)
    return _Gable(corners, rise) if span < 16 and rise > 0.5 else None


def _gabled_roof(builder: MeshBuilder, gable: _Gable, eaves: float) -> None:
    """Add two slopes that overhang the walls and two gables above the short sides."""
    a, b, c, d = gable.corners
    ridge = np.array([(a + b) / 2, (c + d) / 2])
    top = eaves + gable.rise
    gables = [[*a, eaves], [*b, eaves], [*ridge[0], top], [*c, eaves], [*d, eaves], [*ridge[1], top]]
    builder.add(np.array(gables), np.arange(6).reshape(2, 3), Surface.WALL)
    axis = (ridge[1] - ridge[0]) / portable.norm(ridge[1] - ridge[0])
    ends = ridge + OVERHANG * np.array([-axis, axis])
    for first, second in ((a, d), (b, c)):
        out = [corner - middle for corner, middle in zip((first, second), ridge, strict=True)]
        share = [OVERHANG / float(portable.norm(o)) for o in out]
        eave = [end + (1 + k) * o for end, o, k in zip(ends, out, share, strict=True)]
        drops = [eaves - k * gable.rise for k in share]
        slope = [[*eave[0], drops[0]], [*eave[1], drops[1]], [*ends[1], top], [*ends[0], top]]
        builder.add_quads([slope], Surface.ROOF)


def _level(builder: MeshBuilder, footprint: Footprint, z: float) -> None:
    """Add the footprint as a level surface at height `z`, m."""
    from shapely import constrained_delaunay_triangles, get_coordinates

    triangles = constrained_delaunay_triangles(footprint_polygon(footprint))
    corners = get_coordinates(triangles).reshape(-1, 4, 2)[:, :3].reshape(-1, 2)
    vertices = np.column_stack([corners, np.full(len(corners), z)])
    builder.add(vertices, np.arange(len(corners)).reshape(-1, 3), Surface.ROOF)


def _canopy(builder: MeshBuilder, footprint: Footprint, bottom: float, top: float) -> None:
    """Add a slab on posts, open on all sides; bottom, top : m, feet of the posts and upper side of the slab."""
    for z in (top - SLAB, top):
        _level(builder, footprint, z)
    for ring in footprint.rings:
        following = np.roll(ring, -1, axis=0)
        rim = [
            np.column_stack([p, np.full(len(p), z)])
            for z, p in zip((top - SLAB, top - SLAB, top, top), (ring, following, following, ring), strict=True)
        ]
        builder.add_quads(np.stack(rim, axis=1), Surface.ROOF)
    inner = footprint_polygon(footprint).buffer(-0.4, join_style="mitre").simplify(1.0)
    polygons = [p for p in getattr(inner, "geoms", [inner]) if not p.is_empty]
    for polygon in polygons:
        for x, y in np.array(polygon.exterior.coords)[:-1]:
            builder.add_box([x - 0.1, y - 0.1, bottom], [x + 0.1, y + 0.1, top - SLAB], Surface.POLE)
