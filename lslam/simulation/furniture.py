"""Objects of a street: trees, poles, hedges, garden walls, bins and parked cars.

Local frames: z = 0 is the ground, the object's middle at x = y = 0, its long side along x.
"""

from __future__ import annotations

import numpy as np

from lslam.core.geometry import portable
from lslam.core.types.arrays import Floats
from lslam.simulation.scene_mesh import MeshBuilder, SceneMesh, Surface, grid_faces, tube

BUSHES = 0.35  # share of the trees that are bushes, where leaves fill volumes


def tree(rng: np.random.Generator, volume: bool = False) -> SceneMesh:
    """A trunk with a crown of leaf clusters, which some rays pass; or with a volume of leaves; or a bush."""
    if volume:
        return _leafy(rng)
    builder = MeshBuilder()
    trunk, radius = rng.uniform(2.0, 3.0), rng.uniform(0.1, 0.25)
    builder.add(*tube(radius, 0.7 * radius, -0.5, trunk + 1.0, 8), Surface.TRUNK)
    size = np.array([1.0, 1.0, rng.uniform(1.0, 1.4)]) * rng.uniform(1.2, 2.2)
    count = int(140 * size[0] ** 2)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    # Leaves crowd towards the outside of a crown.
    centres = direction * size * rng.uniform(0.45, 1.0, (count, 1)) + [0, 0, trunk + size[2]]
    corners = centres[:, None] + rng.normal(0, 0.16, (count, 3, 3))
    builder.add(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3), Surface.FOLIAGE)
    return builder.build()


def _leafy(rng: np.random.Generator) -> SceneMesh:
    builder = MeshBuilder()
    if rng.random() < BUSHES:
        size = np.array([1.0, rng.uniform(0.7, 1.4), rng.uniform(0.6, 1.0)]) * rng.uniform(0.6, 1.4)
        _add_crown(builder, rng, size, 0.7 * size[2])
        return builder.build()
    trunk, radius = rng.uniform(1.6, 3.0), rng.uniform(0.1, 0.25)
    size = np.array([1.0, 1.0, rng.uniform(1.0, 1.5)]) * rng.uniform(1.4, 2.8)
    builder.add(*tube(radius, 0.5 * radius, -0.5, trunk + size[2], 8), Surface.TRUNK)
    _add_crown(builder, rng, size, trunk + size[2])
    return builder.build()


def _add_crown(builder: MeshBuilder, rng: np.random.Generator, size: Floats, height: float) -> None:
    """Add the bumpy envelope of leaves, an ellipsoid with half axes `size` (3,), m, faces oriented outwards."""
    rows, columns = 8, 12
    polar, round_ = np.linspace(0, np.pi, rows), np.linspace(0, 2 * np.pi, columns + 1)
    bumps = 1 + rng.normal(0, 0.12, (rows, columns + 1))
    # Its poles and its seam are one place each.
    bumps[0], bumps[-1], bumps[:, -1] = bumps[0, 0], bumps[-1, 0], bumps[:, 0]
    flat = portable.sin(polar)[:, None] * np.ones(columns + 1)
    at = np.stack(
        [flat * portable.cos(round_), flat * portable.sin(round_), portable.cos(polar)[:, None] * np.ones(columns + 1)],
        axis=-1,
    )
    vertices = at * bumps[..., None] * size + [0, 0, height]
    builder.add(vertices.reshape(-1, 3), grid_faces(rows, columns + 1), Surface.CROWN)


def pole(rng: np.random.Generator) -> SceneMesh:
    """A street lamp with an arm towards +y, or a traffic sign."""
    builder = MeshBuilder()
    if rng.random() < 0.6:
        height = rng.uniform(4.5, 7.0)
        builder.add(*tube(0.09, 0.06, -0.5, height, 8), Surface.POLE)
        builder.add_box([-0.05, 0, height - 0.1], [0.05, 1.3, height], Surface.POLE)
        builder.add_box([-0.12, 0.9, height - 0.18], [0.12, 1.5, height - 0.1], Surface.POLE)
    else:
        height = rng.uniform(2.3, 2.8)
        builder.add(*tube(0.04, 0.04, -0.5, height, 6), Surface.POLE)
        builder.add_box([-0.035, -0.3, height - 0.65], [-0.03, 0.3, height], Surface.POLE)
    return builder.build()


