"""Where leaves are all there is: a road or a path through trees, bushes, hedges and high grass, on ground without a kerb."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.simulation import furniture
from lslam.simulation.city import City, Layout, add_ground
from lslam.simulation.countryside import VERGE, add_house, add_strip
from lslam.simulation.curve import RouteCurve
from lslam.simulation.scene_mesh import MeshBuilder
from lslam.simulation.terrain import Terrain

Floats = NDArray[np.float64]

DEEP = 32.0  # m on both sides in which trees stand
APART = 1.1  # m from one trunk to the next, at least
NEAREST = 1.0  # m from the edge of the way
HEDGE = 12.0  # m of way for every hedge that may stand beside it
LODGES = 90.0  # m of way from one house to the next


def build_woods(street: RouteCurve, terrain: Terrain, layout: Layout, rng: np.random.Generator) -> City:
    """A way through woods or a park along `street`; the same generator state gives the same woods.

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
    builder: MeshBuilder, street: RouteCurve, terrain: Terrain, layout: Layout, rng: np.random.Generator, way: Floats,
    footprints: list[Floats],
) -> None:  # fmt: skip
    """Trees and bushes at random, more of them near the way, where they get light; none on it or in a house."""
    from scipy.spatial import cKDTree

    count = int(layout.garden_trees * street.length / 5.0)
    tree, taken = cKDTree(way), np.zeros((0, 2))
    houses = np.array([[*f.mean(axis=0), np.linalg.norm(f - f.mean(axis=0), axis=1).max()] for f in footprints])
    for side in (1, -1):
        for s in np.sort(rng.uniform(0, street.length, count)):
            offset = layout.band + NEAREST + DEEP * rng.uniform() ** 1.5
            xy = street.beside(np.array([s]), side * offset)[0]
            part = furniture.tree(rng, layout.volumes)
            if rng.random() >= layout.trees or float(tree.query(xy)[0]) < layout.band + NEAREST:
                continue
            if len(taken) and np.hypot(*(taken[-64:] - xy).T).min() < APART:
                continue
            if len(houses) and (np.hypot(*(houses[:, :2] - xy).T) < houses[:, 2] + 1.5).any():
                continue
            taken = np.concatenate([taken, xy[None]])
            builder.add_mesh(part, [*xy, float(terrain.height(xy)) + VERGE], rng.uniform(0, 2 * np.pi))


def _add_hedges(
    builder: MeshBuilder, street: RouteCurve, terrain: Terrain, layout: Layout, rng: np.random.Generator
) -> None:
    """Hedges along both edges of the way."""
    for side in (1, -1):
        for s in np.arange(HEDGE, street.length - HEDGE, HEDGE):
            if rng.random() >= layout.gardens:
                continue
            at, length = np.array([s + rng.uniform(-2, 2)]), rng.uniform(0.4, 0.8) * HEDGE
            xy, tangent = street.beside(at, side * (layout.band + 0.8))[0], street.tangent(at)[0]
            yaw = float(np.arctan2(tangent[1], tangent[0]))
            part = furniture.hedge(rng, length, layout.volumes)
            builder.add_mesh(part, [*xy, float(terrain.height(xy)) + VERGE], yaw)


def _add_things(
    builder: MeshBuilder, street: RouteCurve, terrain: Terrain, layout: Layout, rng: np.random.Generator
) -> None:
    """Lamps and bins beside the way."""
    for is_there, part, apart in ((layout.poles, furniture.pole, 35.0), (layout.bins, furniture.bins, 60.0)):
        for s in np.arange(0.5 * apart, street.length, apart) if is_there else ():
            side = 1 if rng.random() < 0.5 else -1
            at = np.array([s + rng.uniform(-8, 8)])
            xy = street.beside(np.clip(at, 0, street.length), side * (layout.band + 0.4))[0]
            builder.add_mesh(part(rng), [*xy, float(terrain.height(xy)) + VERGE], rng.uniform(0, 2 * np.pi))


def _add_lodges(
    builder: MeshBuilder, street: RouteCurve, terrain: Terrain, layout: Layout, rng: np.random.Generator, way: Floats
) -> tuple[list[Floats], list[float]]:
    """A house now and then, where it keeps off every bend of the way; outlines and heights."""
    footprints: list[Floats] = []
    heights: list[float] = []
    for s in np.arange(0.5 * LODGES, street.length, LODGES):
        width, depth = rng.uniform(*layout.house_width), rng.uniform(*layout.house_depth)
        offset = (1 if rng.random() < 0.5 else -1) * (layout.band + rng.uniform(*layout.setback))
        along = np.clip(np.array([s + rng.uniform(-20, 20)]), 0, street.length)
        if rng.random() >= layout.openings:
            continue
        middle = street.beside(along, offset + np.sign(offset) * depth / 2)[0]
        if np.hypot(*(way - middle).T).min() < 0.5 * np.hypot(width, depth) + layout.band:
            continue
        outline, height = add_house(builder, street, terrain, layout, float(along[0]), offset, width, depth, rng)
        footprints.append(outline)
        heights.append(height)
    return footprints, heights
