"""The local map in a pyramid of resolutions: a point takes the finest voxel whose points spread across the beams."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.core.types.arrays import Floats
from lslam.core.types.state import State, Stateful
from lslam.registration.gaussian_map import GaussianMap

# A plane must have been seen across its beams by twice the standard deviation that it is thick: below that, a plane
# through the sensor explains its points as well, which is where the beams of one ring lie whatever they hit.
BREADTH = 4.0
# Times the coarse voxels. Beams of two degrees lie two metres apart on a wall 60 m away, and on the ground 10 m ahead.
WIDE = (2, 4)


class LocalMap(Stateful):
    """Gaussian voxels of four sizes around the sensor.

    Parameters
    ----------
    size : m, edge of a fine voxel; coarse_factor : how many times larger a coarse one is
    min_points, planarity, count_cap, reach, breadth : as in `GaussianMap`; None: `BREADTH`
    """

    def __init__(
        self, size: float, *, coarse_factor: int, min_points: int, planarity: float, count_cap: float, reach: float,
        breadth: float | None = None,
    ) -> None:  # fmt: skip
        breadth = BREADTH if breadth is None else breadth
        self.levels = tuple(
            GaussianMap(
                edge, min_points=min_points, planarity=planarity, count_cap=count_cap, reach=reach, breadth=breadth
            )
            for edge in (size, *(size * coarse_factor * wider for wider in (1, *WIDE)))
        )
        # How often the map has changed: what was looked up in it before is void then.
        self.changes = 0

    @property
    def fine(self) -> GaussianMap:
        """The level of the smallest voxels."""
        return self.levels[0]

    @property
    def coarser(self) -> tuple[GaussianMap, ...]:
        """All other levels, the finest of them first."""
        return self.levels[1:]

    def __len__(self) -> int:
        """Fine voxels that hold points."""
        return len(self.fine)

    def insert(self, map_points: NDArray[np.float32], source: Floats, T_world_lidar: Floats) -> None:
        """Enter a scan: its small centroids (M, 3) into fine voxels, its source points (S, 3) into all others."""
        self.changes += 1
        self.fine.insert(map_points, T_world_lidar)
        few = source.astype(np.float32)
        for level in self.coarser:
            level.insert(few, T_world_lidar)

    def clear(self) -> None:
        """Forget everything; the room is kept."""
        self.changes += 1
        for level in self.levels:
            level.clear()

    def state(self) -> State:
        """What `restore` needs to go on from here."""
        return {"levels": [level.state() for level in self.levels]}

    def restore(self, state: State) -> None:
        """Go on where `state` was taken."""
        self.changes += 1
        for level, kept in zip(self.levels, state["levels"], strict=True):
            level.restore(kept)
