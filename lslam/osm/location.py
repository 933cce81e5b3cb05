"""Localisation of a run's keyframes on a map: the walls seen about each are matched with its buildings.

Each match is searched about the track of odometry and earlier matches, within its covariance; ambiguous matches and those
outside the gate are rejected.
"""

from __future__ import annotations

import copy
import logging
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from lslam.backend.graph.problem import PlanarPrior, Solution
from lslam.backend.keyframes.store import KeyframeStore, neighbours, submap, submap_labels
from lslam.backend.levelling import floor_planes
from lslam.core.arrays import Floats
from lslam.core.config import Config
from lslam.core.config.backend import GraphConfig, OsmConfig
from lslam.core.geometry import se2, se3, so3
from lslam.core.geometry.noise import RIGHT_PROBABILITY, quantile
from lslam.core.labels import table_of
from lslam.core.stopping import checking
from lslam.core.types.building import BuildingMatch, KeyframeMatch, OsmMatches
from lslam.core.types.constraint import Verdict
from lslam.core.types.scan_result import KeyframeClocks
from lslam.io.formats.osm_buildings import BuildingExtract
from lslam.osm.source import first_pose
from lslam.osm.track import OsmTrack
from lslam.osm.wall_match import SEARCH_SIGMAS, START_WALLS, find_heading, match_buildings, match_keyframe, shares
from lslam.osm.walls import OsmMap, classify, find_walls, planar_sigmas
from lslam.registration.preprocessing.ground import Z, up_of, world_up_of

log = logging.getLogger("lslam")

# Sigmas of the map beyond which the track is lost, and a match has to observe all three coordinates.
LOST_RATIO = 4.0
# Chi-square quantile within which a match agrees with the others.
AGREEING_SHARE = 0.95
# Factor by which submaps grow, and how often, until the match of the start is unambiguous.
GROWTH, TRIES = 2, 4


@dataclass(frozen=True)
class MapLocations:
    """The keyframes of a run located on the map.

    T_enu_odometry : (4, 4) from the world of odometry to the map frame; translation by one match, heading by all
    matches : of all keyframes; priors : the accepted ones, for the pose graph
    start, start_sigma : (3,) x, y (m), yaw (rad), prior of the first pose and its sigmas; None where matches give it
    problem : why no match was accepted, empty otherwise
    """

    T_enu_odometry: Floats
    osm: OsmMap
    matches: list[KeyframeMatch] = field(default_factory=list)
    priors: list[PlanarPrior] = field(default_factory=list)
    start: Floats | None = None
    start_sigma: Floats = field(default_factory=lambda: np.zeros(3))
    problem: str = ""

    @property
    def accepted(self) -> list[KeyframeMatch]:
        """Those of `priors`."""
        return [match for match in self.matches if match.is_accepted]


