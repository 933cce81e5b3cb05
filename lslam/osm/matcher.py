"""What a matcher of a run and a map does."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from lslam.backend.outcome import Given
    from lslam.formats.osm_buildings import BuildingExtract
    from lslam.graph.joint import JointSolution
    from lslam.graph.problem import PoseGraph, Solution
    from lslam.types.building import CorrectedMap, OsmMatches


@dataclass(frozen=True)
class Laid:
    """Buildings laid where they really stand; joint : of buildings and trajectory, None where the trajectory stays."""

    matches: OsmMatches
    buildings: CorrectedMap
    joint: JointSolution | None = None


class Lay(Protocol):
    """`lay` of a matcher's module."""

    def __call__(
        self, graph: PoseGraph, solution: Solution, matches: OsmMatches, extract: BuildingExtract, given: Given
    ) -> Laid:
        """Lay the buildings of `extract` on what was seen.

        graph : in the frame of the map; solution : of it, held by walls; matches : of walls, judged by the solution
        Raises GraphError and LinAlgError when it cannot be solved.
        """
