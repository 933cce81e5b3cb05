"""A town generated along a street: road with kerbs, uneven ground, two rows of houses, gardens, trees, poles, parked cars."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from pydantic import Field, model_validator

from lslam.core.arrays import Floats
from lslam.core.config.input import Section
from lslam.core.geometry import portable
from lslam.simulation import furniture
from lslam.simulation.curve import RouteCurve, Terrain
from lslam.simulation.scene_mesh import MeshBuilder, SceneMesh, Surface, grid_faces, grid_vertices

KERB = 0.12  # m
MARGIN_M = 60.0  # m of ground beyond the street on every side


class Layout(Section):
    """Measures of a street, m: half the road's width, the pavement's width, the second row's distance behind the first;
    ranges of what varies from house to house.

    parked, trees : share of the places beside the road that hold a car or a tree; openings : share of houses followed by a
    wide gap; gardens : share of front gardens with a hedge or a wall; garden_trees : attempts per 5 m of street
    poles, bins : whether there are any; identical : every house and pole is the same, at even distances
    volumes : crowns and hedges are volumes of leaves and some trees are bushes; what leaves do to beams is said in `returns`
    camber : fall of the road from its middle to the kerbs, m/m
    """

    road: float = Field(4.5, ge=2, le=30)
    pavement: float = Field(2.0, ge=0.5, le=10)
    second_row: float = Field(16.0, ge=8, le=100)
    house_width: tuple[float, float] = (8.0, 15.0)
    house_depth: tuple[float, float] = (7.0, 11.0)
    gap: tuple[float, float] = (0.3, 4.5)
    setback: tuple[float, float] = (0.3, 5.0)
    storeys: tuple[int, int] = (2, 4)
    parked: float = Field(0.42, ge=0, le=1)
    trees: float = Field(0.6, ge=0, le=1)
    openings: float = Field(0.08, ge=0, le=1)
    gardens: float = Field(0.7, ge=0, le=1)
    garden_trees: int = Field(3, ge=0, le=20)
    poles: bool = True
    bins: bool = True
    identical: bool = False
    volumes: bool = False
    camber: float = Field(0.0, ge=0, le=0.1)

    @model_validator(mode="after")
    def _check_ranges(self) -> Layout:
        """Raise ValueError for a range in the wrong order or too small."""
        for name, least in (("house_width", 3), ("house_depth", 3), ("gap", 0), ("setback", 0), ("storeys", 1)):
            low, high = getattr(self, name)
            if not least <= low <= high:
                raise ValueError(f"layout.{name} = [{low:g}, {high:g}], expected two numbers from {least} up, in order")
        return self

    @property
    def band(self) -> float:
        """Distance from the middle of the road to the outer edge of the pavement, m."""
        return self.road + self.pavement


@dataclass(frozen=True)
class City:
    """A scene in one city frame (x, y level, z up, m).

    street : the middle of the road along which it was built, when there is one; streets : all of them
    footprints : outlines of the buildings, each (K, 2); heights : of their tops above the ground at the door, m
    """

    mesh: SceneMesh
    terrain: Terrain
    street: RouteCurve | None = None
    footprints: list[Floats] = field(default_factory=list)
    heights: list[float] = field(default_factory=list)
    streets: list[RouteCurve] = field(default_factory=list)


@dataclass(frozen=True)
class StreetSite:
    """A place while it is built along a street: its mesh so far, its ground, its measures, and the generator of what varies."""

    builder: MeshBuilder
    street: RouteCurve
    terrain: Terrain
    layout: Layout
    rng: np.random.Generator

    @classmethod
    def begin(cls, street: RouteCurve, terrain: Terrain, layout: Layout, rng: np.random.Generator) -> StreetSite:
        """An empty place along a street."""
        return cls(MeshBuilder(), street, terrain, layout, rng)

    def along(self, street: RouteCurve) -> StreetSite:
        """The same place, seen along another street: distances and offsets refer to that one."""
        return replace(self, street=street)

    def beside(self, s: float, offset: float) -> Floats:
        """(2,) position `s` m along the street and `offset` m to its left."""
        return np.asarray(self.street.beside(np.array([s]), offset)[0])

    def yaw(self, s: float, side: int = 1) -> float:
        """Heading, rad, of the street `s` m along it; for side -1 the opposite heading."""
        tangent = self.street.tangent(np.array([s]))[0] * side
        return float(portable.arctan2(tangent[1], tangent[0]))

    def stand(self, part: SceneMesh, xy: Floats, yaw: float = 0.0, lift: float = 0.0) -> None:
        """Stand a mesh at a position (2,), `lift` m above the terrain."""
        self.builder.add_mesh(part, [*xy, float(self.terrain.height(xy)) + lift], yaw)


def build_city(street: RouteCurve, terrain: Terrain, layout: Layout, rng: np.random.Generator) -> City:
    """Build a town along `street`. The same generator state gives the same town."""
    site = StreetSite.begin(street, terrain, layout, rng)
    add_road(site)
    add_ground(site, [street], 0.75 * layout.pavement)
    lots = Lots([street], layout)
    for side in (1, -1):
        add_row(site, lots, side, first=True)
    for side in (1, -1):
        add_row(site, lots, side, first=False)
        add_street_furniture(site, side)
    add_garden_trees(site, lots)
    return City(site.builder.build(), terrain, street, lots.footprints, lots.heights, [street])


class Lots:
    """Occupied ground: the streets and the houses so far."""

    def __init__(self, streets: list[RouteCurve], layout: Layout) -> None:
        from shapely import LinearRing, LineString, Polygon, prepare, union_all

        self.streets = streets
        lines = [(LinearRing if s.closed else LineString)(s.position(s.sample(1.0))) for s in streets]
        bands = [line.buffer(layout.band + 0.2) for line in lines]
        self.corridor = bands[0] if len(bands) == 1 else union_all(bands)
        prepare(self.corridor)
        self.polygon = Polygon
        self.taken: list[Any] = []
        self.footprints: list[Floats] = []
        self.heights: list[float] = []
        self._circles = np.zeros((0, 3))

    def is_free(self, corners: Floats) -> bool:
        """True when a polygon (K, 2) overlaps neither a street nor a house."""
        polygon = self.polygon(corners)
        if self.corridor.intersects(polygon):
            return False
        x, y, reach = _circle(corners)
        near = portable.hypot(self._circles[:, 0] - x, self._circles[:, 1] - y) <= self._circles[:, 2] + reach
        return not any(self.taken[i].intersects(polygon) for i in np.flatnonzero(near))

    def take(self, corners: Floats, height: float) -> None:
        """Mark the ground of a building as occupied."""
        self.taken.append(self.polygon(corners))
        self.footprints.append(corners)
        self.heights.append(height)
        self._circles = np.concatenate([self._circles, [_circle(corners)]])


def _circle(corners: Floats) -> tuple[float, float, float]:
    """Middle and radius of a circle round a polygon (K, 2)."""
    middle = corners.mean(axis=0)
    return float(middle[0]), float(middle[1]), float(np.linalg.norm(corners - middle, axis=1).max())


def add_road(site: StreetSite, away: Callable[[Floats], Floats] | None = None) -> None:
    """Add road, kerbs and pavements as one strip along the street.

    away : returns the distance of positions (..., 2) to the nearest road axis, m; where another road crosses there is no kerb
    """
    street, layout = site.street, site.layout
    s = street.sample(0.75)
    if street.closed:
        s = np.append(s, 0.0)
    between = [] if away is None else [0.5 * (layout.road + layout.band)]
    half = [0.0, 1.5, 3.0, layout.road, layout.road + 0.02, *between, layout.band]
    offsets = np.array([-d for d in half[:0:-1]] + half)
    xy = np.stack([street.beside(s, d) for d in offsets])
    raised = np.broadcast_to(np.abs(offsets)[:, None] > layout.road + 0.01, xy.shape[:2])
    if away is not None:
        raised = raised & (away(xy) > layout.road + 0.005)
    rough = site.rng.normal(0, 0.003, xy.shape[:2])
    if street.closed:
        rough[:, -1] = rough[:, 0]
    z = site.terrain.height(xy) + KERB * raised + rough
    if layout.camber:
        z += (layout.camber * np.maximum(layout.road - np.abs(offsets), 0.0))[:, None]
    faces = grid_faces(*z.shape)
    kinds = np.where(raised.ravel()[faces].any(axis=1), Surface.PAVEMENT, Surface.ROAD).astype(np.uint8)
    site.builder.add(grid_vertices(xy, z), faces, kinds)


def add_ground(site: StreetSite, streets: list[RouteCurve], overlap: float, level: float = KERB - 0.07) -> None:
    """Add grass everywhere except on `streets`, `level` m above the terrain.

    It extends `overlap` m under pavements, or under roads without any. The level is a little below theirs, so that their edge
    is visible and no grass pokes through.
    """
    from scipy.spatial import cKDTree

    middle = np.concatenate([street.position(street.sample(0.5)) for street in streets])
    low, high = middle.min(0) - MARGIN_M, middle.max(0) + MARGIN_M
    x, y = (np.arange(low[k], high[k] + 1.0, 1.0) for k in (0, 1))
    xy = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    z = site.terrain.height(xy) + level + site.rng.normal(0, 0.015, xy.shape[:2])
    nearest = np.asarray(cKDTree(middle).query(xy.reshape(-1, 2), distance_upper_bound=site.layout.band)[0])
    under_road = nearest < site.layout.band - overlap
    faces = grid_faces(*z.shape)
    site.builder.add(grid_vertices(xy, z), faces[~under_road[faces].any(axis=1)], Surface.LAWN)


def add_row(site: StreetSite, lots: Lots, side: int, first: bool) -> None:
    """Add houses along one side of the street (1 left, -1 right), where there is room; first : at the street, or behind."""
    street, layout, rng = site.street, site.layout, site.rng
    s, setback = rng.uniform(0, 4), rng.uniform(*layout.setback)
    while s < street.length:
        width = rng.uniform(*layout.house_width)
        depth = rng.uniform(*layout.house_depth)
        if rng.random() < 0.35:
            setback = rng.uniform(*layout.setback)
        back = setback + (0.0 if first else layout.second_row + rng.uniform(0, 8))
        offset = layout.band + 0.3 + back
        # Outside a bend there is more frontage than street, inside less.
        bend = float(street.curvature(np.array([min(s, street.length)]))[0])
        along = 1 / np.clip(1 - side * offset * bend, 0.6, 3.0)
        position, tangent = _front(street, s + along * width / 2, side, offset)
        yaw = float(portable.arctan2(tangent[1], tangent[0]))
        is_built = False
        # Most places are taken, and where the shallowest house has no room none has.
        for share in (1.0, 0.8, 0.65) if lots.is_free(lot(position, tangent, width, 0.65 * depth)) else ():
            corners = lot(position, tangent, width, share * depth)
            if share == 0.65 or lots.is_free(corners):
                plan = np.random.default_rng(1) if layout.identical else rng
                building = furniture.house(plan, width, share * depth, layout.storeys)
                lots.take(corners, float(building.vertices[:, 2].max()))
                site.stand(building, position, yaw, KERB)
                if first and setback > 1.8:
                    _add_front_garden(site, width, setback, position, yaw)
                is_built = True
                break
        opening = 9.0 if first and rng.random() < layout.openings else rng.uniform(*layout.gap)
        s += along * (width + opening) if is_built else 1.0


def _front(street: RouteCurve, s: float, side: int, offset: float) -> tuple[Floats, Floats]:
    """Middle of a house's front (2,), `offset` m from the street's middle, and the unit vector (2,) along it."""
    at = np.array([min(s, street.length)])
    tangent = street.tangent(at)[0]
    return street.position(at)[0] + side * offset * np.array([-tangent[1], tangent[0]]), tangent * side


def lot(front: Floats, tangent: Floats, width: float, depth: float) -> Floats:
    """Outline (4, 2) of a house behind the middle `front` (2,) of its front, along the unit vector `tangent` (2,)."""
    inward = np.array([-tangent[1], tangent[0]])
    half = width / 2 * tangent
    return np.array([front - half, front + half, front + half + depth * inward, front - half + depth * inward])


def _add_front_garden(site: StreetSite, width: float, setback: float, front: Floats, yaw: float) -> None:
    """Perhaps add a hedge or low wall on a plot of `width` m, `setback` m before the house's front (2,), m, at `yaw`."""
    rng = site.rng
    kind = rng.random()
    if kind > site.layout.gardens:
        return
    length, across = width * rng.uniform(0.5, 0.95), -(setback - 0.2)
    shift = rng.uniform(-0.5, 0.5) * (width - length)
    c, s = portable.cos(yaw), portable.sin(yaw)
    ground = float(site.terrain.height(front)) + KERB
    place = np.array([*front, ground]) + np.array([c * shift - s * across, s * shift + c * across, 0])
    part = furniture.hedge(rng, length, site.layout.volumes) if kind < 0.4 else furniture.garden_wall(rng, length)
    site.builder.add_mesh(part, place, yaw)


