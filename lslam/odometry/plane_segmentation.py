"""Planes of one scan: regions grown over Gaussian voxels, as closest points with covariances.

A plane n . x = d is its closest point to the origin, p = n d (Geneva et al. 2018): three numbers for three degrees of freedom,
and the sign of the normal drops out. It is singular where d = 0, so that a plane is kept in the frame of a sensor that saw it,
its anchor.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Bools, Floats, Longs
from lslam.core.geometry import so3
from lslam.core.kernels import gaussians
from lslam.core.kernels.voxel import MASK, OFFSET
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.local_map import LEAST_BREADTH

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix
    from scipy.spatial import cKDTree

# m, edge of the voxels: at 15 m two rings of a 16-beam sensor fall into one.
VOXEL_M = 1.0
# Points of a voxel that is asked at all, and of one that a plane may begin in.
FEWEST, LEAST_SEED = 3, 8
# m, rms distance of a voxel's points from the plane that takes it: three sigma of ranging and calibration.
ON_PLANE_M = 0.09
# Times the usual mean square of a plane's voxels: beyond, a voxel holds points of another surface too.
MIXED_RATIO = 4.0
# Cosine of 20 deg between the plane's normal and a planar voxel's.
ALIKE_COSINE = 0.94
# m, between means of voxels that touch: beyond the next but one there is a gap.
TOUCHING_M = 2.2
# m, so far round the seed the plane is fitted, step after step; nothing farther is of it, since ground and long walls bend.
GROWTH_M = (2.0, 4.0, 8.0, 16.0, 30.0)
# Voxels and points of a plane; m, least standard deviation of its points across its length: a strip has no normal.
LEAST_VOXELS, LEAST_POINTS, BREADTH_M = 5, 40, 0.3
# m, least distance of the sensor from a plane: the closest point of a nearer one has no direction.
LEAST_DISTANCE_M = 0.3
# m, least noise of the points, each the mean of what one sensor measures in a cell.
LEAST_SIGMA_M = 0.01
# m and rad, one sigma, of what all points of a plane are off by together: ranging has a bias, deskewing leaves some motion, and
# another part of a wall, seen from elsewhere, leans a little.
COMMON_M, COMMON_RAD = 0.005, np.deg2rad(0.03)
# Voxels so many times larger begin planes where small ones hold one ring each, on the ground round the sensor.
WIDE_FACTOR = 3
# Planes of a scan, and seeds that are tried for them.
MOST_PLANES, MOST_SEEDS = 60, 150


def to_hesse(cp: Floats) -> tuple[Floats, Floats]:
    """Normals (..., 3) and distances (...) of closest points (..., 3), m."""
    distance = np.linalg.norm(cp, axis=-1)
    return cp / distance[..., None], distance


def transform_planes(cp: Floats, T: Floats) -> Floats:
    """Closest points (..., 3) in frame a of planes given in frame b; T : (..., 4, 4) T_b_a."""
    n, d = to_hesse(cp)
    ahead = d - np.einsum("...i,...i->...", n, T[..., :3, 3])
    return np.asarray(np.einsum("...ji,...j->...i", T[..., :3, :3], n) * ahead[..., None])


def linearise_view(cp: Floats, T_world_anchor: Floats, T_world_lidar: Floats) -> tuple[Floats, Floats, Floats]:
    """Planes as a LiDAR sees them, and how that changes with its pose and with the planes.

    cp : (K, 3) in their anchors, m; T_world_anchor, T_world_lidar : (K, 4, 4)

    Returns (K, 3) closest points in the LiDAR frames; (K, 3, 6) by t' = t + d[:3], R' = exp(d[3:]) R of the LiDAR, world axes;
    (K, 3, 3) by `cp`.
    """
    n, d = to_hesse(cp)
    Ra, Rl = T_world_anchor[:, :3, :3], T_world_lidar[:, :3, :3]
    n_world = np.einsum("kij,kj->ki", Ra, n)
    n_lidar = np.einsum("kji,kj->ki", Rl, n_world)
    offset = np.einsum("kji,kj->ki", Ra, T_world_lidar[:, :3, 3] - T_world_anchor[:, :3, 3])
    ahead = d - np.einsum("ki,ki->k", n, offset)
    by_pose = np.empty((len(cp), 3, 6))
    by_pose[:, :, :3] = -n_lidar[:, :, None] * n_world[:, None, :]
    by_pose[:, :, 3:] = ahead[:, None, None] * (np.swapaxes(Rl, 1, 2) @ so3.hat(n_world))
    across = (np.eye(3) - n[:, :, None] * n[:, None, :]) / d[:, None, None]
    along = n - np.einsum("kij,kj->ki", across, offset)
    by_plane = ahead[:, None, None] * (np.swapaxes(Rl, 1, 2) @ Ra @ across) + n_lidar[:, :, None] * along[:, None, :]
    return n_lidar * ahead[:, None], by_pose, by_plane


def plane_covariance(cp: Floats, count: float, mean: Floats, scatter: Floats, variance: float) -> Floats:
    """(3, 3) m2 of a closest point (3,) that `count` points fitted, each off the plane with `variance`, m2.

    mean (3,), scatter (3, 3) : m, m2, first moment and covariance of the points
    The inverse of the Fisher information: n . x - d changes with the closest point by (I - n nT) x / d - n.
    """
    n, d = to_hesse(cp)
    across = (np.eye(3) - np.outer(n, n)) / d
    along = across @ mean - n
    return np.asarray(np.linalg.inv(count * (across @ scatter @ across + np.outer(along, along)) / variance))


@dataclass(frozen=True)
class Planes:
    """Planes seen by one scan, LiDAR frame.

    cp : (K, 3) closest points, m; covariance : (K, 3, 3) m2; counts : (K,) points of each
    means (K, 3), scatters (K, 3, 3) : first moment and covariance of the points, m and m2; rms : (K,) off the plane, m
    lows, highs : (K, 3) corners of the boxes round the means of its voxels, m
    """

    cp: Floats
    covariance: Floats
    counts: Floats
    means: Floats
    scatters: Floats
    rms: Floats
    lows: Floats
    highs: Floats

    def __len__(self) -> int:
        return len(self.cp)


class PlaneExtractor:
    """Extracts the planes of one scan after another; only the allocated voxel memory is reused.

    sigma : m, noise of a point, lower bound of a plane's
    common_m, common_rad : one sigma of the error that all points of a plane share
    """

    def __init__(
        self, sigma: float = LEAST_SIGMA_M, common_m: float = COMMON_M, common_rad: float = COMMON_RAD
    ) -> None:
        self.sigma, self.common_m, self.common_rad = sigma, common_m, common_rad
        self._voxels = GaussianMap(
            VOXEL_M,
            min_points=LEAST_SEED,
            count_cap=np.inf,
            reach=np.inf,
            capacity=1 << 13,
            breadth=LEAST_BREADTH,
        )

    def extract(self, points: NDArray[np.float32]) -> Planes:
        """Planes of deskewed points (N, 3), m, LiDAR frame; grown from the most certain seeds first."""
        voxels = self._voxels
        voxels.clear()
        voxels.insert(points, np.eye(4))
        used = int(voxels.pool[gaussians.USED])
        order = np.argsort(voxels.keys[:used], kind="stable")
        cells = _Cells.of(voxels, order[voxels.moments[order, 0] >= FEWEST])
        wide = voxels.coarsen(WIDE_FACTOR)
        few = np.argsort(wide.keys[: len(wide)], kind="stable")
        regions = self._regions(
            cells, [_Seeds.of(cells, voxels.planes[order]), _Seeds.of(cells, wide.planes[few], WIDE_FACTOR)]
        )
        if not regions:
            none = np.zeros((0, 3))
            return Planes(none, np.zeros((0, 3, 3)), np.zeros(0), none, np.zeros((0, 3, 3)), np.zeros(0), none, none)
        return Planes(*(np.stack(column) for column in zip(*regions, strict=True)))

    def _regions(self, cells: _Cells, sizes: list[_Seeds]) -> list[tuple[Floats, ...]]:
        """Planes grown from seeds of increasing voxel size, over voxels that no plane has yet; at most `MOST_PLANES`."""
        free, regions = np.ones(len(cells.means), bool), list[tuple[Floats, ...]]()
        trials = 0
        for seeds in sizes:
            fresh = free.copy()
            for cell, mean, normal in zip(seeds.cells, seeds.means, seeds.normals, strict=True):
                if not fresh[cell] or len(regions) == MOST_PLANES or trials == MOST_SEEDS:
                    continue
                trials += 1
                region = cells.grow(int(cell), mean, normal, seeds.radii, free)
                fresh[cell] = False
                fresh[region] = False
                plane = self._plane(cells, region)
                if plane is not None:
                    free[region] = False
                    regions.append(plane)
        return regions

    def _plane(self, cells: _Cells, region: Longs) -> tuple[Floats, ...] | None:
        """The plane of a region of voxels in the order of `Planes`, None where it is too small."""
        if len(region) < LEAST_VOXELS or cells.counts[region].sum() < LEAST_POINTS:
            return None
        n, d, fit = _fit(cells.counts[region], cells.means[region], cells.scatters[region])
        if fit.values[1] < BREADTH_M**2 or abs(d) < LEAST_DISTANCE_M:
            return None
        cp, variance = n * d, max(float(fit.values[0]), self.sigma**2)
        C = plane_covariance(cp, fit.count, fit.mean, fit.scatter, variance) + self._common(cp)
        rms = np.sqrt(max(float(fit.values[0]), 0.0))
        means = cells.means[region]
        return (
            cp,
            C,
            np.asarray(fit.count),
            fit.mean,
            fit.scatter,
            np.asarray(rms),
            means.min(axis=0),
            means.max(axis=0),
        )

    def _common(self, cp: Floats) -> Floats:
        """(3, 3) m2 covariance of a closest point (3,) by the error that all points of the plane share."""
        n, d = to_hesse(cp)
        along = np.outer(n, n)
        return np.asarray(self.common_m**2 * along + (self.common_rad * float(d)) ** 2 * (np.eye(3) - along))


@dataclass(frozen=True)
class _Moments:
    """Moments of points: their number, mean (3,), covariance (3, 3), m2, and its ascending eigenvalues (3,)."""

    count: float
    mean: Floats
    scatter: Floats
    values: Floats


def _fit(counts: Floats, means: Floats, scatters: Floats) -> tuple[Floats, float, _Moments]:
    """Fit the plane n . x = d to the points of voxels: n (3,), d (m) and the moments of all points.

    counts (V,), means (V, 3), m, scatters (V, 3, 3), m2 : moments of each voxel's points
    """
    count = float(counts.sum())
    mean = np.einsum("v,vi->i", counts, means) / count
    off = means - mean
    scatter = np.einsum("v,vij->ij", counts, scatters + off[:, :, None] * off[:, None, :]) / count
    values, vectors = np.linalg.eigh(scatter)
    n = vectors[:, 0]
    return n, float(n @ mean), _Moments(count, mean, scatter, values)


@dataclass(frozen=True)
class _Cells:
    """Voxels of a scan: counts (V,), means (V, 3), scatters (V, 3, 3), normals (V, 3) and tilts (V,), positive on
    planes; a tree of the means, and which of them touch.
    """

    counts: Floats
    means: Floats
    scatters: Floats
    normals: Floats
    tilts: Floats
    tree: cKDTree
    touching: csr_matrix

    @classmethod
    def of(cls, voxels: GaussianMap, slots: Longs) -> _Cells:
        """The cells of the voxels in `slots`, neighbours being those whose means lie within `TOUCHING_M`."""
        from scipy.sparse import csr_matrix
        from scipy.spatial import cKDTree

        s = voxels.moments[slots]
        key, count = voxels.keys[slots], s[:, 0]
        cell = np.stack([key >> 42, (key >> 21) & MASK, key & MASK], axis=1) - OFFSET
        mean = s[:, 1:4] / count[:, None]
        second = s[:, [4, 5, 6, 5, 7, 8, 6, 8, 9]].reshape(-1, 3, 3) / count[:, None, None]
        scatter = second - mean[:, :, None] * mean[:, None, :]
        mean += (cell + 0.5) * voxels.size
        tree = cKDTree(mean)
        pairs = tree.query_pairs(TOUCHING_M, output_type="ndarray")
        touching = csr_matrix((np.ones(len(pairs), np.int8), pairs.T), (len(mean), len(mean)))
        return cls(count, mean, scatter, voxels.planes[slots, 3:6], voxels.planes[slots, 7], tree, touching)

    def grow(self, seed: int, mean: Floats, n: Floats, radii: tuple[float, ...], free: Bools) -> Longs:
        """Sorted indices of `free` voxels connected to `seed` that lie on the plane through `mean` (3,) with normal n (3,)."""
        d, alone = float(n @ mean), np.array([seed])
        region = alone
        for radius in radii:
            around = np.array(self.tree.query_ball_point(mean, radius, return_sorted=True), np.int64)
            around = around[free[around]]
            region = around[self._on(around, n, d)]
            if len(region) < 3:
                return alone
            n, d, _ = _fit(self.counts[region], self.means[region], self.scatters[region])
        thick = self._off(region, n, d)
        region = region[thick <= MIXED_RATIO * np.median(thick)]
        at = np.flatnonzero(region == seed)
        if len(at) == 0 or len(region) < LEAST_VOXELS:
            return alone
        from scipy.sparse.csgraph import connected_components

        _, label = connected_components(self.touching[region][:, region], directed=False)
        return np.asarray(region[label == label[at[0]]])

    def _on(self, some: Longs, n: Floats, d: float) -> Bools:
        """Mask of the voxels `some` whose points lie on the plane n . x = d, and whose normals, if any, are like n (3,)."""
        is_alike = (self.tilts[some] <= 0) | (np.abs(np.einsum("vi,i->v", self.normals[some], n)) > ALIKE_COSINE)
        return np.asarray((self._off(some, n, d) < ON_PLANE_M**2) & is_alike)

    def _off(self, some: Longs, n: Floats, d: float) -> Floats:
        """Mean squares, m2, of the distances of some voxels' points from the plane n . x = d."""
        off = np.einsum("vi,i->v", self.means[some], n) - d
        return np.asarray(np.einsum("vij,ij->v", self.scatters[some], np.outer(n, n)) + off**2)


