"""Del Tufo's baseline of matching, section 2.5: flattened scans on flattened outlines, by NDT and VGICP.

What lies below the sensor's horizon is cut off, the rest flattened; the scan is laid on all buildings near by NDT, and from
there each building on the scan by VGICP. Our kernels are made for space, so both clouds stand up again as low walls.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lslam.geometry import se2
from lslam.preprocessing.prepare import PreparedPoints
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.robust import Annealing
from lslam.registration.solver import solve

Floats = NDArray[np.float64]

SPACING = 0.25  # m between the points of an outline, and the grid of a flattened scan
HEIGHTS = (0.2, 0.7, 1.2, 1.7)  # m
NDT_VOXEL, VGICP_VOXEL = 2.0, 1.0  # m; hdl_graph_slam's NDT resolution, fast_gicp's voxel
WIDTH, STEPS = 2.0, 40  # m, where the kernel opens; Gauss-Newton steps at most
NOISE = 0.1  # m
LEAST_POINTS = 20
LEAST_OVERLAP = 0.1  # share of the points that found a voxel
FARTHEST = 5.0  # m from the prior; farther is no convergence
FAR = 1.0  # m; points farther from their nearest one do not count in the fitness score (the range of hdl_graph_slam's)


@dataclass(frozen=True)
class FlatFit:
    """A planar pose (3,) of the source in the target; rmse : m, of those of its points that have one within `FAR` m, to it."""

    pose: Floats
    rmse: float
    overlap: float


def flatten_scan(cloud: NDArray[np.float32], reach: float) -> Floats:
    """(N, 2) m, one a cell, of the points (N, 3) of a level scan above the sensor's horizon within `reach` m."""
    flat = cloud[(cloud[:, 2] > 0) & (np.abs(cloud[:, :2]).max(axis=1, initial=0.0) < reach), :2].astype(np.float64)
    _, first = np.unique(np.floor(flat / SPACING).astype(np.int64), axis=0, return_index=True)
    return np.asarray(flat[np.sort(first)])


def outline_points(walls: NDArray[np.float64]) -> Floats:
    """(N, 2) points along walls (T, 2, 2), m."""
    found = []
    for a, b in walls:
        shares = np.linspace(0, 1, max(int(np.linalg.norm(b - a) / SPACING), 1) + 1)[:-1, None]
        found.append(a + shares * (b - a))
    return np.concatenate(found) if found else np.zeros((0, 2))


def lay_scan(seen: Floats, walls: NDArray[np.float64], prior: Floats) -> FlatFit | None:
    """The flattened scan (N, 2) on all `walls` (T, 2, 2), by NDT from `prior` (3,); None without convergence."""
    return _align(seen, outline_points(walls), prior, NDT_VOXEL, "ndt")


def lay_building(walls: NDArray[np.float64], seen: Floats, prior: Floats) -> FlatFit | None:
    """One building's `walls` (T, 2, 2), about its middle, on the flattened scan (N, 2), by VGICP; None likewise."""
    return _align(outline_points(walls), seen, prior, VGICP_VOXEL, "vgicp")


def _align(
    source: Floats, target: Floats, prior: Floats, voxel: float, residual: Literal["ndt", "vgicp"]
) -> FlatFit | None:
    from scipy.spatial import cKDTree

    if min(len(source), len(target)) < LEAST_POINTS:
        return None
    ground = GaussianMap(voxel, reach=np.inf, capacity=1 << int(np.ceil(np.log2(len(target) * len(HEIGHTS)))))
    ground.insert(_upright(target, HEIGHTS).astype(np.float32), np.eye(4))
    upright = _upright(source, HEIGHTS)
    points = PreparedPoints(upright.astype(np.float32), upright, np.zeros((len(upright), 6)), len(upright))
    found = solve(
        ground, points, se2.to_se3(prior), Annealing(WIDTH, 0.5, 0.8, STEPS), sigma=NOISE, blob_weight=1.0,
        weak_share=0.0, residual=residual,
    )  # fmt: skip
    pose = se2.of_se3(found.T_world_lidar)
    if not found.ok or found.overlap < LEAST_OVERLAP or np.linalg.norm(pose[:2] - prior[:2]) > FARTHEST:
        return None
    away = np.asarray(cKDTree(target).query(se2.apply(pose, source))[0])
    near = away[away <= FAR]
    return FlatFit(pose, float(np.sqrt(np.mean(near**2))), found.overlap) if len(near) else None


def _upright(flat: Floats, heights: Sequence[float]) -> Floats:
    """Every point at each of the heights: (N * H, 3)."""
    return np.concatenate([np.column_stack([flat, np.full(len(flat), z)]) for z in heights])
