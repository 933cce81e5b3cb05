"""The first pose of a run on the map: as given, or by a first match over all headings where the heading is unknown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.config.osm import OsmConfig
from lslam.geometry import se2
from lslam.keyframes.store import KeyframeStore
from lslam.keyframes.submaps import neighbours, submap
from lslam.osm.source import first_pose
from lslam.osm.wall_map import OsmMap
from lslam.osm.wall_match import WINDOW, find_heading
from lslam.osm.walls import find_walls
from lslam.stopping import checking

Floats = NDArray[np.float64]

# Submaps grow by this factor, so often, until the walls of one fit one place only.
GROWTH, TRIES = 2, 4


@dataclass(frozen=True)
class FirstPose:
    """Planar pose (3,) of the first scan in the map frame with its sigma (3,), m, m, rad; or why there is none."""

    pose: Floats
    sigma: Floats
    problem: str = ""


@dataclass(frozen=True)
class WallView:
    """Walls (S, 2, 2) seen about a keyframe and the sensor's places (V, 2) then, m, in the keyframe's level frame."""

    walls: Floats
    views: Floats


def see_walls(store: KeyframeStore, poses: Floats, number: int, size: int, config: OsmConfig) -> WallView:
    """Walls in the submap of `size` keyframes about keyframe `number`; `poses` (K, 4, 4) of all in a level world."""
    at = se2.of_se3(poses[number])
    T_world_level = se2.to_se3(at)
    T_world_level[2, 3] = poses[number, 2, 3]
    cloud = submap(store, poses, number, size, T_world_frame=T_world_level)
    near = neighbours(len(store), number, size)
    views = se2.apply(se2.inverse(at), poses[near.start : near.stop, :2, 3])
    return WallView(find_walls(cloud, config, views).segments, views)


def known_start(config: OsmConfig) -> FirstPose:
    """The start that the configuration gives, with its heading."""
    radius, turn = config.start_radius / WINDOW, np.radians(config.start_heading_deg) / WINDOW
    return FirstPose(first_pose(config), np.array([radius, radius, turn]))


def sought_start(store: KeyframeStore, poses: Floats, osm: OsmMap, config: OsmConfig, submap_size: int) -> FirstPose:
    """The start by the first match over all headings, of a submap that grows until it fits one place only.

    poses : (K, 4, 4) of all keyframes in a level world; the first keyframe is the start
    """
    first, size, why = se2.of_se3(poses[0]), submap_size, ""
    for _ in checking(range(TRIES)):
        number = min(size // 2, len(store) - 1)
        seen = see_walls(store, poses, number, size, config)
        walls = se2.apply(se2.relative(first, se2.of_se3(poses[number])), seen.walls)
        found = find_heading(walls, osm.walls, np.zeros(2), config.start_radius, config) if len(walls) else None
        if found is not None and not found.is_ambiguous:
            sigma = np.sqrt(np.diag(np.linalg.inv(found.information)))
            return FirstPose(found.pose, sigma)
        why = "several places and headings fit alike" if found is not None else "nothing fits"
        if size >= len(store):
            break
        size *= GROWTH
    problem = (
        f"OSM: the walls about the start do not say where it is on the map ({why} within {config.start_radius:g} m of the "
        "origin): give --heading DEG, or a better --origin; the run goes on without the buildings"
    )
    return FirstPose(np.zeros(3), np.zeros(3), problem)
