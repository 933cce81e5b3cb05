"""Matches of seen walls with a map: per keyframe its pose on the map, per building its real place.

Map frame: east, north, m, from the origin of the run's georeference, the buildings as OpenStreetMap has them. Level frame of
a keyframe: at its LiDAR, z up, x the LiDAR's heading. Planar poses are (3,) x, y (m), yaw (rad) (`geometry.se2`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lslam.geometry import se2
from lslam.types.building import Building
from lslam.types.constraint import Verdict

Floats = NDArray[np.float64]

MatchKind = Literal["edges", "lines", "none"]


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
    pairs: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 2), np.int64))
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
    pairs: NDArray[np.int64]
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
    owners: NDArray[np.int64]
    keyframes: tuple[KeyframeMatch, ...]
    local: tuple[BuildingMatch, ...]
    shift: Floats = field(default_factory=lambda: np.zeros(2))
    shift_sigma: Floats = field(default_factory=lambda: np.full(2, np.inf))
    source: str = ""
    attribution: str | None = None

    @property
    def accepted(self) -> list[KeyframeMatch]:
        """The matches that constrain the trajectory."""
        return [match for match in self.keyframes if match.is_accepted]
