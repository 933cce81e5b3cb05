"""Levelled keyframes, and submaps prepared for loop verification: Gaussian maps, source points, ground and other points.

Bird's-eye views (BEV) of submaps are images of height and visibility, correlated by FFT.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lslam.backend.kernels import bev
from lslam.core.arrays import Bools, Floats, Longs, Points
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.geometry import noise, se3, so3
from lslam.core.kernels import gaussians
from lslam.core.kernels.transform import transform
from lslam.core.types.trajectory import Keyframe
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.local_map import COARSE_FACTOR
from lslam.registration.preprocessing.ground import NEAR_Z, Z
from lslam.registration.preprocessing.prepare import PreparedPoints

# Cosines: surfaces tilted by less against the estimate so far are taken for ground, floors and flat roofs.
ROUNDS = tuple(float(np.cos(np.deg2rad(limit))) for limit in (45.0, 30.0, 20.0, 15.0, 15.0))


def find_up(maps: Iterable[GaussianMap], prior: Floats = Z) -> Floats:
    """(3,) unit vector: the mean normal of nearly horizontal planes, with a tighter limit each round.

    prior : (3,) unit vector, up by the mounting of the sensor: the initial guess, and the result where there is no plane
    """
    planes = [m.planes[m.planes[:, 7] >= 0, 3:6] for m in maps]
    normals = np.concatenate([*planes, np.zeros((0, 3))])
    up = prior
    for limit in ROUNDS:
        along = normals @ up
        near = normals[np.abs(along) > limit] * np.sign(along[np.abs(along) > limit, None])
        if len(near) == 0:
            break
        up = near.mean(axis=0)
        up /= np.linalg.norm(up)
    return up


def level_rotation(up: Floats) -> Floats:
    """(3, 3) a rotation that makes the unit vector `up` (3,) the z axis: the least, or x stays ahead where up is far from z."""
    if up[2] <= NEAR_Z:
        return so3.level_frame(up)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    return np.eye(3) if sine < 1e-12 else so3.exp(axis / sine * np.arctan2(sine, up[2]))


def move_points(points: Points, T: Floats) -> Points:
    """The points (N, 3), m, moved by T (4, 4)."""
    out = np.empty_like(points)
    transform(points, T, out)
    return out


def level_keyframes(keyframes: Sequence[Keyframe], up: Floats) -> list[Keyframe]:
    """The keyframes in a world turned so that the unit vector `up` (3,) is its z axis."""
    R = level_rotation(up)
    poses = [se3.make(R, np.zeros(3)) @ k.T_world_lidar for k in keyframes]
    covariances = [None if k.covariance is None else noise.rotate(k.covariance, R) for k in keyframes]
    return [replace(k, T_world_lidar=T, covariance=S) for k, T, S in zip(keyframes, poses, covariances, strict=True)]


# m; larger voxels serve sparse single scans; a submap is dense.
LARGEST = 0.8
# Source points of a submap, at most.
SOURCE_POINTS = 4000
# Voxels allocated at first; a map needs room for as many more as points are inserted at once.
CAPACITY = 1 << 15
# Cosine; planes within 25 degrees of horizontal are ground and ceilings, which constrain no horizontal shift.
LEVEL_COSINE = float(np.cos(np.deg2rad(25)))


@dataclass(frozen=True)
class LevelSubmap:
    """A submap in level axes with z up, origin at its keyframe.

    fine, coarse : its Gaussian maps
    source : means of its voxels, the source points of a registration; upright : those of them on no horizontal plane
    non_ground : (N, 3) m, means of all voxels on no horizontal plane; ground : (M, 3) m, of those on one
    """

    fine: GaussianMap
    coarse: GaussianMap
    source: PreparedPoints
    upright: PreparedPoints
    non_ground: Floats
    ground: Floats


def make_level_submap(points: Points, config: RegistrationConfig) -> LevelSubmap:
    """Prepare the points (N, 3), m, of a submap in level axes, z up. Voxels with few points give no source points."""
    fine = GaussianMap(min(config.voxel_size, LARGEST), reach=np.inf, capacity=CAPACITY)
    for first in range(0, len(points), CAPACITY // 4):
        fine.insert(points[first : first + CAPACITY // 4], np.eye(4))
    kind = fine.planes[:, 7]
    solid = np.flatnonzero((fine.keys != gaussians.FREE) & (kind > gaussians.EMPTY))
    is_level = (kind[solid] >= 0) & (np.abs(fine.planes[solid, 5]) > LEVEL_COSINE)
    step = max(int(np.ceil(len(solid) / SOURCE_POINTS)), 1)
    chosen, is_upright = solid[::step], ~is_level[::step]
    return LevelSubmap(
        fine,
        fine.coarsen(COARSE_FACTOR),
        _source(fine, chosen),
        _source(fine, chosen[is_upright]),
        fine.planes[solid[~is_level], :3],
        fine.planes[solid[is_level], :3],
    )


def _source(target: GaussianMap, slots: Longs) -> PreparedPoints:
    """Source points: means of the voxels in `slots`, with the scatter of the points in each."""
    s = target.moments[slots] / np.maximum(target.moments[slots, :1], 1.0)
    mean = s[:, 1:4]
    outer = mean[:, (0, 0, 0, 1, 1, 2)] * mean[:, (0, 1, 2, 1, 2, 2)]
    points = np.ascontiguousarray(target.planes[slots, :3])
    return PreparedPoints(np.zeros((0, 3), np.float32), points, np.ascontiguousarray(s[:, 4:10] - outer), len(points))


Image = NDArray[np.float32]
Spectrum = NDArray[np.complex64]

# m; a heading error of half a search step moves a wall by one cell at most.
CELL_M = 1.0
# Voxels per cell that count, at most: taller structure is no more distinctive.
MOST_VOXELS = 6.0
NO_ROTATION: Floats = np.eye(2)


@dataclass(frozen=True)
class BevGrid:
    """A BEV grid of `size` x `size` cells of `cell` m centred on the origin, x along rows."""

    size: int
    cell: float = CELL_M

    def cells_of(self, points: Floats) -> tuple[Longs, Bools]:
        """Flat cell of each point (N, 3), m, 0 outside, and whether it lies inside."""
        cells = np.floor(points[:, :2] / self.cell).astype(np.int64) + self.size // 2
        inside = np.asarray(((cells >= 0) & (cells < self.size)).all(axis=1))
        return np.where(inside, cells[:, 0] * self.size + cells[:, 1], 0), inside

    def view(self, points: Floats, ground: Floats, R: Floats = NO_ROTATION) -> Image:
        """Image (3, size, size) of objects, points (N, 3), m, and of the ground, points (M, 3), m, rotated by R (2, 2).

        First the occupied voxels per cell, up to `MOST_VOXELS`; points are means of voxels. Second its square. Third visibility:
        1 in cells that hold a point of either, and in their neighbours, else 0.
        """
        images = np.zeros((3, self.size, self.size), np.float32)
        bev.view(points, ground, R, self.cell, MOST_VOXELS, images)
        return images

    def lowest(self, points: Floats) -> Floats:
        """(size * size,) lowest z of the points in each cell, m, inf in empty cells."""
        cells, inside = self.cells_of(points)
        lowest = np.full(self.size**2, np.inf)
        np.minimum.at(lowest, cells[inside], points[inside, 2])
        return lowest

    def shifts(self, cells: Longs) -> Floats:
        """Shifts (K, 2), m, of the flat cells (K,) of a correlation."""
        along = self._along()
        return np.column_stack([along[part] for part in np.divmod(cells, self.size)])

    def within(self, centre: Floats, radius: float) -> Longs:
        """Flat cells of a correlation, increasing, whose shifts lie within `radius` m, at least one cell, of `centre` (2,), m."""
        along = self._along()
        distances2 = (along[:, None] - centre[0]) ** 2 + (along[None, :] - centre[1]) ** 2
        return np.flatnonzero(distances2 <= max(radius, self.cell) ** 2)

    def _along(self) -> Floats:
        """Shift (size,), m, that each row or column of a correlation stands for."""
        return np.asarray(np.fft.fftfreq(self.size, 1 / (self.size * self.cell)))


@dataclass(frozen=True)
class VisibleCells:
    """Flat cells (size * size,) of a BEV grid that a map was seen in, and the least share of upright points to lie there."""

    grid: BevGrid
    visible: Bools
    least_share: float

    def count(self, points: Floats) -> int:
        """Number of the points (N, 3), m, that lie in visible cells; 0 if that is less than `least_share` of them."""
        cells, inside = self.grid.cells_of(points)
        count = int((inside & self.visible[cells]).sum())
        return 0 if count < self.least_share * len(points) else count


def blur(image: Image) -> Image:
    """The image with each cell replaced by the mean of the cell and its eight neighbours."""
    from scipy import ndimage

    return np.asarray(ndimage.uniform_filter(image, 3, mode="constant"))


def spectra(images: Image) -> Spectrum:
    """Fourier transforms of images (K, size, size), for `correlate`."""
    from scipy import fft

    return np.asarray(fft.rfft2(images))


def correlate(a: Spectrum, b: Spectrum) -> Image:
    """(K, size, size) sums over the cells of images a times images b shifted, for all shifts; `size` is even."""
    from scipy import fft

    product = np.conj(b)
    product *= a
    return np.asarray(fft.irfft2(product, overwrite_x=True))


class BestShifts:
    """The best score of shifts over the headings tried so far: a correlation normalised over the cells that both observed.

    Without that the shift with most overlap would win.

    cells : (K,) flat cells of the correlation that are of interest
    score : (K,) 0 to 1; heading : (K,) that it was reached with
    """

    def __init__(self, cells: Longs) -> None:
        self.cells = cells
        self.score, self.heading = np.zeros((2, len(cells)), np.float32)

    def observe(self, sums: Image, least: float, heading: float) -> None:
        """Keep the score of each shift at another heading where it is the best so far, from three correlations (3, size, size).

        sums : both images' structure; cells that a observed with b's squares; cells that b observed with a's squares
        least : value of the second sum below which the score is 0
        """
        flat = sums.reshape(3, -1)
        bev.improve(flat, self.cells, np.float32(least), np.float32(heading), self.score, self.heading)

    def merge(self, other: BestShifts, rows: Longs) -> None:
        """Take over the scores and headings of the rows (K,) of another object where they are better."""
        score = other.score[rows]
        better = score > self.score
        self.score[better], self.heading[better] = score[better], other.heading[rows[better]]


def peaks(shifts: Floats, score: Image, apart: float, most: int, nearly: float = 0.0) -> list[int]:
    """Indices of the best of the shifts (K, 2), m, by score (K,), best first: at most `most`, none within `apart` m of another.

    nearly : least score as a part of the best

    Not only local maxima: along a ridge, as of a street, other cells score as well as the maximum.
    """
    x, y = np.ascontiguousarray(shifts.T)
    rest = score.copy()
    best = float(rest.max(initial=0.0))
    chosen: list[int] = []
    while len(chosen) < most and rest.max(initial=0.0) > nearly * best:
        k = int(rest.argmax())
        chosen.append(k)
        rest[(x - x[k]) ** 2 + (y - y[k]) ** 2 < apart**2] = 0
    return chosen
