"""The second level: with the trajectory fixed, the displacement of every building is estimated from sightings of its walls.

The interface of matchers, `BuildingFitter`, and the matcher of walls are here as well.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from lslam.backend.graph.building_graph import (
    BuildingSolution,
    JointSolution,
    MapPrior,
    agreeing,
    optimise_jointly,
    solve_buildings,
)
from lslam.backend.graph.drift import with_drift
from lslam.backend.graph.problem import PoseGraph, Solution
from lslam.backend.outcome import BackEndInput
from lslam.core.arrays import Bools, Floats
from lslam.core.config import Config
from lslam.core.config.backend import OsmConfig
from lslam.core.geometry import se2
from lslam.core.stopping import checking
from lslam.core.types.building import (
    Building,
    BuildingCorrection,
    BuildingMatch,
    BuildingStatus,
    CorrectedMap,
    KeyframeMatch,
    OsmMatches,
    footprint_polygon,
    is_canopy,
)
from lslam.io.formats.osm_buildings import BuildingExtract
from lslam.io.formats.osm_data import OsmData
from lslam.io.formats.osm_files import write_osm
from lslam.osm.buildings_geojson import corrected_osm, write_buildings_geojson
from lslam.osm.kernels import wall_matching
from lslam.osm.overlap import Separation, remove_overlaps
from lslam.osm.wall_match import LIKENESS
from lslam.osm.walls import BUILDING_RATIO, planar_sigmas, walls_of

VIEWS = 3  # keyframes that must agree
SEEN_WALL_M = 1.5  # m; a building with walls seen within it of its outline is not absent
WALL_STEP_M = 1.0  # m between the points of a wall that rays are drawn to
ABSENT_WALLS_M = 3.0  # m; least length of walls seen through an absent building
LEAST_DEPTH_M = 0.5  # m that a ray must pass inside an outline at least
ONE_LINE = 0.5  # m; walls seen within it of one line are merged
ONE_WAY = np.sin(np.radians(10.0))
NEW_WALL_M = 6.0  # m; least length of a new wall, longer than a hedge, a van or a sign
log = logging.getLogger("lslam")
BUILDINGS_GEOJSON, BUILDINGS_OSM = "buildings.geojson", "buildings.osm"
# m and rad; prior sigmas of a building that moves with all others only.
TOGETHER = np.array([1e-3, 1e-3, 1e-5])


@dataclass(frozen=True)
class _PlacedView:
    """Walls (S, 2, 2) seen about a keyframe and the positions (V, 2) of the sensor there, m, map frame."""

    keyframe: int
    walls: Floats
    views: Floats


def absent_buildings(
    buildings: Sequence[Building], sights: Sequence[KeyframeMatch], poses: Mapping[int, Floats]
) -> Bools:
    """Whether each building (B,) is absent: no wall is seen near its outline, and `VIEWS` keyframes see walls through it.

    A canopy, which is open below, is never absent.
    buildings : displaced, m, map frame; poses : (3,) planar pose of each keyframe in the map frame
    """
    from shapely import STRtree, linestrings, points

    looks = _place_views(sights, poses)
    shapes = [_ground(building) for building in buildings]
    found = np.zeros(len(shapes), bool)
    everything = [_samples(look.walls) for look in looks]
    seen = np.concatenate(everything) if everything else np.zeros((0, 2))
    if not len(seen) or not shapes:
        return found
    near, _ = STRtree(points(seen)).query([s.buffer(SEEN_WALL_M) for s in shapes], predicate="intersects")
    is_near = np.isin(np.arange(len(shapes)), near)
    candidates = [k for k in range(len(shapes)) if not is_near[k] and not is_canopy(buildings[k])]
    cores = [shapes[k].buffer(-LEAST_DEPTH_M / 2) for k in candidates]
    counts = np.zeros(len(candidates), np.int64)
    tree = STRtree(cores)
    for look, samples in zip(checking(looks), everything, strict=True):
        rays = np.stack(np.broadcast_arrays(look.views[:, None], samples[None]), axis=2)
        ray, core = tree.query(linestrings(rays.reshape(-1, 2, 2)), predicate="intersects")
        hits = np.zeros((len(samples), len(candidates)), np.int64)
        np.add.at(hits, (ray % max(len(samples), 1), core), 1)
        # The rays from all positions of the sensor to the wall pass through the building.
        counts += (hits == len(look.views)).sum(axis=0) * WALL_STEP_M >= ABSENT_WALLS_M
    found[candidates] = counts >= VIEWS
    return found


def new_walls(buildings: Sequence[Building], sights: Sequence[KeyframeMatch], poses: Mapping[int, Floats]) -> Floats:
    """Walls (S, 2, 2), m, map frame, seen from `VIEWS` keyframes and part of no building, longest first.

    poses : (3,) x, y (m), yaw (rad) of keyframes by number
    """
    from shapely import points, prepare, union_all

    known = np.ascontiguousarray(walls_of(buildings)[0].reshape(-1, 4))
    ground = union_all([_ground(building).buffer(ONE_LINE) for building in buildings])
    prepare(ground)
    lines: list[_Line] = []
    for look in checking(_place_views(sights, poses)):
        rows = np.ascontiguousarray(look.walls.reshape(-1, 4))
        # The outside of a wall that is seen at a grazing angle is uncertain: both directions are matched.
        pairs = [
            wall_matching.fit(side, known, np.zeros(3), SEEN_WALL_M, LIKENESS, False)[2]
            for side in (rows, np.ascontiguousarray(rows[:, [2, 3, 0, 1]]))
        ]
        is_inside = ground.contains(points(look.walls.mean(axis=1))) if len(rows) else np.zeros(0, bool)
        for wall in look.walls[(pairs[0] < 0) & (pairs[1] < 0) & ~is_inside]:
            for line in lines:
                if line.takes(wall, look.keyframe):
                    break
            else:
                lines.append(_Line(wall, look.keyframe))
    kept = [line.segment for line in lines if len(line.keyframes) >= VIEWS and line.length >= NEW_WALL_M]
    order = sorted(kept, key=lambda s: -float(np.linalg.norm(s[1] - s[0])))
    return np.array(order).reshape(-1, 2, 2)


class _Line:
    """Walls of several keyframes on one line, merged to one segment."""

    def __init__(self, wall: Floats, keyframe: int) -> None:
        self._from, along = wall[0], wall[1] - wall[0]
        self.length = float(np.linalg.norm(along))
        self._u = along / max(self.length, 1e-9)
        self._low, self._high = 0.0, self.length
        self.keyframes = {keyframe}

    def takes(self, wall: Floats, keyframe: int) -> bool:
        """Merge the wall (2, 2), m, if it is collinear and within `SEEN_WALL_M` of the segment; returns whether it did."""
        away = wall - self._from
        s, d = away @ self._u, away @ [-self._u[1], self._u[0]]
        leaning = abs(d[1] - d[0]) > ONE_WAY * abs(s[1] - s[0])
        if (
            leaning
            or np.abs(d).max() > ONE_LINE
            or s.min() > self._high + SEEN_WALL_M
            or s.max() < self._low - SEEN_WALL_M
        ):
            return False
        self._low, self._high = min(self._low, float(s.min())), max(self._high, float(s.max()))
        self.length = self._high - self._low
        self.keyframes.add(keyframe)
        return True

    @property
    def segment(self) -> Floats:
        """(2, 2) m."""
        return np.asarray(self._from + np.outer([self._low, self._high], self._u))


def _place_views(sights: Sequence[KeyframeMatch], poses: Mapping[int, Floats]) -> list[_PlacedView]:
    """Walls seen from each keyframe with a pose in `poses`, (3,) by number, x, y (m), yaw (rad); map frame."""
    found = []
    for sight in sights:
        if sight.keyframe in poses:
            pose = poses[sight.keyframe]
            views = sight.views if len(sight.views) else np.zeros((1, 2))
            found.append(_PlacedView(sight.keyframe, se2.apply(pose, sight.walls), se2.apply(pose, views[:, :2])))
    return found


def _samples(walls: Floats) -> Floats:
    """Points (N, 2), m, on all walls, about `WALL_STEP_M` apart."""
    counts = [int(np.linalg.norm(wall[1] - wall[0]) / WALL_STEP_M) + 1 for wall in walls]
    shares = [(np.arange(n) + 0.5)[:, None] / n for n in counts]
    found = [wall[0] + share * (wall[1] - wall[0]) for wall, share in zip(walls, shares, strict=True)]
    return np.concatenate(found) if found else np.zeros((0, 2))


def _ground(building: Building) -> Any:
    """The area, of shapely, that a building covers."""
    from shapely import union_all

    return union_all([footprint_polygon(f).buffer(0) for f in building.footprints])


def correct_buildings(matches: OsmMatches, poses: Floats, config: OsmConfig) -> CorrectedMap:
    """The map with the estimated displacements of the buildings of `matches`.

    poses : (K, 3) x, y (m), yaw (rad) of all keyframes in the map frame
    config : by its `mode` nothing moves (`prior`), all buildings move together (`rigid`), or each by itself (other modes)

    Absent and unseen buildings take the common shift. Covariances are conditional on the trajectory.
    """
    prior = map_prior(matches, config)
    if config.mode == "rigid":
        prior = replace(prior, sigma=TOGETHER)
    local = select_agreeing(matches, poses)
    solution = solve_buildings(middles_of(matches), local, dict(enumerate(poses)), prior)
    return place_buildings(matches, poses, local, solution, config, config.mode)


def place_buildings(
    matches: OsmMatches,
    poses: Floats,
    local: Sequence[BuildingMatch],
    solution: BuildingSolution,
    config: OsmConfig,
    mode: str,
) -> CorrectedMap:
    """The map after a solution of the `local` matches: without overlaps, with absent buildings and new walls.

    mode : of `OsmConfig.mode`, or the name of the matcher
    """
    place = dict(enumerate(poses))
    untangled, own = Separation(solution.displacements, (), ()), solution.covariances
    if mode == "prior":
        # No building moves: covariances are those of the prior.
        own = solve_buildings(middles_of(matches), (), {}, _unseen(config)).covariances
        untangled = Separation(np.zeros_like(solution.displacements), (), ())
    elif mode in ("non-rigid", "two-level"):
        information = np.asarray(np.linalg.inv(solution.covariances), np.float64)
        untangled = remove_overlaps(matches.buildings, solution.displacements, information)
    displacements = untangled.displacements
    displaced = [b.displace(d) for b, d in zip(matches.buildings, displacements, strict=True)]
    absent = absent_buildings(displaced, matches.keyframes, place)
    used, rejected = _counts(matches, local, solution)
    found = tuple(
        BuildingCorrection(b, displacements[k], own[k], _status(used[k], bool(absent[k])), used[k], rejected[k])
        for k, b in enumerate(matches.buildings)
    )
    present = [b for b, is_absent in zip(displaced, absent, strict=True) if not is_absent]
    shift = np.zeros(2) if mode == "prior" else solution.shift
    new = new_walls(present, matches.keyframes, place)
    corrected = CorrectedMap(matches.origin, found, mode, shift, new, untangled.left, matches.attribution)
    counts = {status: sum(c.status == status for c in found) for status in ("seen", "unseen", "absent")}
    log.info(
        "OSM: %d buildings seen, %d unseen, %d absent; %d new walls",
        counts["seen"],
        counts["unseen"],
        counts["absent"],
        len(corrected.new_walls),
    )
    return corrected


def middles_of(matches: OsmMatches) -> Floats:
    """Middles (B, 2), m, about which the buildings rotate."""
    return np.array([b.middle for b in matches.buildings]).reshape(-1, 2)


def select_agreeing(matches: OsmMatches, poses: Floats) -> list[BuildingMatch]:
    """The accepted local matches that agree with others of their building, with the keyframes at `poses` (K, 3)."""
    local = [m for m in matches.local if m.is_accepted and m.keyframe < len(poses)]
    agrees = agreeing(middles_of(matches), local, dict(enumerate(poses)))
    return [m for m, is_kept in zip(local, agrees, strict=True) if is_kept]


def map_prior(matches: OsmMatches, config: OsmConfig) -> MapPrior:
    """The map's prior: the common shift as the trajectory's graph estimated it, buildings as configured."""
    unseen = _unseen(config)
    common = np.minimum(matches.shift_sigma, unseen.shift_sigma)
    return replace(unseen, shift=matches.shift, shift_sigma=np.maximum(common, TOGETHER[:2]))


def _unseen(config: OsmConfig) -> MapPrior:
    """The map's prior for buildings that no scan saw: no shift, the configured sigmas."""
    shift_sigma = np.maximum(np.full(2, config.shift_sigma), TOGETHER[:2])
    return MapPrior(np.zeros(2), shift_sigma, planar_sigmas(BUILDING_RATIO * config.map_sigma))


