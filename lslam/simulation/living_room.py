"""A furnished room of five by four metres, and a round through its middle."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.simulation.city import City
from lslam.simulation.curve import RouteCurve, rounded_rectangle, smooth_curve
from lslam.simulation.scene_mesh import MeshBuilder, Surface
from lslam.simulation.terrain import Terrain

Floats = NDArray[np.float64]

SIZE = np.array([5.0, 4.0, 2.6])  # m, clear
LOOP = (1.8, 1.2, 0.5)  # m along and across, and radius of its corners
TABLE = (1.2, 0.7, 0.75)  # m
SHELVES, BOXES = 7, 16


def room_line() -> RouteCurve:
    """Round the middle of the room."""
    return smooth_curve(rounded_rectangle(*LOOP), closed=True, smoothing=0.1)


def build_room(line: RouteCurve, terrain: Terrain, rng: np.random.Generator) -> City:
    """The room round `room_line`; where its furniture stands differs from seed to seed."""
    builder, half = MeshBuilder(), SIZE / 2
    low, high = np.array([-half[0], -half[1], 0.0]), np.array([half[0], half[1], SIZE[2]])
    # What is above a start is no roof that one would be caught under.
    for z in (0.0, SIZE[2]):
        builder.add_box([low[0], low[1], z - 0.1], [high[0], high[1], z], Surface.PAVEMENT)
    for axis in (0, 1):
        for side in (low, high):
            a, b = low - 0.1, high + 0.1
            a[axis], b[axis], a[2], b[2] = side[axis] - 0.05, side[axis] + 0.05, 0.0, SIZE[2]
            builder.add_box(a, b, Surface.WALL)
    _add_shelves(builder, rng)
    corner = half[:2] * rng.choice([-1.0, 1.0], 2)
    _add_table(builder, corner - np.sign(corner) * (np.array(TABLE[:2]) / 2 + 0.05), rng)
    outline = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    return City(builder.build(), terrain, line, [outline], [SIZE[2]])


def _add_shelves(builder: MeshBuilder, rng: np.random.Generator) -> None:
    """Cupboards along the walls, with boxes on top of them."""
    for _ in range(SHELVES):
        axis, side = int(rng.integers(0, 2)), float(rng.choice([-1.0, 1.0]))
        depth, width, height = rng.uniform(0.2, 0.4), rng.uniform(0.4, 1.2), rng.uniform(0.4, 1.9)
        a, b = np.zeros(3), np.zeros(3)
        wall = side * SIZE[axis] / 2
        a[axis], b[axis] = sorted((wall, wall - side * depth))
        along = rng.uniform(-1, 1) * (SIZE[1 - axis] / 2 - width / 2)
        a[1 - axis], b[1 - axis], b[2] = along - width / 2, along + width / 2, height
        builder.add_box(a, b, Surface.FENCE)
        at = a + (b - a) * rng.uniform(0.1, 0.6, 3)
        at[2] = height
        builder.add_box(at, at + rng.uniform([0.1, 0.1, 0.1], [0.2, 0.2, 0.4]), Surface.FENCE)


def _add_table(builder: MeshBuilder, middle: Floats, rng: np.random.Generator) -> None:
    """A table on four legs, with things on it."""
    half, top = np.array(TABLE[:2]) / 2, TABLE[2]
    builder.add_box([*(middle - half), top - 0.03], [*(middle + half), top], Surface.FENCE)
    for corner in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        leg = middle + np.array(corner) * (half - 0.05)
        builder.add_box([*(leg - 0.03), 0.0], [*(leg + 0.03), top], Surface.FENCE)
    for _ in range(BOXES):
        at, size = middle + rng.uniform(-0.9, 0.9, 2) * half, rng.uniform([0.04, 0.04, 0.05], [0.15, 0.15, 0.4])
        builder.add_box([*(at - size[:2] / 2), top], [*(at + size[:2] / 2), top + size[2]], Surface.FENCE)
