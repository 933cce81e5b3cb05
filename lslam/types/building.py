"""Buildings: outlines on level ground, with a height where somebody measured one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.geometry import se2

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Footprint:
    """One outline with its courtyards, in a level local frame (x east, y north), m.

    outer : (K, 2) float64 counter-clockwise, the first corner not repeated; holes : (H, 2) each, clockwise
    """

    outer: Floats
    holes: tuple[Floats, ...] = ()

    @property
    def rings(self) -> tuple[Floats, ...]:
        """The outline and its holes; on all of them the outside is to the right of the way along the ring."""
        return (self.outer, *self.holes)

    @property
    def area(self) -> float:
        """Ground covered, m2, holes subtracted."""
        return float(sum(_signed_area(ring) for ring in self.rings))

    def moved(self, rotation: Floats, shift: Floats) -> Footprint:
        """Every corner p at `rotation` (2, 2) p + `shift` (2,)."""
        return Footprint(self.outer @ rotation.T + shift, tuple(hole @ rotation.T + shift for hole in self.holes))


@dataclass(frozen=True)
class Building:
    """One element of a map: usually one footprint, several where a multipolygon has several outlines.

    osm_id : `way/123` or `relation/5`; negative numbers are in no OpenStreetMap database
    height : m above the ground, roof included, None when unknown; base : m above the ground where the walls begin
    tags : the element's own, for example `building`, `roof:shape`
    """

    osm_id: str
    footprints: tuple[Footprint, ...]
    height: float | None = None
    base: float = 0.0
    tags: Mapping[str, str] = field(default_factory=dict)

    @property
    def area(self) -> float:
        """Ground covered, m2."""
        return sum(footprint.area for footprint in self.footprints)

    @property
    def middle(self) -> Floats:
        """(2,) middle of the box round all outlines, m: what the building is turned about."""
        corners = np.concatenate([footprint.outer for footprint in self.footprints])
        return np.asarray((corners.min(0) + corners.max(0)) / 2)

    def moved(self, rotation: Floats, shift: Floats) -> Building:
        """Every corner p at `rotation` (2, 2) p + `shift` (2,)."""
        return replace(self, footprints=tuple(footprint.moved(rotation, shift) for footprint in self.footprints))

    def displaced(self, displacement: Floats) -> Building:
        """Turned by displacement[2], rad, about its middle, then shifted by displacement[:2], m."""
        return self.moved(*about(self.middle, displacement))


def about(middle: Floats, displacement: Floats) -> tuple[Floats, Floats]:
    """Rotation (2, 2) and shift (2,) of a `displacement` (3,) x, y, yaw, m and rad, that turns about `middle` (2,)."""
    R = se2.rotation(float(displacement[2]))
    return R, middle - R @ middle + displacement[:2]


def is_canopy(building: Building) -> bool:
    """True for a roof on posts, which has no walls to see."""
    return building.tags.get("building") in ("roof", "carport")


def footprint_polygon(footprint: Footprint) -> Any:
    """The shapely polygon of one footprint."""
    from shapely import Polygon

    return Polygon(footprint.outer, footprint.holes)


def footprints_of(geometry: Any) -> tuple[Footprint, ...]:
    """Footprints of a shapely geometry's polygons, rings turned the right way, slivers under 0.01 m2 left out."""
    from shapely.geometry.polygon import orient

    polygons: Iterable[Any] = getattr(geometry, "geoms", [geometry])
    found = []
    for polygon in polygons:
        if polygon.geom_type == "Polygon" and polygon.area > 0.01:
            turned = orient(polygon)
            rings = [np.array(ring.coords, np.float64)[:-1, :2] for ring in (turned.exterior, *turned.interiors)]
            found.append(Footprint(rings[0], tuple(rings[1:])))
    return tuple(found)


def _signed_area(ring: Floats) -> float:
    x, y = (ring - ring[0]).T
    return float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) / 2)