def add_street_furniture(
    site: StreetSite, side: int, is_free: Callable[[Floats, float, float], bool] | None = None
) -> None:
    """Add parked cars, trees, poles and bins along one side; `is_free`: has an object at (2,), offset, m, and yaw, room?"""
    street, layout, rng = site.street, site.layout, site.rng

    def place(part: SceneMesh, s: float, offset: float, lift: float, turn: float = 0.0) -> None:
        xy, yaw = site.beside(s, side * offset), site.yaw(s, side) + turn
        if is_free is None or is_free(xy, offset, yaw):
            site.stand(part, xy, yaw, lift)

    for s in _stations(rng, street.length, 5.6, 8.0):
        # Nobody parks in a bend.
        if rng.random() < layout.parked and abs(float(street.curvature(np.array([s]))[0])) < 0.06:
            turn = rng.normal(0, 0.02) + (np.pi if rng.random() < 0.2 else 0.0)
            place(furniture.parked_car(rng), s, layout.road - 1.05 + rng.uniform(-0.12, 0.12), 0.0, turn)
    for s in _stations(rng, street.length, 8.0, 15.0):
        if rng.random() < layout.trees:
            place(furniture.tree(rng, layout.volumes), s, layout.road + 0.7, KERB)
    for s in _stations(rng, street.length, 14.0, 30.0) if layout.poles and not layout.identical else ():
        place(furniture.pole(rng), s, layout.road + 0.4, KERB, np.pi)
    for s in np.arange(7.0, street.length, 28.0) if layout.poles and layout.identical else ():
        place(furniture.pole(np.random.default_rng(1)), float(s), layout.road + 0.4, KERB, np.pi)
    for s in _stations(rng, street.length, 18.0, 40.0) if layout.bins else ():
        place(furniture.bins(rng), s, layout.band - 0.5, KERB)


def add_garden_trees(site: StreetSite, lots: Lots) -> None:
    """Add trees wherever a random place is free."""
    count, rng = site.layout.garden_trees, site.rng
    if not count:
        return
    middle = np.concatenate([street.position(street.sample(5.0)) for street in lots.streets])
    for place in middle.repeat(count, axis=0) + rng.uniform(-35, 35, (count * len(middle), 2)):
        corners = place + 1.2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        if lots.is_free(corners):
            site.stand(furniture.tree(rng, site.layout.volumes), place, lift=KERB)


def _stations(rng: np.random.Generator, length: float, shortest: float, longest: float) -> Floats:
    """Distances along a street, `shortest` to `longest` m apart."""
    steps = rng.uniform(shortest, longest, int(length / shortest) + 2)
    s = np.cumsum(steps) - steps[0] / 2
    return np.asarray(s[s < length - shortest / 2])
