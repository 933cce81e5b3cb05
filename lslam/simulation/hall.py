"""A hall to fly in: walls, columns, roof beams, racks along the sides, crates on the floor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.simulation.city import City
from lslam.simulation.curve import RouteCurve
from lslam.simulation.scene_mesh import MeshBuilder, Surface
from lslam.simulation.terrain import Terrain

Floats = NDArray[np.float64]

SIDE = 12.0  # m from the middle line to the walls
END = 1.0  # m that the hall is longer than its line at either end
HEIGHT = 11.0
BAY = 7.5  # m from column to column, and from beam to beam
AISLE = 7.5  # m on both sides of the middle that are free up to the roof
LOW = 2.2  # m, of what stands in the aisle


def build_hall(line: RouteCurve, terrain: Terrain, rng: np.random.Generator) -> City:
    """The hall round a straight `line` along x, which is the middle of its floor."""
    ends = line.position(np.array([0.0, line.length]))
    low, high = float(ends[0, 0]) - END, float(ends[1, 0]) + END
    middle = float(ends[0, 1])
    builder = MeshBuilder()
    # What is above a start is no roof that one would be caught under.
    builder.add_box([low, middle - SIDE, -0.3], [high, middle + SIDE, 0.0], Surface.ROAD)
    builder.add_box([low, middle - SIDE, HEIGHT], [high, middle + SIDE, HEIGHT + 0.3], Surface.PAVEMENT)
    for y in (-SIDE, SIDE):
        builder.add_box([low, middle + y - 0.15, 0.0], [high, middle + y + 0.15, HEIGHT], Surface.WALL)
    for x in (low, high):
        builder.add_box([x - 0.15, middle - SIDE, 0.0], [x + 0.15, middle + SIDE, HEIGHT], Surface.WALL)
    for x in np.arange(low + rng.uniform(2, 4), high - 1.0, BAY).tolist():
        builder.add_box([x - 0.15, middle - SIDE, HEIGHT - 0.8], [x + 0.15, middle + SIDE, HEIGHT], Surface.WALL)
        for y in (middle - SIDE + 0.4, middle + SIDE - 0.4):
            builder.add_box([x - 0.2, y - 0.25, 0.0], [x + 0.2, y + 0.25, HEIGHT], Surface.WALL)
    for side in (-1, 1):
        _add_racks(builder, low, high, middle, side, rng)
    for x in np.arange(low + 3.0, high - 3.0, 5.0):
        at = np.array([x + rng.uniform(-1.5, 1.5), middle + rng.uniform(-AISLE, AISLE)])
        size = rng.uniform([0.4, 0.4, 0.6], [1.0, 1.0, LOW])
        builder.add_box([*(at - size[:2]), 0.0], [*(at + size[:2]), size[2]], Surface.FENCE)
    outline = np.array([[low, middle - SIDE], [high, middle - SIDE], [high, middle + SIDE], [low, middle + SIDE]])
    return City(builder.build(), terrain, line, [outline], [HEIGHT + 0.3])


def _add_racks(
    builder: MeshBuilder, low: float, high: float, middle: float, side: int, rng: np.random.Generator
) -> None:
    """Racks of different heights and depths between the aisle and one wall, with gaps."""
    x = low + rng.uniform(0.5, 3.0)
    while x < high - 3.0:
        length, depth = min(rng.uniform(2.0, 6.0), high - 0.5 - x), rng.uniform(0.8, 2.0)
        front = rng.uniform(AISLE, SIDE - 1.0 - depth)
        y = sorted((middle + side * front, middle + side * (front + depth)))
        builder.add_box([x, y[0], 0.0], [x + length, y[1], rng.uniform(1.5, 6.0)], Surface.FENCE)
        x += length + rng.uniform(0.8, 4.0)