def locate(
    extract: BuildingExtract,
    store: KeyframeStore,
    up: Floats | None,
    config: Config,
    T_map_world: Floats | None = None,
    odometry: Floats | None = None,
    clocks: KeyframeClocks | None = None,
) -> MapLocations:
    """Match all keyframes with the map.

    up : (3,) up in the world of odometry by an IMU; None estimates it by the ground
    T_map_world : (4, 4) from that world to the map frame by GNSS fixes
    odometry : (K, 4, 4) poses of the keyframes in that world, by default those of the store
    clocks : measure the time of each keyframe, stages `walls` and `map match`
    """
    clocks = KeyframeClocks() if clocks is None else clocks
    osm = OsmMap(extract.buildings)
    odometry = np.stack([k.T_world_lidar for k in store.keyframes]) if odometry is None else odometry
    up = _up_by_ground(store, odometry, config) if up is None else up
    T_level = se3.make(so3.least_rotation(up, Z), np.zeros(3)) if T_map_world is None else T_map_world
    run = LevelRun(store, T_level @ odometry, config)
    start = run.start(osm, T_map_world)
    if start.problem:
        return MapLocations(T_level, osm, problem=start.problem)
    track = OsmTrack(
        start.pose,
        start.sigma,
        config.graph.drift_percent,
        np.radians(config.graph.drift_deg_per_100m) / 100,
        planar_sigmas(config.osm.map_sigma),
    )
    matches = _both_ways(run, osm, track, clocks)
    accepted = [match for match in matches if match.is_accepted]
    if not accepted:
        return MapLocations(T_level, osm, matches, problem=_why_none(matches, osm, extract))
    log.info("OSM: %d of %d keyframes are matched with the map", len(accepted), len(matches))
    first = next((match for match in accepted if match.rank == 3), accepted[0])
    sigma = np.maximum(start.sigma, track.sigma)
    T = _lower(se2.to_se3(_place(run, first, accepted, track, sigma)) @ T_level, odometry[0], T_map_world)
    parts = shares(accepted, len(osm.walls))
    priors = [
        PlanarPrior(m.keyframe, m.pose, m.information, m.rank, part) for m, part in zip(accepted, parts, strict=True)
    ]
    if not (config.osm.hold_start or config.osm.mode == "rigid"):
        return MapLocations(T, osm, matches, priors, None, sigma)
    # The position is that of the prior, the heading the estimate by all matches.
    given, laid = known_start(config.osm), se2.of_se3(T @ odometry[0])
    place = given.pose[:2] if T_map_world is None else start.pose[:2]
    return MapLocations(T, osm, matches, priors, np.append(place, laid[2]), np.append(given.sigma[:2], sigma[2]))


def finish(
    locations: MapLocations,
    extract: BuildingExtract,
    poses: Floats,
    solution: Solution,
    config: OsmConfig,
    clocks: KeyframeClocks | None = None,
) -> OsmMatches:
    """All keyframe matches with the verdicts of the `solution`, and building matches at the final `poses` (K, 4, 4).

    clocks : measure the time of each keyframe, stage `building match`
    """
    clocks = KeyframeClocks() if clocks is None else clocks
    rejections = iter(solution.map_reasons)
    reasons = [next(rejections) if m.is_accepted else "" for m in locations.matches]
    judged = [
        replace(m, verdict=Verdict.REJECTED, reason=reason) if reason else m
        for m, reason in zip(locations.matches, reasons, strict=True)
    ]
    planar, local = se2.of_se3(poses), list[BuildingMatch]()
    for match in checking(judged):
        with clocks[match.keyframe].stage("building match"):
            local += match_buildings(match, planar[match.keyframe], solution.shift, locations.osm, config)
    shift = {"shift": solution.shift, "shift_sigma": solution.shift_sigma}
    return locations.osm.collect(extract, judged, local, **shift)


def _up_by_ground(store: KeyframeStore, odometry: Floats, config: Config) -> Floats:
    """Up (3,) in the world of odometry: median normal of the ground below all keyframes, or as the sensor is mounted."""
    mounted = world_up_of(config.preprocess, odometry[0])
    floors = floor_planes(store, config.graph, up_of(config.preprocess), mounted)
    normals = [odometry[f.keyframe, :3, :3] @ f.normal for f in floors]
    up = np.median(normals, axis=0) if normals else mounted
    return np.asarray(up / np.linalg.norm(up))


def _both_ways(run: LevelRun, osm: OsmMap, track: OsmTrack, clocks: KeyframeClocks) -> list[KeyframeMatch]:
    """Matches of all keyframes: forward from the first; then backward from the first accepted match of full rank."""
    found = _along(range(len(run.store)), run, osm, track, clocks)
    numbers = [m.keyframe for m in found if m.is_accepted and m.rank == 3]
    if numbers and numbers[0] > 0:
        first = found[numbers[0]]
        back = copy.deepcopy(track)
        back.begin(first.pose, first.information)
        found[: numbers[0]] = _along(range(numbers[0] - 1, -1, -1), run, osm, back, clocks, numbers[0])[::-1]
    return found


