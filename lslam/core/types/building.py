"""Buildings: outlines on level ground, with a height where somebody measured one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from math import erf, sqrt
from typing import Any, Literal

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.geometry import se2
from lslam.core.types.constraint import Verdict

MatchKind = Literal["edges", "lines", "none"]
# `seen`: scans hold it; `unseen`: no scan says anything, it follows the map; `absent`: scans look through where it should be.
BuildingStatus = Literal["seen", "unseen", "absent"]
INLIER_M = 0.5  # m; what `BuildingCorrection.confidence` counts as in its place


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

    def transform(self, rotation: Floats, shift: Floats) -> Footprint:
        """The outline with every corner p moved to `rotation` (2, 2) p + `shift` (2,), m."""
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

    def transform(self, rotation: Floats, shift: Floats) -> Building:
        """The building with every corner p moved to `rotation` (2, 2) p + `shift` (2,), m."""
        return replace(self, footprints=tuple(footprint.transform(rotation, shift) for footprint in self.footprints))

    def displace(self, displacement: Floats) -> Building:
        """The building rotated by displacement[2], rad, about its middle, then shifted by displacement[:2], m."""
        return self.transform(*about(self.middle, displacement))


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
    """Footprints of a shapely geometry's polygons, rings oriented as `Footprint` needs, without slivers under 0.01 m2."""
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
    """Signed area, m2, of a ring (K, 2), positive counter-clockwise."""
    x, y = (ring - ring[0]).T
    return float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) / 2)


@dataclass(frozen=True)
class KeyframeMatch:
    """The walls seen about one keyframe, laid on all buildings near: Del Tufo's global match.

    walls : (S, 2, 2) segments seen, m, level frame, the outside to the right; views : (V, 2) the sensor's places there
    prior : (3,) where the run expected the keyframe in the map frame; sigma : (3,) how well, m, m, rad
    pose : (3,) where the walls put it, the prior where there is no match
    information : (3, 3) of `pose` in the axes of the map, 1/m2 and 1/rad2, singular along what the walls leave free
    rank : directions it fixes, 0 to 3; kind : `edges` walls of two directions, `lines` parallel ones, `none` no match
    fitness, coverage, rms : as of `osm.wall_match.WallMatch`, NaN without a match
    pairs : (K, 2) which wall seen lies on which wall of the map, numbers of `map_walls` of the run's `OsmMatches`
    verdict, reason : whether it constrains the trajectory, and why not, one clause
    """

    keyframe: int
    walls: Floats
    views: Floats
    prior: Floats
    sigma: Floats
    pose: Floats
    information: Floats
    rank: int = 0
    kind: MatchKind = "none"
    fitness: float = float("nan")
    coverage: float = float("nan")
    rms: float = float("nan")
    pairs: Longs = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    verdict: Verdict = Verdict.REJECTED
    reason: str = ""

    @property
    def is_accepted(self) -> bool:
        """Whether it constrains the trajectory."""
        return self.verdict == Verdict.ACCEPTED


@dataclass(frozen=True)
class BuildingMatch:
    """One building's walls laid on the walls seen about one keyframe: Del Tufo's local match, of use to the buildings only.

    building : number among the buildings of the run's `OsmMatches`
    pose : (3,) of the building in the level frame of the keyframe: its axes are the map's and its origin is
        `Building.middle`, as OpenStreetMap has it, so that it does not matter where the keyframe is thought to be
    information : (3, 3) of `pose` in the axes of that level frame, singular along what the walls leave free
    pairs : (K, 2) which of the building's walls (rows of `osm.walls.walls_of([building])`) lies on which wall seen
    """

    keyframe: int
    building: int
    pose: Floats
    information: Floats
    rank: int
    kind: MatchKind
    fitness: float
    coverage: float
    rms: float
    pairs: Longs
    verdict: Verdict = Verdict.ACCEPTED
    reason: str = ""

    @property
    def is_accepted(self) -> bool:
        """Whether it constrains its building."""
        return self.verdict == Verdict.ACCEPTED

    def displacement(self, keyframe: Floats, middle: Floats) -> Floats:
        """(3,) by which the building moves, turned about its `middle` (2,), when the keyframe is at `keyframe` (3,)."""
        pose = se2.compose(keyframe, self.pose)
        return np.asarray(pose - [middle[0], middle[1], 0.0])


@dataclass(frozen=True)
class OsmMatches:
    """All matches of a run.

    origin : (3,) lat, lon (deg), height (m) of the map frame
    buildings : those that came near; map_walls : (T, 2, 2) their walls, m, map frame; owners : (T,) number of each's building
    keyframes : one per keyframe that was looked at; local : of every building near each of them that is partly seen
    shift : (2,) m by which the run found OpenStreetMap to lie off as a whole (true minus map), and its sigma, m
    source : of messages; attribution : what outputs have to carry, None where nobody surveyed the map
    """

    origin: Floats
    buildings: tuple[Building, ...]
    map_walls: Floats
    owners: Longs
    keyframes: tuple[KeyframeMatch, ...]
    local: tuple[BuildingMatch, ...]
    shift: Floats = field(default_factory=lambda: np.zeros(2))
    shift_sigma: Floats = field(default_factory=lambda: np.full(2, np.inf))
    source: str = ""
    attribution: str | None = None

    @property
    def accepted_matches(self) -> list[KeyframeMatch]:
        """The matches that constrain the trajectory."""
        return [match for match in self.keyframes if match.is_accepted]


@dataclass(frozen=True)
class BuildingCorrection:
    """One building of the map and its real place.

    building : as on the map, m, map frame
    displacement : (3,) x, y (m), yaw (rad) about the building's `middle`, real minus map
    covariance : (3, 3) of it, m2 and rad2
    used_matches, rejected_matches : with walls seen that hold it, and that were given up
    """

    building: Building
    displacement: Floats
    covariance: Floats
    status: BuildingStatus
    used_matches: int = 0
    rejected_matches: int = 0

    @property
    def real_building(self) -> Building:
        """The building where it really stands."""
        return self.building.displace(self.displacement)

    @property
    def confidence(self) -> float:
        """Probability that the building stands within `INLIER_M` m of its estimated place, along both axes of its uncertainty."""
        variances = np.maximum(np.linalg.eigvalsh(self.covariance[:2, :2]), 1e-12)
        return float(np.prod([erf(INLIER_M / sqrt(2 * v)) for v in variances]))


@dataclass(frozen=True)
class CorrectedMap:
    """All buildings of a run.

    origin : (3,) lat, lon (deg), height (m) of the map frame, x east, y north
    mode : `osm.mode` they were corrected in; shift : (2,) m by which the map is off as a whole, real minus map
    new_walls : (S, 2, 2) m, map frame: walls seen where no building is
    overlaps : pairs of positions in `buildings` that overlap and could not be parted
    attribution : what outputs have to carry, None where nobody surveyed the map
    """

    origin: Floats
    buildings: tuple[BuildingCorrection, ...]
    mode: str
    shift: Floats = field(default_factory=lambda: np.zeros(2))
    new_walls: Floats = field(default_factory=lambda: np.zeros((0, 2, 2)))
    overlaps: tuple[tuple[int, int], ...] = ()
    attribution: str | None = None
