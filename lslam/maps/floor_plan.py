"""Plans of a map: top view of the merged map, and a floor plan of obstacles from an occupancy map."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.types.cloud import ArrayCloud, Cloud
from lslam.maps.occupancy import OccupancyGrid

OCCUPIED, UNKNOWN, FREE = 0, 205, 254  # the grey values of ROS' map_server
LOWEST, HIGHEST = 0.3, 2.0  # m above the floor: kerbs are walked over, canopies walked under
_AROUND = 4.0  # m; what is narrower than twice that is no floor
_LONGEST = 4000  # pixels
Extent = tuple[float, float, float, float]


@dataclass(frozen=True)
class FloorPlan:
    """Floor plan: image (H, W) uint8 of `OCCUPIED`, `UNKNOWN` and `FREE`, row 0 at the largest y.

    resolution : m per pixel; x, y : world coordinates of the lower left corner of the lower left pixel, m
    """

    image: NDArray[np.uint8]
    resolution: float
    x: float
    y: float

    def yaml(self, image_name: str) -> str:
        """YAML file that ROS' map_server needs beside the image."""
        return (
            f"image: {image_name}\nresolution: {self.resolution:.6g}\norigin: [{self.x:.6g}, {self.y:.6g}, 0.0]\n"
            "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
        )


