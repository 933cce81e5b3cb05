"""The interface of matchers, and the matcher of walls."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

from lslam.backend.graph.building_graph import JointSolution, optimise_jointly
from lslam.backend.graph.drift import with_drift
from lslam.backend.graph.problem import PoseGraph, Solution
from lslam.backend.outcome import Given
from lslam.core.config import Config
from lslam.core.geometry import se2
from lslam.core.types.building import CorrectedMap, OsmMatches
from lslam.io.formats.osm_buildings import BuildingExtract
from lslam.osm.corrections import agreed, correct_buildings, map_prior, middles_of, place_buildings


@dataclass(frozen=True)
class Laid:
    """Matches, and buildings with their displacements.

    joint : solution of buildings and trajectory in one graph; None when the trajectory is fixed
    """

    matches: OsmMatches
    buildings: CorrectedMap
    joint: JointSolution | None = None


class Lay(Protocol):
    """`lay` of a matcher's module."""

    def __call__(
        self, graph: PoseGraph, solution: Solution, matches: OsmMatches, extract: BuildingExtract, given: Given
    ) -> Laid:
        """Estimate the displacements of the buildings of `extract`.

        graph : in the frame of the map; solution : of `graph`, with planar priors; matches : of walls, with the verdicts
            of the solution
        Raises GraphError and LinAlgError when it cannot be solved.
        """


def lay(graph: PoseGraph, solution: Solution, matches: OsmMatches, extract: BuildingExtract, given: Given) -> Laid:
    """As `Lay`, by walls: with the trajectory in one graph in mode `non-rigid`, with a fixed trajectory in the others."""
    with given.clocks[len(given.store) - 1].stage("graph"):
        if given.config.osm.mode == "non-rigid":
            joint, buildings = join_buildings(graph, solution, matches, given.config)
            return Laid(matches, buildings, joint)
        return Laid(matches, correct_buildings(matches, se2.of_se3(solution.poses), given.config.osm))


def join_buildings(
    graph: PoseGraph, solution: Solution, matches: OsmMatches, config: Config
) -> tuple[JointSolution, CorrectedMap]:
    """Mode `non-rigid`: one graph of all buildings and of the inliers of `solution` in `graph`.

    Raises GraphError when it cannot be solved.
    """
    accepted = replace(
        accepted_part(graph, solution),
        poses=solution.poses,
        odometry=with_drift(graph, solution.drift, config.graph),
        map_priors=(),
    )
    local = agreed(matches, se2.of_se3(solution.poses))
    found = optimise_jointly(accepted, middles_of(matches), local, map_prior(matches, config.osm), config.graph)
    return found, place_buildings(matches, se2.of_se3(found.poses), local, found.buildings, config.osm, config.osm.mode)


def accepted_part(graph: PoseGraph, solution: Solution) -> PoseGraph:
    """The graph without the loops and fixes that `solution` rejected."""
    loops = [loop for loop, why in zip(graph.loops, solution.loop_reasons, strict=True) if not why]
    fixes = [fix for fix, is_kept in zip(graph.fixes, solution.fix_inliers, strict=True) if is_kept]
    return replace(graph, loops=loops, fixes=fixes)