def hedge(rng: np.random.Generator, length: float, volume: bool = False) -> SceneMesh:
    """A hedge of `length` m with a bumpy surface, opaque or filled with a volume of leaves."""
    height, width = rng.uniform(0.8, 1.7), rng.uniform(0.5, 0.9)
    rows, columns = 7, max(int(length / 0.3), 2)
    outline = np.array([[-0.5, -0.3], [-0.5, 0.5], [-0.5, 0.95], [0, 1.0], [0.5, 0.95], [0.5, 0.5], [0.5, -0.3]]) * [
        width,
        height,
    ]
    along = np.linspace(-length / 2, length / 2, columns)
    vertices = np.empty((rows, columns, 3))
    vertices[..., 0] = along
    vertices[..., 1:] = outline[:, None]
    vertices += rng.normal(0, 0.05, vertices.shape)
    builder = MeshBuilder()
    leaves = Surface.HEDGE if volume else Surface.FOLIAGE
    # Wound outwards where it counts: the side as a volume needs it, the first end as it is.
    builder.add(vertices.reshape(-1, 3), grid_faces(rows, columns)[:, :: -1 if volume else 1], leaves)
    for end, turn in ((vertices[:, 0], 1), (vertices[:, -1], -1 if volume else 1)):
        builder.add(end, np.array([[0, i, i + 1] for i in range(1, rows - 1)])[:, ::turn], leaves)
    return builder.build()


def garden_wall(rng: np.random.Generator, length: float) -> SceneMesh:
    """A low wall of `length` m with posts."""
    builder = MeshBuilder()
    height = rng.uniform(0.6, 1.3)
    builder.add_box([-length / 2, -0.1, -0.6], [length / 2, 0.1, height], Surface.FENCE)
    for x in np.linspace(-length / 2, length / 2, max(int(length / 2.5), 1) + 1):
        builder.add_box([x - 0.17, -0.17, -0.6], [x + 0.17, 0.17, height + 0.2], Surface.FENCE)
    return builder.build()


def bins(rng: np.random.Generator) -> SceneMesh:
    """One to three rubbish bins in a row."""
    builder = MeshBuilder()
    for k in range(int(rng.integers(1, 4))):
        x, y = 0.75 * k + rng.uniform(-0.05, 0.05), rng.uniform(-0.1, 0.1)
        builder.add_box([x - 0.3, y - 0.35, -0.3], [x + 0.3, y + 0.35, rng.uniform(0.95, 1.15)], Surface.FENCE)
    return builder.build()


# Side views of a car body and its cabin: x over the length, z over the height, both 0..1.
_BODY = np.array([[0.0, 0.22], [0.0, 0.55], [0.04, 0.62], [0.96, 0.62], [1.0, 0.5], [1.0, 0.22]])
_SALOON = np.array([[0.08, 0.6], [0.22, 0.97], [0.55, 1.0], [0.72, 0.62]])
_ESTATE = np.array([[0.01, 0.6], [0.05, 0.97], [0.55, 1.0], [0.73, 0.62]])
_VAN = np.array([[0.0, 0.6], [0.01, 1.0], [0.78, 1.0], [0.93, 0.62]])


def parked_car(rng: np.random.Generator) -> SceneMesh:
    """A saloon, estate or van along x, front towards +x."""
    kind = rng.random()
    cabin = _SALOON if kind < 0.45 else _ESTATE if kind < 0.85 else _VAN
    length, width = rng.uniform(3.8, 4.7), rng.uniform(1.7, 1.85)
    height = rng.uniform(1.9, 2.3) if cabin is _VAN else rng.uniform(1.4, 1.6)
    size = np.array([length, height])
    builder = MeshBuilder()
    _extrude(builder, (_BODY - [0.5, 0]) * size, width / 2, Surface.CAR)
    panes = Surface.CAR if cabin is _VAN else Surface.PANE
    _extrude(builder, (cabin - [0.5, 0]) * size, width / 2 - 0.12, panes)
    roof = (cabin[1:3] - [0.5, 0]) * size
    low, high = [roof[0, 0], 0.14 - width / 2, roof[:, 1].min() - 0.08], [roof[1, 0], width / 2 - 0.14, height + 0.01]
    builder.add_box(low, high, Surface.CAR)
    for x in (-0.32 * length, 0.32 * length):
        for y in (-width / 2 + 0.12, width / 2 - 0.12):
            builder.add_box([x - 0.3, y - 0.1, 0.0], [x + 0.3, y + 0.1, 0.6], Surface.CAR)
    return builder.build()


def _extrude(builder: MeshBuilder, outline: Floats, half_width: float, surface: int) -> None:
    """A convex side view (K, 2) of x and z extruded along y, closed on all sides."""
    count = len(outline)
    sides = [np.column_stack([outline[:, 0], np.full(count, y), outline[:, 1]]) for y in (-half_width, half_width)]
    here, there = np.arange(count), (np.arange(count) + 1) % count
    builder.add_quads(np.stack([sides[0][here], sides[0][there], sides[1][there], sides[1][here]], axis=1), surface)
    fan = np.array([[0, i, i + 1] for i in range(1, count - 1)])
    for side in sides:
        builder.add(side, fan, surface)