@dataclass(frozen=True)
class _Seeds:
    """Seeds of region growing: nearest cell, point, m, and normal (S, 3) of each, and the `radii` of growth, m."""

    cells: Longs
    means: Floats
    normals: Floats
    radii: tuple[float, ...]

    @classmethod
    def of(cls, cells: _Cells, planes: Floats, size: int = 1) -> _Seeds:
        """Seeds at the planar ones of the voxels `planes` (V, 8), most certain first, each at the nearest of the `cells`.

        planes : mean, normal, variance, and tilt variance, positive on planes; size : edge of such a voxel, in cells
        """
        planes = planes[planes[:, 7] > 0]
        planes = planes[np.argsort(planes[:, 7], kind="stable")]
        nearest = np.zeros(0, np.int64)
        if len(planes) and len(cells.means):
            nearest = np.asarray(cells.tree.query(planes[:, :3])[1], np.int64)
        return cls(
            nearest, planes[: len(nearest), :3], planes[: len(nearest), 3:6], tuple(r for r in GROWTH_M if r > size)
        )


def boxes_in(planes: Planes, T: Floats) -> tuple[Floats, Floats]:
    """Corners (K, 3) of the boxes round the planes in the frame that T (4, 4) takes them to."""
    centre, half = 0.5 * (planes.lows + planes.highs), 0.5 * (planes.highs - planes.lows)
    moved, grown = centre @ T[:3, :3].T + T[:3, 3], half @ np.abs(T[:3, :3]).T
    return moved - grown, moved + grown
