"""The residuals beside point to plane, written again in NumPy: pairs whose matrix is held while the pose moves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from numpy_voxels import FLOOR, Cell, Voxel, VoxelMap, kind_of, symmetric

from lslam.core.geometry import so3

Floats = NDArray[np.float64]
MIN_POINTS, PLANARITY, EXTENT2, TILT = 6, 0.3, 1.0, 4.0


@dataclass
class Pair:
    """A source point on a voxel; `metres2` makes squared metres of the squared Mahalanobis distance."""

    index: int
    point: Floats
    mean: Floats
    M: Floats
    metres2: float
    weight: float = 1.0
    normal: Floats | None = None

    def error(self, R: Floats, t: Floats) -> Floats:
        return np.asarray(R @ self.point + t - self.mean)

    def mahalanobis2(self, R: Floats, t: Floats) -> float:
        e = self.error(R, t)
        return float(e @ self.M @ e)

    def distance2(self, R: Floats, t: Floats) -> float:
        return self.metres2 * self.mahalanobis2(R, t)

    def surface(self, R: Floats) -> Floats:
        """(6, 6) what the surface alone observes: the information along its normal, all of it where there is none."""
        J = self.jacobian(R)
        if self.normal is None:
            return np.asarray(J.T @ self.M @ J)
        row = self.normal @ J
        return float(self.normal @ self.M @ self.normal) * np.outer(row, row)

    def jacobian(self, R: Floats) -> Floats:
        return np.hstack([np.eye(3), -so3.hat(R @ self.point)])


class GemanMcClure:
    """Robust cost of a Mahalanobis distance, of width c in metres."""

    def __init__(self, c2: float) -> None:
        self.c2 = c2

    def cost(self, pair: Pair, R: Floats, t: Floats) -> float:
        m2 = pair.mahalanobis2(R, t)
        return 0.5 * pair.weight * self.c2 * m2 / (self.c2 + pair.metres2 * m2)

    def weight(self, pair: Pair, R: Floats, t: Floats) -> float:
        return pair.weight * (self.c2 / (self.c2 + pair.distance2(R, t))) ** 2


class Magnusson:
    """The NDT score, its Gaussians `widening` times as large (squared)."""

    def __init__(self, size: float, widening: float) -> None:
        outliers = 0.55
        c1, c2 = 10 * (1 - outliers), outliers / size**3
        d3 = -np.log(c2)
        self.d1 = -np.log(c1 + c2) - d3
        self.d2 = -2 * np.log((-np.log(c1 * np.exp(-0.5) + c2) - d3) / self.d1)
        self.widening = widening

    def cost(self, pair: Pair, R: Floats, t: Floats) -> float:
        # d1 is negative: the cost is the negative score.
        u = self.widening
        return float(self.d1 * u * np.exp(-self.d2 / (2 * u) * pair.mahalanobis2(R, t)))

    def weight(self, pair: Pair, R: Floats, t: Floats) -> float:
        return float(-self.d1 * self.d2 * np.exp(-self.d2 / (2 * self.widening) * pair.mahalanobis2(R, t)))


def around(target: VoxelMap, world: Floats) -> list[Voxel]:
    """The voxels of the eight around a point that hold anything."""
    corner = np.floor(world / target.size - 0.5).astype(int)
    cells: list[Cell] = [
        (int(corner[0] + i), int(corner[1] + j), int(corner[2] + k)) for i in (0, 1) for j in (0, 1) for k in (0, 1)
    ]
    return [target.voxels[cell] for cell in cells if cell in target.voxels]


def point_pairs(target: VoxelMap, source: Floats, R: Floats, t: Floats, sigma2: float) -> list[Pair]:
    M = np.eye(3) / (sigma2 + target.size**2 / 12)
    out = []
    for i, s in enumerate(source):
        means = [voxel.moments()[0] for voxel in around(target, R @ s + t)]
        if means:
            mean = min(means, key=lambda m: float(np.sum((R @ s + t - m) ** 2)))
            out.append(Pair(i, s, mean, M, sigma2 + target.size**2 / 12))
    return out


def disc_pairs(
    target: VoxelMap, source: Floats, covariance: Floats, R: Floats, t: Floats, sigma2: float, non_planar_weight: float,
    only_nearest: bool,
) -> list[Pair]:  # fmt: skip
    """G-ICP's pairs, or with all planes around VGICP's, whose weight is the voxel's count."""
    out, extent2 = [], max(EXTENT2, target.size**2)
    for i, (s, six) in enumerate(zip(source, covariance, strict=True)):
        world = R @ s + t
        near = [(*kind_of(v, MIN_POINTS, PLANARITY), v.count) for v in around(target, world)]
        near.sort(key=lambda k: float(np.sum((world - k[1]) ** 2)))
        planes = [k for k in near if k[0] == "plane"]
        blobs = [k for k in near if k[0] == "blob"][: 1 if non_planar_weight > 0 else 0]
        for kind, mean, normal, variance, slope, count in (planes[:1] if only_nearest else planes) or blobs:
            share = 1.0 if kind == "plane" else non_planar_weight
            if kind == "plane":
                e = world - mean
                beside2 = float(e @ e - (normal @ e) ** 2)
                across = sigma2 + variance + TILT * slope * beside2
                C_t = extent2 * (np.eye(3) - np.outer(normal, normal)) + across * np.outer(normal, normal)
                metres2 = across + sigma2
            else:
                C_t, metres2 = variance * np.eye(3), variance + sigma2
            M = np.linalg.inv(C_t + R @ symmetric(six) @ R.T)
            weight = share if only_nearest else share * count
            out.append(Pair(i, s, mean, M, metres2, weight, normal if kind == "plane" else None))
    return out


def ndt_pairs(target: VoxelMap, source: Floats, R: Floats, t: Floats) -> list[Pair]:
    out = []
    for i, s in enumerate(source):
        for voxel in around(target, R @ s + t):
            if voxel.count < MIN_POINTS:
                continue
            mean, covariance = voxel.moments()
            values, vectors = np.linalg.eigh(covariance + FLOOR * np.eye(3))
            if values[1] < 0.1 * values[2]:
                continue
            kind = kind_of(voxel, MIN_POINTS, PLANARITY)[0]
            values = np.maximum(values, 0.01 * values[2])
            if kind == "plane":
                values = np.array([values[0], *[max(EXTENT2, target.size**2)] * 2])
            out.append(Pair(i, s, mean, (vectors / values) @ vectors.T, float(values[0]), normal=vectors[:, 0]))
    return out
