"""Objects of a street: houses, trees, poles, hedges, garden walls, bins and parked cars.

Local frames: z = 0 is the ground, the object's middle at x = y = 0, its long side along x. Of a house x is along the street, the
front at y = 0 facing -y, the lot behind at y > 0, z = 0 the ground at the door.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.geometry import portable
from lslam.simulation.scene_mesh import MeshBuilder, SceneMesh, Surface, grid_faces, tube

Quad = list[tuple[float, float, float]]

FOUNDATION = -1.5  # m, walls reach below uneven ground
HIGHEST_ROOF = 5.0  # m from the eaves to the ridge
BUSHES = 0.35  # share of the trees that are bushes, where leaves fill volumes


def tree(rng: np.random.Generator, volume: bool = False) -> SceneMesh:
    """A tree: a trunk with a crown of leaf clusters that some rays pass, a trunk with a leaf volume, or a bush."""
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
    """A tree or bush whose crown is a volume of leaves."""
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
    """Add a convex side view (K, 2) of x and z, m, extruded along y to both sides by `half_width`, m, closed on all sides."""
    count = len(outline)
    sides = [np.column_stack([outline[:, 0], np.full(count, y), outline[:, 1]]) for y in (-half_width, half_width)]
    here, there = np.arange(count), (np.arange(count) + 1) % count
    builder.add_quads(np.stack([sides[0][here], sides[0][there], sides[1][there], sides[1][here]], axis=1), surface)
    fan = np.array([[0, i, i + 1] for i in range(1, count - 1)])
    for side in sides:
        builder.add(side, fan, surface)


@dataclass(frozen=True)
class _HouseStyle:
    """What the facades of one house share, m."""

    storeys: int
    storey: float
    window: float
    spacing: float
    sill: float
    head: float
    recess: float

    @property
    def eaves(self) -> float:
        return self.storeys * self.storey + 0.3


def house(rng: np.random.Generator, width: float, depth: float, storeys: tuple[int, int] = (2, 4)) -> SceneMesh:
    """A house on a (width x depth) m footprint, with a number of storeys drawn from the range `storeys`."""
    style = _HouseStyle(
        storeys=int(rng.integers(storeys[0], storeys[1] + 1)),
        storey=rng.uniform(2.7, 3.3),
        window=rng.uniform(0.9, 1.5),
        spacing=rng.uniform(2.2, 3.2),
        sill=rng.uniform(0.7, 1.0),
        head=rng.uniform(2.1, 2.4),
        recess=rng.uniform(0.12, 0.3),
    )
    builder = MeshBuilder()
    w, d = width / 2, depth
    front_left, front_right = np.array([-w, 0.0]), np.array([w, 0.0])
    back_left, back_right = np.array([-w, d]), np.array([w, d])
    _facade(builder, rng, style, front_left, front_right, street=True)
    _facade(builder, rng, style, front_right, back_right, street=False)
    _facade(builder, rng, style, back_right, back_left, street=False)
    _facade(builder, rng, style, back_left, front_left, street=False)
    if rng.random() < 0.65:
        _gabled_roof(builder, width, depth, style.eaves, rng.uniform(0.55, 0.95), along=bool(rng.random() < 0.7))
    else:
        _flat_roof(builder, width, depth, style.eaves)
    _porch(builder, rng, width)
    return builder.build()


def _facade(
    builder: MeshBuilder, rng: np.random.Generator, style: _HouseStyle, start: Floats, end: Floats, street: bool
) -> None:
    """Add a wall from `start` to `end` (2,), m, its outside to the right, with a grid of windows; street : with a door."""
    length = float(portable.norm(end - start))
    along = (end - start) / length
    outward = np.array([along[1], -along[0]])

    # A corner is (u, inset, z): m along the wall, behind its face, and up.
    def quad(u0: float, u1: float, z0: float, z1: float, inset: float = 0.0) -> Quad:
        return [(u0, inset, z0), (u1, inset, z0), (u1, inset, z1), (u0, inset, z1)]

    def reveal(u: float, v: float, z0: float, z1: float) -> Quad:
        """The side of a recess: upright when u == v, level when z0 == z1."""
        if u == v:
            return [(u, 0.0, z0), (u, style.recess, z0), (u, style.recess, z1), (u, 0.0, z1)]
        return [(u, 0.0, z0), (v, 0.0, z0), (v, style.recess, z0), (u, style.recess, z0)]

    def place(quads: list[Quad]) -> Floats:
        """(N, 4, 3) corners in the house's frame, m."""
        corners = np.array(quads, np.float64).reshape(-1, 4, 3)
        xy = start + corners[..., :1] * along - corners[..., 1:2] * outward
        return np.concatenate([xy, corners[..., 2:]], axis=-1)

    count = int((length - 1.0) // style.spacing) if street or rng.random() < 0.7 else 0
    centres = length / 2 + (np.arange(count) - (count - 1) / 2) * style.spacing
    walls: list[Quad] = [quad(0, length, FOUNDATION, 0.3)]
    panes: list[Quad] = []
    for storey in range(style.storeys):
        floor = 0.3 + storey * style.storey
        door = int(rng.integers(count)) if storey == 0 and street and count else -1
        sill, head = floor + style.sill, floor + style.head
        walls += [quad(0, length, head, floor + style.storey)]
        left = 0.0
        for k, centre in enumerate(centres.tolist()):
            u0, u1 = centre - style.window / 2, centre + style.window / 2
            low = floor if k == door else sill
            walls += [quad(left, u0, floor, head), reveal(u0, u0, low, head), reveal(u1, u1, low, head)]
            walls += [reveal(u0, u1, low, low), reveal(u0, u1, head, head)]
            if k == door:
                walls.append(quad(u0, u1, floor, head, style.recess))
            else:
                walls.append(quad(u0, u1, floor, sill))
                # A closed shutter now and then: not every window is glass.
                (walls if rng.random() < 0.3 else panes).append(quad(u0, u1, sill, head, style.recess))
            if storey and rng.random() < (0.25 if street else 0.15):
                _balcony(builder, start + centre * along, along, outward, floor, rng.uniform(0.8, 1.4))
            left = u1
        walls.append(quad(left, length, floor, head))
    builder.add_quads(place(walls), Surface.WALL)
    builder.add_quads(place(panes), Surface.GLASS)


def _balcony(builder: MeshBuilder, middle: Floats, along: Floats, outward: Floats, floor: float, reach: float) -> None:
    """Add a slab with a parapet, 2.2 m wide along unit `along`, `reach` m to `outward`, from `middle` (2,); floor : height, m."""
    a, b = middle - 1.1 * along, middle + 1.1 * along
    c, d = b + reach * outward, a + reach * outward
    top = floor + 0.95
    slab = [[[*p, z] for p in (a, b, c, d)] for z in (floor - 0.15, floor)]
    sides = [[[*p, floor - 0.15], [*q, floor - 0.15], [*q, top], [*p, top]] for p, q in ((a, d), (d, c), (c, b))]
    builder.add_quads(slab + sides, Surface.WALL)


def _gabled_roof(builder: MeshBuilder, width: float, depth: float, eaves: float, pitch: float, along: bool) -> None:
    """Add a roof over `width` x `depth` m from `eaves`, m, overhang 0.4 m; along : its ridge runs along the street."""
    w, half = (width / 2, depth / 2) if along else (depth / 2, width / 2)
    # A wide house has a flatter roof.
    rise, over = min(half * pitch, HIGHEST_ROOF), 0.4
    pitch = rise / half

    def place(u: float, v: float, z: float) -> list[float]:
        """Position from u along the ridge and v across it, both from the middle of the house."""
        return [u, depth / 2 + v, z] if along else [v, depth / 2 + u, z]

    slopes = [
        [
            place(-w - over, side * (half + over), eaves - over * pitch),
            place(w + over, side * (half + over), eaves - over * pitch),
            place(w + over, 0, eaves + rise),
            place(-w - over, 0, eaves + rise),
        ]
        for side in (-1, 1)
    ]
    builder.add_quads(slopes, Surface.ROOF)
    gables = [[place(u, -half, eaves), place(u, half, eaves), place(u, 0, eaves + rise)] for u in (-w, w)]
    builder.add(np.array(gables).reshape(-1, 3), np.arange(6).reshape(2, 3), Surface.WALL)
    chimney = np.array(place(0.4 * w, 0.3 * half, eaves))
    builder.add_box(chimney - np.array([0.35, 0.35, 0.5]), chimney + np.array([0.35, 0.35, rise + 0.7]), Surface.WALL)


def _flat_roof(builder: MeshBuilder, width: float, depth: float, eaves: float) -> None:
    """Add a roof slab of `width` x `depth` m at height `eaves`, m, with a parapet, open above it."""
    w, low, high = width / 2, eaves, eaves + 0.5
    builder.add_quads([[[-w, 0, low], [w, 0, low], [w, depth, low], [-w, depth, low]]], Surface.ROOF)
    corners = [(-w, 0.0), (w, 0.0), (w, depth), (-w, depth)]
    parapet = [
        [[*p, low - 0.3], [*q, low - 0.3], [*q, high], [*p, high]]
        for p, q in zip(corners, corners[1:] + corners[:1], strict=True)
    ]
    builder.add_quads(parapet, Surface.WALL)


def _porch(builder: MeshBuilder, rng: np.random.Generator, width: float) -> None:
    """Add nothing, a porch with steps, or a bay as high as the ground floor, before a facade `width` m wide.

    The facade stands along x, its middle at x = 0, its outside towards -y.
    """
    kind, u = rng.random(), rng.uniform(-0.3, 0.3) * width
    if kind < 0.3:
        builder.add_box([u - 1.0, -1.2, 2.5], [u + 1.0, 0.05, 2.65], Surface.ROOF)
        for x in (u - 0.95, u + 0.85):
            builder.add_box([x, -1.2, FOUNDATION], [x + 0.12, -1.08, 2.5], Surface.WALL)
        builder.add_box([u - 0.9, -0.9, FOUNDATION], [u + 0.9, 0.05, 0.3], Surface.PAVEMENT)
    elif kind < 0.5:
        builder.add_box([u - 1.3, -0.8, FOUNDATION], [u + 1.3, 0.05, 3.0], Surface.WALL)
