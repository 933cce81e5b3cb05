"""The Gaussian voxel map and its residuals, written again in NumPy: slow, plain, and sharing no code with the kernels."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.geometry import so3
from lslam.core.kernels import gaussians
from lslam.core.kernels.jit import kernel
from lslam.core.kernels.voxel import MASK, OFFSET

Floats = NDArray[np.float64]
Cell = tuple[int, int, int]
FLOOR = 1e-4


@kernel
def find_all(wanted: NDArray[np.int64], keys: NDArray[np.int64], table: NDArray[np.int32]) -> NDArray[np.int64]:
    """`gaussians.find` for many keys in one call."""
    out = np.empty(len(wanted), np.int64)
    for i in range(len(wanted)):
        out[i] = gaussians.find(wanted[i], keys, table)
    return out


def cell_of(key: int) -> Cell:
    """Voxel indices of a packed key."""
    return (key >> 42) - OFFSET, ((key >> 21) & MASK) - OFFSET, (key & MASK) - OFFSET


def symmetric(six: Any) -> Floats:
    """xx, xy, xz, yy, yz, zz to (3, 3)."""
    xx, xy, xz, yy, yz, zz = (float(v) for v in six)
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


@dataclass
class Voxel:
    """World points (K, 3) with a weight each; old weights fade when the count is capped."""

    points: list[Floats] = field(default_factory=list)
    weights: list[float] = field(default_factory=list)
    refreshed: float = 0.0

    @property
    def count(self) -> float:
        return float(np.sum(self.weights))

    def moments(self) -> tuple[Floats, Floats]:
        """Weighted mean (3,) and covariance (3, 3)."""
        p, w = np.array(self.points), np.array(self.weights)
        mean = (w @ p) / w.sum()
        away = p - mean
        return mean, (away * w[:, None]).T @ away / w.sum()


@dataclass
class VoxelMap:
    """Voxels by their indices, filled as `gaussians.insert` promises to."""

    size: float
    cap: float = 200.0
    voxels: dict[Cell, Voxel] = field(default_factory=dict)

    def insert(self, points: NDArray[Any], R: Floats, t: Floats) -> None:
        touched = set()
        for world in np.asarray(points, np.float64) @ R.T + t:
            i, j, k = np.floor(world / self.size).astype(int).tolist()
            voxel = self.voxels.setdefault((i, j, k), Voxel())
            voxel.points.append(world)
            voxel.weights.append(1.0)
            touched.add((i, j, k))
        for cell in touched:
            voxel = self.voxels[cell]
            if voxel.count >= 1.1 * voxel.refreshed - 1e-9:
                voxel.weights = [w * min(1.0, self.cap / voxel.count) for w in voxel.weights]
                voxel.refreshed = voxel.count


@dataclass
class Match:
    """One source point on one voxel; what a robust cost needs with the correspondence and the variance held fixed.

    normal : of a plane; None for a blob, of which `across` (3, 3) says along which axes it tells where the point is
    """

    point: Floats
    mean: Floats
    normal: Floats | None
    variance: float
    weight: float
    across: Floats = field(default_factory=lambda: np.eye(3))

    def distance2(self, R: Floats, t: Floats) -> float:
        e = R @ self.point + t - self.mean
        return float(np.sum((self.across @ e) ** 2) if self.normal is None else (self.normal @ e) ** 2)

    def cost(self, R: Floats, t: Floats, c: float) -> float:
        """Geman-McClure: the integral of r (c2 / (c2 + r2))2 dr is c2 r2 / (c2 + r2) / 2."""
        d2 = self.distance2(R, t)
        return 0.5 * self.weight / self.variance * c * c * d2 / (c * c + d2)

    def rows(self, R: Floats, t: Floats) -> tuple[Floats, Floats]:
        """Residuals (K,) and Jacobian (K, 6) for t + d[:3], exp(d[3:]) R."""
        s = R @ self.point
        e = s + t - self.mean
        J = np.hstack([np.eye(3), -so3.hat(s)])
        if self.normal is None:
            return self.across @ e, self.across @ J
        return np.array([self.normal @ e]), self.normal[None] @ J

    def information(self, R: Floats, t: Floats, c: float) -> float:
        return self.weight / self.variance * (c * c / (c * c + self.distance2(R, t))) ** 2


def sensor_axes(R: Floats, along: float) -> Floats:
    """(3, 3) what a blob is asked: its weight along the sensor's axis is so many times that across."""
    return np.asarray(np.diag([1.0, 1.0, np.sqrt(along)]) @ R.T)


def kind_of(voxel: Voxel, min_points: int, planarity: float) -> tuple[str, Floats, Floats, float, float]:
    """`empty`, `blob` or `plane`, with mean, normal, variance and tilt."""
    mean, cov = voxel.moments() if voxel.count > 0 else (np.zeros(3), np.zeros((3, 3)))
    if voxel.count < min_points:
        return "empty", mean, np.zeros(3), 0.0, 0.0
    values, vectors = np.linalg.eigh(cov)
    if values[1] - values[0] >= planarity * values[2]:
        variance = max(values[0], 0.0) + FLOOR
        return "plane", mean, vectors[:, 0], variance, variance / (voxel.count * values[1])
    return "blob", mean, np.zeros(3), float(np.trace(cov)) / 3 + FLOOR, 0.0


def matches(
    target: VoxelMap, source: Floats, scatter: Floats, R: Floats, t: Floats, sigma2: float, non_planar_weight: float,
    tilt: float, along: float, min_points: int = 6, planarity: float = 0.3,
) -> list[Match]:  # fmt: skip
    """The nearest plane of the eight voxels around each point, else the nearest non-planar voxel."""
    kinds = {cell: kind_of(v, min_points, planarity) for cell, v in target.voxels.items()}
    out = []
    for point, six in zip(source, scatter, strict=True):
        world = R @ point + t
        corner = np.floor(world / target.size - 0.5).astype(int)
        around = [tuple(np.add(corner, (i, j, k)).tolist()) for i in (0, 1) for j in (0, 1) for k in (0, 1)]
        near = [kinds[cell] for cell in around if cell in kinds and kinds[cell][0] != "empty"]
        planes = [k for k in near if k[0] == "plane"]
        chosen = planes or (near if non_planar_weight > 0 else [])
        if not chosen:
            continue
        kind, mean, normal, variance, slope = min(chosen, key=lambda k: float(np.sum((world - k[1]) ** 2)))
        C = symmetric(six)
        if kind == "blob":
            spread = float(np.trace(C)) / 3
            out.append(Match(point, mean, None, variance + spread + sigma2, non_planar_weight, sensor_axes(R, along)))
            continue
        e = world - mean
        beside2 = float(e @ e - (normal @ e) ** 2)
        spread = float(normal @ R @ C @ R.T @ normal)
        out.append(Match(point, mean, normal, variance + spread + sigma2 + tilt * slope * beside2, 1.0))
    return out
