"""Matches of the walls seen about a keyframe with the walls of the map: planar priors, and observations of buildings.

Del Tufo, sections 3.3 and 3.4: the global match aligns the walls seen with all buildings near and gives a planar prior of the
keyframe. A local match aligns one building with the walls seen and observes the building's displacement alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lslam.config.backend import OsmConfig
from lslam.geometry import se2
from lslam.osm.wall_match import WINDOW, WallMatch, match_walls
from lslam.osm.walls import OsmMap, find_walls
from lslam.types.building import BuildingMatch, KeyframeMatch
from lslam.types.constraint import Verdict

Floats = NDArray[np.float64]


def warm_up() -> None:
    """Compile or load every kernel of matching, by matching two walls with themselves."""
    s, z = (part.ravel() for part in np.meshgrid(np.arange(0.0, 8.0, 0.2), np.arange(2.0, 5.0, 0.2)))
    corner = np.concatenate([np.column_stack([s, 0 * s + 8, z]), np.column_stack([0 * s + 8, s, z])])
    floor = np.column_stack([s, s, 0 * z])
    walls = find_walls(np.concatenate([corner, floor])).segments
    for by_coverage in (False, True):
        match_walls(walls, walls, np.zeros(3), np.ones(3), by_coverage=by_coverage)


def match_keyframe(view: KeyframeMatch, osm: OsmMap, config: OsmConfig) -> KeyframeMatch:
    """Match `view`, walls with a prior pose and its sigma, with the buildings near. `reason` says why a match is rejected."""
    if not len(view.walls):
        return replace(view, reason="no walls seen")
    reach = config.use_radius + WINDOW * float(np.hypot(view.sigma[0], view.sigma[1]))
    numbers = osm.walls_near(view.prior[:2], reach)
    if not len(numbers):
        return replace(view, reason="no building near")
    found = match_walls(view.walls, osm.walls[numbers], view.prior, view.sigma, config)
    if found is None:
        return replace(view, reason="too few of the walls seen lie on the map")
    return matched(view, found, numbers)


def matched(view: KeyframeMatch, found: WallMatch, numbers: NDArray[np.int64]) -> KeyframeMatch:
    """`view` with the match `found`; numbers : (T,) of the map's walls that it was matched with."""
    pairs = np.column_stack([found.pairs[:, 0], numbers[found.pairs[:, 1]]])
    return replace(
        view, pose=found.pose, information=found.information, rank=found.rank, kind=found.kind, fitness=found.fitness,
        coverage=found.coverage, rms=found.rms, pairs=pairs,
        reason="another place fits nearly as well" if found.is_ambiguous else "",
    )  # fmt: skip


def match_buildings(
    match: KeyframeMatch, pose: Floats, shift: Floats, osm: OsmMap, config: OsmConfig
) -> list[BuildingMatch]:
    """Match each building near with the walls seen from a keyframe at `pose` (3,), map frame.

    shift : (2,) m, common shift of the map, by which the prior of every building is displaced
    """
    found: list[BuildingMatch] = []
    if not len(match.walls):
        return found
    sigma = np.array([config.building_sigma, config.building_sigma, np.radians(config.building_sigma_deg)])
    for number in osm.near(pose[:2] - shift, config.use_radius).tolist():
        middle = osm.buildings[number].middle
        walls = osm.walls[osm.owners == number] - middle
        if not len(walls):
            continue
        prior = se2.relative(pose, np.append(middle + shift, 0.0))
        # By coverage, since most buildings are seen in part.
        one = match_walls(walls, match.walls, prior, sigma, config, by_coverage=True)
        if one is None:
            continue
        reason = "another place fits nearly as well" if one.is_ambiguous else ""
        found.append(
            BuildingMatch(
                match.keyframe, number, one.pose, one.information, one.rank, one.kind, one.fitness, one.coverage,
                one.rms, one.pairs, Verdict.REJECTED if reason else Verdict.ACCEPTED, reason,
            )
        )  # fmt: skip
    return found


def shares(matches: Sequence[KeyframeMatch], walls: int) -> list[float]:
    """Weight of each match: the mean over its walls of 1 / n, where n matches have the same wall of the map's `walls`.

    The map's error of a wall is common to all keyframes that see it, so their matches are not independent.
    """
    seen = np.zeros(walls, np.int64)
    for match in matches:
        seen[np.unique(match.pairs[:, 1])] += 1
    return [float(np.mean(1.0 / seen[match.pairs[:, 1]])) for match in matches]
