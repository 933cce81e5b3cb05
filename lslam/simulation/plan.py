"""Plan of a scene: a top view with a metric grid, for picking way-points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats, Longs
from lslam.simulation.city import City
from lslam.simulation.scene_mesh import LOOKS, RayScene, Surface

Image = NDArray[np.uint8]

LARGEST_PIXELS = 2000  # pixels on a side
FINEST = 0.1  # m per pixel
BORDER = 25.0  # m round buildings and path
FINE, COARSE = 10, 50  # m between the lines of the grid
PATH = (214, 30, 40)
SKY = 1000.0  # m, whence the view is taken

COLOURS = np.array([LOOKS[surface].plan_colour for surface in Surface], np.uint8)


@dataclass(frozen=True)
class ScenePlan:
    """A top view.

    image : (H, W, 3) uint8, row 0 the north, with a line of the grid every 10 m, a darker one every 50 m, and the path
    low, high : (2,) m, x and y of its corners in the city frame; pixel : m
    surfaces : what is seen in it, in the order of `Surface`; has_path : whether there is one, whose start is a square
    """

    image: Image
    low: Floats
    high: Floats
    pixel: float
    surfaces: tuple[Surface, ...]
    has_path: bool

    def marks(self, axis: int) -> list[tuple[int, int]]:
        """Coordinates of the darker grid lines along an axis, m and pixels, from the west or the south."""
        lines = _lines(float(self.low[axis]), self.image.shape[1 - axis], self.pixel, COARSE)
        return [(int(metre), int(at)) for metre, at in zip(*lines, strict=True)]


def plan_of(scene: RayScene, city: City, line: Floats) -> ScenePlan:
    """Top view of `city` with the path `line` (M, 3), m, in the city frame; (0, 3) for none."""
    low, high = _extent(city, line)
    pixel = max(float((high - low).max()) / LARGEST_PIXELS, FINEST)
    image, surfaces = _view(scene, low, high, pixel)
    _draw_grid(image, low, pixel)
    if len(line):
        _draw_path(image, line[:, :2], low, pixel)
    return ScenePlan(image, low, high, pixel, surfaces, bool(len(line)))


def _extent(city: City, line: Floats) -> tuple[Floats, Floats]:
    """Corners (2,), m, of a plan that shows all buildings and the path."""
    places = np.concatenate([line[:, :2], *city.footprints])
    return np.floor(places.min(axis=0) - BORDER), np.ceil(places.max(axis=0) + BORDER)


def _view(scene: RayScene, low: Floats, high: Floats, pixel: float) -> tuple[Image, tuple[Surface, ...]]:
    """Image from above of `low` to `high` (2,), m, in pixels of `pixel` m, lit from the north-west; and its surfaces."""
    width, height = (int(n) for n in np.ceil((high - low) / pixel))
    image = np.full((height, width, 3), 255, np.uint8)
    x = (low[0] + (np.arange(width) + 0.5) * pixel).astype(np.float32)
    seen: set[int] = set()
    light = np.array([-0.4, 0.5, 0.77], np.float32)
    for row in range(height):
        y = np.float32(low[1] + (height - row - 0.5) * pixel)
        origins = np.column_stack([x, np.full(width, y), np.full(width, SKY, np.float32)])
        _, face = scene.cast(origins, np.broadcast_to(np.array([0, 0, -1], np.float32), origins.shape))
        met = face >= 0
        normals = scene.mesh.normals[face[met]]
        upward = normals * np.sign(normals[:, 2:3] + np.float32(1e-9))
        shade = 0.55 + 0.45 * np.clip(upward @ light, 0, 1) / light[2]
        surfaces = scene.mesh.surfaces[face[met]]
        seen.update(np.unique(surfaces).tolist())
        image[row, met] = np.clip(COLOURS[surfaces] * shade[:, None], 0, 255)
    return image, tuple(map(Surface, sorted(seen)))


def _lines(low: float, count: int, pixel: float, every: int) -> tuple[Longs, Longs]:
    """Coordinates of the grid lines along one axis, m and pixels."""
    first = int(np.ceil(low / every)) * every
    metres = np.arange(first, low + count * pixel, every).astype(np.int64)
    return metres, np.clip(np.floor((metres - low) / pixel), 0, count - 1).astype(np.int64)


def _draw_grid(image: Image, low: Floats, pixel: float) -> None:
    """Darken the lines of the metric grid in the image; low : (2,) m of its corner, pixel : m."""
    height, width, _ = image.shape
    for every, strength in ((FINE, 0.12), (COARSE, 0.45)):
        columns = _lines(float(low[0]), width, pixel, every)[1]
        rows = height - 1 - _lines(float(low[1]), height, pixel, every)[1]
        image[:, columns] = (image[:, columns] * (1 - strength)).astype(np.uint8)
        image[rows] = (image[rows] * (1 - strength)).astype(np.uint8)


def _draw_path(image: Image, line: Floats, low: Floats, pixel: float) -> None:
    """Draw the path `line` (M, 2), m, and its start into the image."""
    height, width, _ = image.shape
    steps = np.maximum(np.ceil(np.linalg.norm(np.diff(line, axis=0), axis=1) / (0.5 * pixel)).astype(int), 1)
    dense = [
        a + np.linspace(0, 1, n, endpoint=False)[:, None] * (b - a)
        for a, b, n in zip(line, line[1:], steps, strict=False)
    ]
    at = np.floor((np.concatenate([*dense, line[-1:]]) - low) / pixel).astype(int)
    start = at[0] + np.stack(np.meshgrid(np.arange(-5, 6), np.arange(-5, 6)), -1).reshape(-1, 2)
    wide = (at[:, None] + np.array([[0, 0], [1, 0], [0, 1], [-1, 0], [0, -1]])).reshape(-1, 2)
    for cells in (wide, start):
        inside = cells[((cells >= 0) & (cells < [width, height])).all(axis=1)]
        image[height - 1 - inside[:, 1], inside[:, 0]] = PATH
