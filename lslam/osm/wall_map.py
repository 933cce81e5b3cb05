"""The walls of a map, and which of them are near."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lslam.osm.walls import walls_of
from lslam.types.building import Building

Floats = NDArray[np.float64]


class OsmMap:
    """Buildings and their walls, in the map frame.

    walls : (T, 2, 2) m; owners : (T,) number of each one's building
    """

    def __init__(self, buildings: Sequence[Building]) -> None:
        self.buildings = tuple(buildings)
        self.walls, self.owners = walls_of(self.buildings)
        corners = [np.concatenate([f.outer for f in b.footprints]) for b in self.buildings]
        self._low = np.array([c.min(0) for c in corners]).reshape(-1, 2)
        self._high = np.array([c.max(0) for c in corners]).reshape(-1, 2)

    def near(self, place: Floats, reach: float) -> NDArray[np.int64]:
        """Numbers of the buildings whose box comes within `reach` m of `place` (2,)."""
        return np.flatnonzero(self._away(place) <= reach)

    def distance(self, place: Floats) -> float:
        """From `place` (2,) to the box of the nearest building, m; inf without one."""
        return float(self._away(place).min(initial=np.inf))

    def walls_near(self, place: Floats, reach: float) -> NDArray[np.int64]:
        """Numbers of the walls of these buildings."""
        return np.flatnonzero(np.isin(self.owners, self.near(place, reach)))

    def _away(self, place: Floats) -> Floats:
        outside = np.maximum(np.maximum(self._low - place, place - self._high), 0.0)
        return np.asarray(np.linalg.norm(outside, axis=1))