def _along(
    numbers: Iterable[int],
    run: LevelRun,
    osm: OsmMap,
    track: OsmTrack,
    clocks: KeyframeClocks,
    before: int | None = None,
) -> list[KeyframeMatch]:
    """Match the keyframes `numbers` in turn, and update the track by each accepted match.

    before : keyframe at whose pose the track is; None: the first of `numbers`
    """
    config, planar = run.config, run.planar
    matches: list[KeyframeMatch] = []
    for number in checking(numbers):
        if before is not None:
            step = se2.relative(planar[before], planar[number])
            track.move(step, float(np.linalg.norm(step[:2])))
        before = number
        with clocks[number].stage("walls"):
            seen = run.see_walls(number, config.keyframes.submap_size)
        view = KeyframeMatch(number, *seen, track.pose, track.sigma, track.pose, np.zeros((3, 3)))
        with clocks[number].stage("map match"):
            match = _gate(match_keyframe(view, osm, config.osm), track, config.osm, config.graph)
        if match.is_accepted:
            track.correct(match.pose, match.information)
        matches.append(match)
    return matches


def _gate(match: KeyframeMatch, track: OsmTrack, config: OsmConfig, graph: GraphConfig) -> KeyframeMatch:
    """The match, accepted or with the reason why the track rejects it: too few walls, or too far from its prediction."""
    if match.reason:
        return match
    if track.sigma[0] > LOST_RATIO * config.map_sigma and (match.rank < 3 or len(match.pairs) < START_WALLS):
        return replace(match, reason="too few walls for a relocalisation")
    squared, rank = track.squared_distance(match.pose, match.information)
    limit = quantile(RIGHT_PROBABILITY, rank)
    if squared > limit:
        return replace(
            match, reason=f"{np.sqrt(squared / limit):.1f} times as far from odometry as it may have drifted"
        )
    return replace(match, verdict=Verdict.ACCEPTED)


def _place(
    run: LevelRun, first: KeyframeMatch, accepted: list[KeyframeMatch], track: OsmTrack, sigma: Floats
) -> Floats:
    """The pose (3,) of the run's level world in the map frame.

    The position is that of one match: the nearest to `first` that is as accurate as the map and agrees with the others. The
    heading is estimated from all matches. A single match of few walls, or of a house drawn with a wrong heading, would rotate
    the run by degrees, which looks like drift of odometry.
    sigma : (3,) m, m, rad, standard deviations of the run's place before the matches correct it
    """
    poses, matches = run.planar, [first, *(match for match in accepted if match is not first)]
    numbers = [match.keyframe for match in matches]
    place = se2.compose(first.pose, se2.inverse(poses[first.keyframe]))
    laid, ways = se2.compose(place, poses[numbers]), np.array([run.store.keyframes[k].distance for k in numbers])
    turn, squared = track.align(laid, ways, matches, sigma)
    right = [
        i
        for i, (match, far) in enumerate(zip(matches, squared, strict=True))
        if match.rank == 3 and track.is_accurate(match.information) and far <= quantile(AGREEING_SHARE, 3)
    ]
    at = min(right, key=lambda i: abs(numbers[i] - first.keyframe), default=0)
    there = np.append(matches[at].pose[:2], laid[at, 2] + turn)
    return se2.compose(there, se2.inverse(poses[numbers[at]]))


def _lower(T: Floats, first: Floats, T_map_world: Floats | None) -> Floats:
    """`T` with the first keyframe at height 0, unless satellite fixes gave its height."""
    if T_map_world is not None:
        return T
    down = np.eye(4)
    down[2, 3] = -(T @ first)[2, 3]
    return np.asarray(down @ T)


