"""The second level: with the trajectory fixed, every building's displacement is estimated from the walls seen."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.config.osm import OsmConfig
from lslam.formats.geojson import write_corrected
from lslam.formats.osm_corrections import corrected_osm
from lslam.formats.osm_files import OsmData, write_osm
from lslam.graph.building_graph import BuildingSolution, MapPrior, agreeing, solve_buildings
from lslam.osm.map_changes import absent_buildings, new_walls
from lslam.osm.overlap import Untangled, remove_overlaps
from lslam.types.building import BuildingCorrection, BuildingMatch, BuildingStatus, CorrectedMap, OsmMatches

log = logging.getLogger("lslam")
Floats = NDArray[np.float64]

BUILDINGS_GEOJSON, BUILDINGS_OSM = "buildings.geojson", "buildings.osm"

# m and rad; prior sigmas of a building that may only move with all others.
TOGETHER = np.array([1e-3, 1e-3, 1e-5])


def correct_buildings(matches: OsmMatches, poses: NDArray[np.float64], config: OsmConfig) -> CorrectedMap:
    """The buildings of `matches` at their real places.

    Parameters
    ----------
    poses : (K, 3) x, y (m), yaw (rad) of all keyframes in the map frame
    config : `mode` says what moves: nothing (`prior`), all buildings together (`rigid`), each by itself (the others)

    Absent buildings follow the others, as those nobody saw do. Covariances are those against the trajectory, which is given.
    """
    prior = map_prior(matches, config)
    if config.mode == "rigid":
        prior = replace(prior, sigma=TOGETHER)
    local = agreed(matches, poses)
    solution = solve_buildings(middles_of(matches), local, dict(enumerate(poses)), prior)
    return place_buildings(matches, poses, local, solution, config, config.mode)


def place_buildings(
    matches: OsmMatches, poses: Floats, local: Sequence[BuildingMatch], solution: BuildingSolution, config: OsmConfig,
    mode: str,
) -> CorrectedMap:  # fmt: skip
    """The map that a solution of `local` matches means: overlaps parted, what is absent and what is new.

    mode : by which it was made, of `OsmConfig.mode`, or a matcher's name
    """
    place = dict(enumerate(poses))
    untangled, own = Untangled(solution.displacements, (), ()), solution.covariances
    if mode == "prior":
        # No building moves: covariances are those of the prior.
        own = solve_buildings(middles_of(matches), (), {}, _unseen(config)).covariances
        untangled = Untangled(np.zeros_like(solution.displacements), (), ())
    elif mode in ("non-rigid", "two-level"):
        information = np.asarray(np.linalg.inv(solution.covariances), np.float64)
        untangled = remove_overlaps(matches.buildings, solution.displacements, information)
    displacements = untangled.displacements
    standing = [b.displaced(d) for b, d in zip(matches.buildings, displacements, strict=True)]
    gone = absent_buildings(standing, matches.keyframes, place)
    used, rejected = _counts(matches, local, solution)
    found = tuple(
        BuildingCorrection(b, displacements[k], own[k], _status(used[k], bool(gone[k])), used[k], rejected[k])
        for k, b in enumerate(matches.buildings)
    )
    here = [b for b, is_gone in zip(standing, gone, strict=True) if not is_gone]
    shift = np.zeros(2) if mode == "prior" else solution.shift
    new = new_walls(here, matches.keyframes, place)
    corrected = CorrectedMap(matches.origin, found, mode, shift, new, untangled.left, matches.attribution)
    counts = {status: sum(c.status == status for c in found) for status in ("seen", "unseen", "absent")}
    log.info(
        "OSM: %d buildings seen, %d not, %d absent; %d walls that no building has",
        counts["seen"], counts["unseen"], counts["absent"], len(corrected.new_walls),
    )  # fmt: skip
    return corrected


def middles_of(matches: OsmMatches) -> Floats:
    """(B, 2) m, what the buildings of a run are turned about."""
    return np.array([b.middle for b in matches.buildings]).reshape(-1, 2)


def agreed(matches: OsmMatches, poses: Floats) -> list[BuildingMatch]:
    """The accepted local matches that others support, with the keyframes at `poses` (K, 3)."""
    local = [m for m in matches.local if m.is_accepted and m.keyframe < len(poses)]
    borne_out = agreeing(middles_of(matches), local, dict(enumerate(poses)))
    return [m for m, is_so in zip(local, borne_out, strict=True) if is_so]


def map_prior(matches: OsmMatches, config: OsmConfig) -> MapPrior:
    """The map's prior: common shift by the trajectory's estimate, buildings by the configuration."""
    unseen = _unseen(config)
    common = np.minimum(matches.shift_sigma, unseen.shift_sigma)
    return replace(unseen, shift=matches.shift, shift_sigma=np.maximum(common, TOGETHER[:2]))


def _unseen(config: OsmConfig) -> MapPrior:
    """The prior before any scan."""
    sigma = np.array([config.building_sigma, config.building_sigma, np.radians(config.building_sigma_deg)])
    return MapPrior(np.zeros(2), np.maximum(np.full(2, config.shift_sigma), TOGETHER[:2]), sigma)


def write_buildings(folder: Path, found: CorrectedMap, data: OsmData) -> None:
    """buildings.geojson, and buildings.osm to open in an editor: the elements of `data` at their real places.

    Raises OutputError when they cannot be written.
    """
    write_corrected(folder / BUILDINGS_GEOJSON, found)
    write_osm(folder / BUILDINGS_OSM, corrected_osm(data, found))


def _status(used: int, is_gone: bool) -> BuildingStatus:
    if used:
        return "seen"
    return "absent" if is_gone else "unseen"


def _counts(
    matches: OsmMatches, local: Sequence[BuildingMatch], solution: BuildingSolution
) -> tuple[list[int], list[int]]:
    """Per building, how many matches are inliers and how many were rejected."""
    owners = np.array([m.building for m in local], np.intp)
    size = len(matches.buildings)
    used = np.bincount(owners[solution.inliers], minlength=size)
    tried = np.bincount(np.array([m.building for m in matches.local], np.intp), minlength=size)
    return used.tolist(), (tried - used).tolist()
