"""The merged map seen from above."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.types.cloud import ArrayCloud, Cloud

Extent = tuple[float, float, float, float]


def top_view(
    cloud: Cloud | NDArray[Any], pixel: float = 0.2, longest: int = 1600, trim: float = 0.001
) -> tuple[NDArray[np.float32], Extent]:
    """Density image of a map: how many of its points lie in each column.

    On a voxel map the number is the occupied height, so walls stand out from the ground.

    Parameters
    ----------
    cloud : points in the world frame, m, or an array (M, 3) of them; those that are not finite are ignored
    pixel : smallest edge of a pixel, m, not under the map's voxel (empty lines would appear); larger when the long side
        would exceed `longest` pixels
    trim : share of points that may fall off each side, so that a few far points do not shrink the rest

    Returns
    -------
    image : (H, W) float32 points per pixel, row 0 at the largest y; (1, 1) zero without points
    extent : x_min, x_max, y_min, y_max of the image's edges, m
    """
    cloud = ArrayCloud.of(cloud) if isinstance(cloud, np.ndarray) else cloud
    low, high = _bounds(cloud, trim)
    if not np.all(np.isfinite([*low, *high])):
        return np.zeros((1, 1), np.float32), (0.0, 1.0, 0.0, 1.0)
    # One pixel to spare, because the upper edge belongs to the last pixel.
    size = max(pixel, float(np.max(high - low)) / max(longest - 1, 1))
    width, height = (int(n) + 1 for n in (high - low) / size)
    counts = np.zeros(width * height, np.int64)
    for block in cloud.blocks():
        part = block.points[:, :2]
        part = part[np.isfinite(part).all(1)]
        cell = np.floor((part - low) / size)
        inside = (cell[:, 0] >= 0) & (cell[:, 1] >= 0) & (cell[:, 0] < width) & (cell[:, 1] < height)
        column, row = cell[inside].astype(np.int64).T
        counts += np.bincount((height - 1 - row) * width + column, minlength=width * height)
    extent = (float(low[0]), float(low[0] + width * size), float(low[1]), float(low[1] + height * size))
    return counts.reshape(height, width).astype(np.float32), extent


def _bounds(cloud: Cloud, trim: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Quantiles of a regular sample of some 100,000 points: cheap, deterministic, blind to stray points."""
    step, seen = max(1, len(cloud) // 100_000), 0
    parts = [np.zeros((0, 2))]
    for block in cloud.blocks():
        parts.append(block.points[-seen % step :: step, :2])
        seen += len(block)
    sample = np.concatenate(parts)
    sample = sample[np.isfinite(sample).all(1)]
    if not len(sample):
        return np.full(2, np.nan), np.full(2, np.nan)
    drop = min(int(len(sample) * trim), (len(sample) - 1) // 2)
    ordered = np.sort(sample, axis=0)
    return ordered[drop], ordered[len(ordered) - 1 - drop]