def _why_none(matches: list[KeyframeMatch], osm: OsmMap, extract: BuildingExtract) -> str:
    """The warning for a run without an accepted match: buildings too far away, or the most frequent reason of rejection."""
    away = min(osm.distance(m.prior[:2]) for m in matches)
    if all(m.reason == "no building near" for m in matches):
        return (
            f"OSM: no building of {extract.source} comes near the run, the nearest is {away:.0f} m away: check --origin; the "
            "run goes on without the buildings"
        )
    reasons = [m.reason for m in matches]
    usual = max(sorted(set(reasons)), key=reasons.count)
    return (
        f"OSM: none of {len(matches)} keyframes matches {extract.source} (most often: {usual}): check --origin and "
        "--heading; the run goes on without the buildings"
    )


@dataclass(frozen=True)
class FirstPose:
    """Planar pose (3,) of the first scan in the map frame and its sigma (3,), m, m, rad; problem : why there is none."""

    pose: Floats
    sigma: Floats
    problem: str = ""


def known_start(config: OsmConfig) -> FirstPose:
    """The first pose by the configured origin and heading, with their sigmas."""
    radius, turn = config.start_radius / SEARCH_SIGMAS, np.radians(config.start_heading_deg) / SEARCH_SIGMAS
    return FirstPose(first_pose(config), np.array([radius, radius, turn]))


@dataclass(frozen=True)
class LevelRun:
    """The keyframes of a run at `poses` (K, 4, 4) of a level world."""

    store: KeyframeStore
    poses: Floats
    config: Config

    @property
    def planar(self) -> Floats:
        """(K, 3) the poses from above."""
        return se2.of_se3(self.poses)

    def planar_pose(self, number: int) -> Floats:
        """Planar pose (3,), x, y (m), yaw (rad), of keyframe `number` in the level world."""
        return se2.of_se3(self.poses[number])

    def see_walls(self, number: int, size: int) -> tuple[Floats, Floats]:
        """Walls (S, 2, 2), m, in the submap of `size` keyframes about keyframe `number`, and positions (V, 2) of the sensor.

        Both in the level frame of that keyframe.
        """
        store, config, at = self.store, self.config.osm, self.planar_pose(number)
        T_world_level = se2.to_se3(at)
        T_world_level[2, 3] = self.poses[number, 2, 3]
        cloud = submap(store, self.poses, number, size, T_world_frame=T_world_level)
        near = neighbours(len(store), number, size)
        views = se2.apply(se2.inverse(at), self.poses[near.start : near.stop, :2, 3])
        is_wall = None
        if config.labels:
            labels = submap_labels(store, number, size) if config.needs_labels else classify(cloud)
            is_wall = table_of(config.labels)[labels]
        return find_walls(cloud, config, views, is_wall).segments, views

    def start(self, osm: OsmMap, T_map_world: Floats | None) -> FirstPose:
        """The first keyframe in the map frame: by GNSS fixes, by the configured heading, or by a search over all headings."""
        config = self.config.osm
        if T_map_world is not None:
            return replace(known_start(config), pose=self.planar_pose(0))
        return known_start(config) if config.heading_deg is not None else self._search_start(osm)

    def _search_start(self, osm: OsmMap) -> FirstPose:
        """The start by a match over all headings, of a submap that grows until the match is unambiguous."""
        config, first, why = self.config.osm, self.planar_pose(0), ""
        size = self.config.keyframes.submap_size
        for _ in checking(range(TRIES)):
            number = min(size // 2, len(self.store) - 1)
            walls = se2.apply(se2.relative(first, self.planar_pose(number)), self.see_walls(number, size)[0])
            match = find_heading(walls, osm.walls, np.zeros(2), config.start_radius, config) if len(walls) else None
            if match is not None and not match.is_ambiguous:
                return FirstPose(match.pose, np.sqrt(np.diag(np.linalg.inv(match.information))))
            why = "several places and headings fit alike" if match is not None else "nothing fits"
            if size >= len(self.store):
                break
            size *= GROWTH
        problem = (
            f"OSM: the walls about the start do not locate it on the map ({why} within {config.start_radius:g} m of the "
            "origin): give --heading DEG, or a better --origin; the run goes on without the buildings"
        )
        return FirstPose(np.zeros(3), np.zeros(3), problem)