def write_buildings(folder: Path, corrected_map: CorrectedMap, data: OsmData) -> None:
    """Write buildings.geojson, and buildings.osm for editors, which has the elements of `data` displaced.

    Raises OutputError when they cannot be written.
    """
    write_buildings_geojson(folder / BUILDINGS_GEOJSON, corrected_map)
    write_osm(folder / BUILDINGS_OSM, corrected_osm(data, corrected_map))


def _status(count: int, is_absent: bool) -> BuildingStatus:
    """Status of a building with `count` matches: seen, absent or unseen."""
    if count:
        return "seen"
    return "absent" if is_absent else "unseen"


def _counts(
    matches: OsmMatches, local: Sequence[BuildingMatch], solution: BuildingSolution
) -> tuple[list[int], list[int]]:
    """Numbers of inlier matches and of rejected matches of each building."""
    owners = np.array([m.building for m in local], np.intp)
    size = len(matches.buildings)
    used = np.bincount(owners[solution.inliers], minlength=size)
    tried = np.bincount(np.array([m.building for m in matches.local], np.intp), minlength=size)
    return used.tolist(), (tried - used).tolist()


@dataclass(frozen=True)
class BuildingFit:
    """Matches, and displacements of buildings; joint : solution of one graph, None when the trajectory is fixed."""

    matches: OsmMatches
    buildings: CorrectedMap
    joint: JointSolution | None = None


