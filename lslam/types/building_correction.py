"""What a run made of the buildings of a map: where each one really stands, and what the map and the ground disagree in."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import erf, sqrt
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lslam.types.building import Building

Floats = NDArray[np.float64]

# `seen`: scans hold it; `unseen`: no scan says anything, it follows the map; `absent`: scans look through where it should be.
BuildingStatus = Literal["seen", "unseen", "absent"]

NEAR = 0.5  # m; what `BuildingCorrection.confidence` counts as in its place


@dataclass(frozen=True)
class BuildingCorrection:
    """One building of the map and its real place.

    building : as on the map, m, map frame
    displacement : (3,) x, y (m), yaw (rad) about the building's `middle`, real minus map
    covariance : (3, 3) of it, m2 and rad2
    used, rejected : matches with walls seen that hold it, and that were given up
    """

    building: Building
    displacement: Floats
    covariance: Floats
    status: BuildingStatus
    used: int = 0
    rejected: int = 0

    @property
    def corrected(self) -> Building:
        """The building where it really stands."""
        return self.building.displaced(self.displacement)

    @property
    def confidence(self) -> float:
        """Probability, by the covariance, that it stands within `NEAR` m of its place along both axes of its uncertainty."""
        variances = np.maximum(np.linalg.eigvalsh(self.covariance[:2, :2]), 1e-12)
        return float(np.prod([erf(NEAR / sqrt(2 * v)) for v in variances]))


@dataclass(frozen=True)
class CorrectedMap:
    """All buildings of a run.

    origin : (3,) lat, lon (deg), height (m) of the map frame, x east, y north
    mode : `osm.mode` they were corrected in; shift : (2,) m by which the map is off as a whole, real minus map
    new_walls : (S, 2, 2) m, map frame: walls seen where no building is
    left : pairs of positions in `buildings` that overlap and could not be parted
    attribution : what outputs have to carry, None where nobody surveyed the map
    """

    origin: Floats
    buildings: tuple[BuildingCorrection, ...]
    mode: str
    shift: Floats = field(default_factory=lambda: np.zeros(2))
    new_walls: Floats = field(default_factory=lambda: np.zeros((0, 2, 2)))
    left: tuple[tuple[int, int], ...] = ()
    attribution: str | None = None
