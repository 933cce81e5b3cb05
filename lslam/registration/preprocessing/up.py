"""The direction up in the frame of a sensor that hangs, lies or is pitched: by gravity, or else by the ground under it.

The ground is the plane that fills the hemisphere below the sensor: the sensor is above it, hardly anything lies under it, and
it reaches several times as far as it is deep, in every direction. A wall, taken for ground, ends at the real one, which is
nearer than the wall is long, and at its own top.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from lslam.core.geometry import so3
from lslam.core.kernels import ground
from lslam.core.types.arrays import Floats
from lslam.registration.preprocessing.ground import GROUND_CELL_M, GROUND_TOLERANCE_M, Z, levelling

# Cosine of 45 deg: within it z is close enough to up for everything that looks for the ground.
NEAR_Z = float(np.cos(np.deg2rad(45.0)))
# The ground fills more than half of the hemisphere below the sensor: a plane that fills less is a wall, or no whole floor.
GROUND_SHARE = 0.5
# Extent, in cells to each side; sectors about the foot of the sensor.
CELLS, SECTORS = 80, 12
# Axes, and the diagonals between three of them: no direction is farther than 37 deg from one.
DIRECTIONS = [
    np.array(d) / np.linalg.norm(d) for d in product((-1.0, 0.0, 1.0), repeat=3) if sum(map(abs, d)) in (1.0, 3.0)
]


@dataclass(frozen=True)
class Up:
    """Unit vector (3,) up in the LiDAR frame, and what says so: `gravity`, `ground`, or nothing but the sensor's `axis` z."""

    direction: Floats
    source: str

    @property
    def tilt_deg(self) -> float:
        """Angle from the sensor's z."""
        return float(np.rad2deg(np.arccos(np.clip(self.direction[2], -1.0, 1.0))))


AXIS = Up(Z, "axis")


def find_up(points: NDArray[np.float32], gravity_up: Floats | None = None) -> Up:
    """Up among points (N, 3), m, as seen from the sensor; z where that is within 45 deg, or where nothing says otherwise.

    gravity_up : (3,) unit vector, up as an IMU measures it, which ground about it makes precise. It counts unless there is
        ground about z and none about it: then its sign or its axes are wrong.
    """
    if gravity_up is not None and gravity_up[2] > NEAR_Z:
        return Up(Z, "gravity")
    about_z = ground_share(points, Z)[0]
    if gravity_up is not None:
        share, normal = ground_share(points, gravity_up)
        has_ground = share > GROUND_SHARE
        if about_z > GROUND_SHARE and not has_ground:
            return AXIS
        direction = normal if has_ground else gravity_up
        return Up(Z if direction[2] > NEAR_Z else direction, "gravity")
    if about_z > GROUND_SHARE:
        return Up(Z, "ground")
    shares = [ground_share(points, d) for d in DIRECTIONS]
    grounds = [(n[2] > 0.0, share, n) for share, n in shares if share > GROUND_SHARE]
    # Of a floor and its ceiling the one nearer to z.
    normal = max(grounds, key=lambda ground: ground[:2])[2] if grounds else Z
    return AXIS if normal[2] > NEAR_Z else Up(normal, "ground")


def ahead_of(up: Floats) -> Floats:
    """(3,) unit vector ahead in the LiDAR frame in which `up` (3,) is up: x, or of a turned sensor x of the level frame."""
    return np.array([1.0, 0.0, 0.0]) if up[2] > NEAR_Z else np.asarray(so3.level_frame(up)[0])


def ground_share(points: NDArray[np.float32], up: Floats) -> tuple[float, Floats]:
    """Share of the hemisphere below that the ground fills, 0 to 1, as seen from the sensor, and its normal (3,).

    It counts less by what lies under it. A plane above the sensor, or through it, is no ground.

    up : (3,) unit vector, about which the normal is looked for
    """
    R, height = levelling(points, GROUND_TOLERANCE_M, CELLS, up)
    if not -height > GROUND_TOLERANCE_M or not np.isfinite(height):
        return 0.0, up
    index = ground.lowest(points, R, GROUND_CELL_M, CELLS)
    above = points[index[index >= 0]].astype(np.float64) @ R[2] - height
    under = float((above < -GROUND_TOLERANCE_M).sum()) / max(float((np.abs(above) <= GROUND_TOLERANCE_M).sum()), 1.0)
    level = points @ R.T.astype(np.float32)
    x, y = level[np.abs(level[:, 2] - height) <= GROUND_TOLERANCE_M, :2].astype(np.float64).T
    reach = np.hypot(x, y)
    sector = np.minimum((np.arctan2(y, x) / (2 * np.pi) + 0.5) * SECTORS, SECTORS - 1).astype(np.int64)
    # What a disc of that radius hides of the half sphere; a sector counts as far as most of its points reach.
    radii = np.array([np.median(reach[sector == k]) if (sector == k).any() else 0.0 for k in range(SECTORS)])
    share = float(np.mean(1.0 - -height / np.hypot(height, radii)))
    return max(1.0 - under, 0.0) * share, R[2]