class BuildingFitter(Protocol):
    """Function `fit_buildings` of a matcher's module."""

    def __call__(
        self, graph: PoseGraph, solution: Solution, matches: OsmMatches, extract: BuildingExtract, inputs: BackEndInput
    ) -> BuildingFit:
        """Estimate the displacements of the buildings of `extract`.

        graph : in the frame of the map; solution : of `graph`, with planar priors; matches : of walls, with the verdicts
            of the solution
        Raises GraphError and LinAlgError when it cannot be solved.
        """


def fit_buildings(
    graph: PoseGraph, solution: Solution, matches: OsmMatches, extract: BuildingExtract, inputs: BackEndInput
) -> BuildingFit:
    """Estimate the displacements of the buildings by their walls, see `BuildingFitter`.

    In mode `non-rigid` one graph has buildings and trajectory; in the other modes the trajectory is fixed.
    """
    with inputs.clocks[len(inputs.store) - 1].stage("graph"):
        if inputs.config.osm.mode == "non-rigid":
            joint, buildings = join_buildings(graph, solution, matches, inputs.config)
            return BuildingFit(matches, buildings, joint)
        return BuildingFit(matches, correct_buildings(matches, se2.of_se3(solution.poses), inputs.config.osm))


def join_buildings(
    graph: PoseGraph, solution: Solution, matches: OsmMatches, config: Config
) -> tuple[JointSolution, CorrectedMap]:
    """Solve one graph of all buildings and the inliers of `solution` (mode `non-rigid`); GraphError when it is singular."""
    accepted = replace(
        accepted_part(graph, solution),
        poses=solution.poses,
        odometry=with_drift(graph, solution.drift, config.graph),
        map_priors=(),
    )
    local = select_agreeing(matches, se2.of_se3(solution.poses))
    found = optimise_jointly(accepted, middles_of(matches), local, map_prior(matches, config.osm), config.graph)
    return found, place_buildings(matches, se2.of_se3(found.poses), local, found.buildings, config.osm, config.osm.mode)


def accepted_part(graph: PoseGraph, solution: Solution) -> PoseGraph:
    """The graph without the loops and fixes that `solution` rejected."""
    loops = [loop for loop, why in zip(graph.loops, solution.loop_reasons, strict=True) if not why]
    fixes = [fix for fix, is_kept in zip(graph.fixes, solution.fix_inliers, strict=True) if is_kept]
    return replace(graph, loops=loops, fixes=fixes)
