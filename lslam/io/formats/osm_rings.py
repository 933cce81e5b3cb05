"""Rings of OpenStreetMap areas: parts joined end to end, outlines and courtyards made into valid footprints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.types.building import Footprint, footprints_of

Floats = NDArray[np.float64]
NodeIds = tuple[int, ...]


def join_rings(parts: Sequence[NodeIds]) -> list[NodeIds] | None:
    """Closed rings of node numbers (first = last) from parts in any order and direction; None when they do not close.

    Where more than two open parts meet in one node, the way back to the ring's start is preferred.
    """
    rings = [part for part in parts if part[0] == part[-1]]
    rest = [part for part in parts if part[0] != part[-1]]
    while rest:
        ring = rest.pop(0)
        while ring[0] != ring[-1]:
            touching = [k for k, part in enumerate(rest) if ring[-1] in (part[0], part[-1])]
            if not touching:
                return None
            closing = [k for k in touching if ring[0] in (rest[k][0], rest[k][-1])]
            part = rest.pop((closing or touching)[0])
            ring += part[1:] if part[0] == ring[-1] else part[-2::-1]
        rings.append(ring)
    return rings


def footprints_from_rings(outers: Sequence[Floats], inners: Sequence[Floats]) -> tuple[Footprint, ...]:
    """Footprints of the outlines (K, 2), m, minus the inner rings; corners stay as they are wherever the rings are valid.

    Rings that cross themselves or each other are repaired (shapely's make_valid); nothing is left of rings without area.
    """
    from shapely import make_valid, union_all

    outlines = [p for ring in outers if (p := _polygon(ring)) is not None]
    holes = [p for ring in inners if (p := _polygon(ring)) is not None]
    plain = _plain(outlines, holes)
    if plain is not None:
        return plain
    ground = union_all([make_valid(p) for p in outlines])
    return footprints_of(_polygonal(ground.difference(union_all([make_valid(p) for p in holes]))))


def _plain(outlines: list[Any], holes: list[Any]) -> tuple[Footprint, ...] | None:
    """The usual case, corner for corner: valid outlines apart from each other, each hole inside one of them."""
    from shapely import MultiPolygon, Polygon

    inside: list[list[Any]] = [[] for _ in outlines]
    for hole in holes:
        owner = next((k for k, outline in enumerate(outlines) if outline.is_valid and outline.covers(hole)), None)
        if owner is None:
            return None
        inside[owner].append(hole.exterior)
    polygons = [Polygon(outline.exterior, held) for outline, held in zip(outlines, inside, strict=True)]
    return footprints_of(MultiPolygon(polygons)) if MultiPolygon(polygons).is_valid else None


def _polygon(ring: Floats) -> Any | None:
    """A shapely polygon without repeated corners; None with fewer than three."""
    from shapely import Polygon

    corners = ring[np.linalg.norm(ring - np.roll(ring, 1, axis=0), axis=1) > 1e-6]
    return Polygon(corners) if len(corners) >= 3 else None


def _polygonal(geometry: Any) -> Any:
    """Only the areas of a geometry, flat: repair leaves lines and points behind, and nests collections."""
    from shapely import MultiPolygon

    parts = [geometry]
    areas = []
    while parts:
        part = parts.pop(0)
        if part.geom_type == "Polygon":
            areas.append(part)
        else:
            parts.extend(getattr(part, "geoms", ()))
    return MultiPolygon(areas)
