"""Points that lie on the ground, found by height alone: no rings, no mounting height, on slopes and under a tilted sensor.

First the dominant plane: of all planes through three of the lowest points of a grid, the one with most lowest points
near it and fewest below (RANSAC, Fischler and Bolles 1981). It levels the scan, so the tilt of a drone is no slope. The grid
is level where `up` is vertical, which a sensor that hangs or lies has elsewhere than along its z. Then the
slope filter of Vosselman (2000): a point is no ground when another one lies so much lower that the ground between them
would be steeper than `GROUND_SLOPE`. Mirrors and puddles put points under the ground: what no such slope joins to the plane
under the sensor is not asked for its opinion.

Up itself, in the frame of a sensor that hangs, lies or is pitched, is told by gravity, or else by the ground. That is the plane
which fills the hemisphere below the sensor: the sensor is above it, hardly anything lies under it, and it reaches several times
as far as it is deep, in every direction. A wall, taken for ground, ends at the real one, which is nearer than the wall is long,
and at its own top.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats, Longs
from lslam.core.config.input import PreprocessConfig
from lslam.core.geometry import so3
from lslam.core.kernels import ground

# m; cells of the grid, and the farthest that ground is looked for.
GROUND_CELL_M = 0.5
GROUND_REACH_M = 150.0
TRIPLES = 200
# m per m; the steepest ground against the dominant plane: steeper than any street, less steep than a kerb over a cell.
GROUND_SLOPE = 0.2
# m above the ground that still counts as ground: ruts and kerbs.
GROUND_TOLERANCE_M = 0.25
# Cosine of 45 deg: planes steeper against the expected horizontal are walls or roofs, and nearer to up, z serves to look for the
# ground about.
NEAR_Z = float(np.cos(np.deg2rad(45.0)))
Z = np.array([0.0, 0.0, 1.0])


def up_of(config: PreprocessConfig) -> Floats:
    """(3,) unit vector up in the LiDAR frame as configured; z where nothing is."""
    return Z if config.up is None else np.array(config.up) / np.linalg.norm(config.up)


def world_up_of(config: PreprocessConfig, T_world_lidar: Floats) -> Floats:
    """(3,) unit vector up in the world by the first pose (4, 4); z where nothing is configured."""
    return Z if config.up is None else np.asarray(T_world_lidar[:3, :3] @ up_of(config))


@dataclass(frozen=True)
class Ground:
    """The ground under one scan's points, a height for each cell of a square grid.

    R : (3, 3) levels the points; half : cells in half a side; top : heights of the ground in the level frame, m
    """

    R: Floats
    half: int
    top: Floats

    def above(self, points: NDArray[np.float32], height: float = GROUND_TOLERANCE_M) -> Longs:
        """Indices, increasing, of the scan's points (N, 3), m, LiDAR frame, more than `height`, m, above the ground."""
        return ground.above(points, self.R, GROUND_CELL_M, self.half, self.top, height)


def above_ground(points: NDArray[np.float32], up: Floats = Z) -> Longs:
    """Indices of the points (N, 3), m, LiDAR frame, that do not lie on the ground (`ground_of`), increasing."""
    return ground_of(points, up).above(points)


def ground_of(points: NDArray[np.float32], up: Floats = Z) -> Ground:
    """The ground under the points (N, 3), m, LiDAR frame, of a scan.

    up : (3,) unit vector, about which the dominant plane's normal is looked for
    Without a plane to be found the slope is that against the horizontal of `up`.
    """
    if len(points) < 3:
        return Ground(np.eye(3), 1, np.full((2, 2), ground.NO_HEIGHT))
    farthest = float(np.sqrt(np.einsum("ij,ij->i", points, points).max()))
    half = int(np.ceil(min(farthest, GROUND_REACH_M) / GROUND_CELL_M)) + 1
    R, floor = levelling(points, GROUND_TOLERANCE_M, half, up)
    index = ground.lowest(points, R, GROUND_CELL_M, half)
    low = points[index[index >= 0]].astype(np.float64) @ R.T
    is_under = low[:, 2] < floor - GROUND_TOLERANCE_M - GROUND_SLOPE * np.hypot(low[:, 0], low[:, 1])
    height = np.full(len(index), ground.NO_HEIGHT)
    height[index >= 0] = np.where(is_under, ground.NO_HEIGHT, low[:, 2])
    top = ground.envelope(height.reshape(2 * half, 2 * half), GROUND_SLOPE * GROUND_CELL_M, GROUND_TOLERANCE_M)
    return Ground(R, half, top)


def levelling(points: NDArray[np.float32], tolerance: float, half: int, up: Floats = Z) -> tuple[Floats, float]:
    """(3, 3) rotation that makes the dominant plane of the lowest points horizontal, and the height of that plane then, m.

    Without such a plane: the rotation that makes `up` (3,) vertical, and minus infinity.
    """
    if np.array_equal(up, Z):
        return _levelling(points, tolerance, half)
    turn = so3.level_frame(up)
    R, height = _levelling(np.ascontiguousarray(points @ turn.T.astype(np.float32)), tolerance, half)
    return R @ turn, height


def _levelling(points: NDArray[np.float32], tolerance: float, half: int) -> tuple[Floats, float]:
    """`levelling` of points whose z axis is nearly vertical."""
    index = ground.lowest(points, np.eye(3), GROUND_CELL_M, half)
    low = points[index[index >= 0]].astype(np.float64)
    if len(low) < 3:
        return np.eye(3), -np.inf
    triples = np.random.default_rng(0).integers(0, len(low), (TRIPLES, 3))
    plane = ground.best_plane(low, triples, tolerance, NEAR_Z)
    if not plane.any():
        return np.eye(3), -np.inf
    near = low[np.abs(low @ plane[:3] + plane[3]) <= tolerance]
    _, _, axes = np.linalg.svd(near - near.mean(0), full_matrices=False)
    normal = axes[2] * (1.0 if axes[2, 2] > 0 else -1.0)
    if normal[2] < NEAR_Z:
        normal = plane[:3]
    axis = np.cross(normal, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    R = np.eye(3) if sine < 1e-9 else so3.exp(axis / sine * np.arctan2(sine, normal[2]))
    return R, float((near @ R[2]).mean())


def warm_up() -> None:
    """Compile or load the kernels, with a small floor."""
    floor = np.zeros((400, 3), np.float32)
    floor[:, 0], floor[:, 1] = np.divmod(np.arange(400, dtype=np.float32), 20)
    above_ground(floor)


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
    """Up in the LiDAR frame of points (N, 3), m, by gravity or the ground; z where that is within 45 deg, or by default.

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