def floor_plan(grid: OccupancyGrid) -> FloorPlan:
    """Floor plan of an occupancy map.

    Occupied: something `LOWEST` to `HIGHEST` m above the floor. Free: only floor, or beams passed there. The floor follows
    the ground, and objects narrower than some metres stand on it. Steps of one cell are ignored, so cells should be half as
    high as the lowest obstacle that matters. Without cells the plan is one unknown pixel.
    """
    from scipy.ndimage import maximum_filter, minimum_filter

    if not len(grid):
        return FloorPlan(np.full((1, 1), UNKNOWN, np.uint8), grid.voxel, 0.0, 0.0)
    low = grid.cells[:, :2].min(0)
    size = grid.cells[:, :2].max(0) - low + 1
    step = int(np.ceil(size.max() / _LONGEST))
    columns = ((grid.cells[:, :2] - low) // step).astype(np.int64)
    width, height = (int(n) for n in columns.max(0) + 1)
    at = columns[:, 1] * width + columns[:, 0]
    z = grid.cells[:, 2].astype(np.int64)
    occupied = grid.is_occupied
    nowhere = np.iinfo(np.int32).max
    lowest = np.full(width * height, nowhere, np.int32)
    np.minimum.at(lowest, at[occupied], z[occupied].astype(np.int32))
    around = 2 * max(1, round(_AROUND / (grid.voxel * step))) + 1
    # An opening: it follows slopes, and what is narrower stands on it.
    eroded = minimum_filter(lowest.reshape(height, width), around, mode="nearest")
    floor = maximum_filter(np.where(eroded == nowhere, -nowhere, eroded), around, mode="nearest").ravel()
    above = (z - floor[at]) * grid.voxel
    inside = (floor[at] != -nowhere) & (above >= max(LOWEST, 1.5 * grid.voxel)) & (above <= HIGHEST)
    image = np.full(width * height, UNKNOWN, np.uint8)
    image[lowest < nowhere] = FREE
    image[at[inside & ~occupied]] = FREE
    # Higher up only: neither ground nor way has been seen under it.
    hidden = (lowest < nowhere) & ((lowest - floor) * grid.voxel > HIGHEST)
    hidden[at[inside & ~occupied]] = False
    image[hidden] = UNKNOWN
    image[at[inside & occupied]] = OCCUPIED
    resolution = grid.voxel * step
    return FloorPlan(
        np.ascontiguousarray(image.reshape(height, width)[::-1]),
        resolution,
        float(low[0] * grid.voxel),
        float(low[1] * grid.voxel),
    )


@dataclass(frozen=True)
class TopView:
    """A map seen from above.

    image : (H, W) float32 points per pixel, row 0 at the largest y; (1, 1) zero without points
    heights : (H, W) float32 their mean z, m; NaN where there are none
    extent : x_min, x_max, y_min, y_max of the image's edges, m
    """

    image: NDArray[np.float32]
    heights: NDArray[np.float32]
    extent: Extent


def pixel_size(voxel: float, least: float = 0.2) -> float:
    """Edge of a pixel, m, at least `least`, that is a multiple of the voxels' edge `voxel`, m; `least` without voxels.

    >>> round(pixel_size(0.15), 9)
    0.3
    """
    return voxel * math.ceil(least / voxel - 1e-9) if voxel else least


def top_view(cloud: Cloud | NDArray[Any], pixel: float = 0.2, longest: int = 1600, trim: float = 0.001) -> TopView:
    """Number of points of a map in each vertical column, and their mean height.

    On a voxel map the number is the occupied height, so walls stand out from the ground.

    cloud : points in the world frame, m, or an array (M, 3) of them; those that are not finite are ignored
    pixel : smallest edge of a pixel, m, a multiple of the map's voxel; a multiple of it when the long side would exceed
        `longest` pixels. Pixels hold whole columns of voxels: where some hold one and some two, the map is striped.
    trim : share of points that may fall off each side, so that a few far points do not shrink the rest
    """
    cloud = ArrayCloud.of(cloud) if isinstance(cloud, np.ndarray) else cloud
    low, high = _bounds(cloud, trim)
    if not np.all(np.isfinite([*low, *high])):
        return TopView(np.zeros((1, 1), np.float32), np.full((1, 1), np.nan, np.float32), (0.0, 1.0, 0.0, 1.0))
    # Two pixels to spare: the lower edge goes down to a whole pixel, the upper edge belongs to the last one.
    size = pixel * max(1, math.ceil(float(np.max(high - low)) / max(longest - 2, 1) / pixel))
    low = np.floor(low / size) * size
    width, height = (int(n) + 1 for n in (high - low) / size)
    counts, sums = np.zeros(width * height, np.int64), np.zeros(width * height)
    for block in cloud.blocks():
        x, y, z = block.points.T
        column, row = np.floor((x - low[0]) / size), np.floor((y - low[1]) / size)
        # What is not finite is outside.
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height) & np.isfinite(z)
        pixel_of = (height - 1 - row[inside].astype(np.int64)) * width + column[inside].astype(np.int64)
        counts += np.bincount(pixel_of, minlength=width * height)
        sums += np.bincount(pixel_of, z[inside], minlength=width * height)
    extent = (float(low[0]), float(low[0] + width * size), float(low[1]), float(low[1] + height * size))
    heights = np.divide(sums, counts, out=np.full(width * height, np.nan), where=counts > 0)
    shape = (height, width)
    return TopView(counts.reshape(shape).astype(np.float32), heights.reshape(shape).astype(np.float32), extent)


def _bounds(cloud: Cloud, trim: float) -> tuple[Floats, Floats]:
    """Quantiles `trim` and 1 - `trim` of x and y (2,), m, of a regular sample of about 100,000 points.

    It is cheap, deterministic and robust to outliers. NaN for a cloud without finite points.
    """
    step, seen = max(1, len(cloud) // 100_000), 0
    parts = [np.zeros((0, 2))]
    for block in cloud.blocks():
        parts.append(block.points[-seen % step :: step, :2].copy())  # a view would keep its whole block
        seen += len(block)
    sample = np.concatenate(parts)
    sample = sample[np.isfinite(sample).all(1)]
    if not len(sample):
        return np.full(2, np.nan), np.full(2, np.nan)
    drop = min(int(len(sample) * trim), (len(sample) - 1) // 2)
    ordered = np.sort(sample, axis=0)
    return ordered[drop], ordered[len(ordered) - 1 - drop]
