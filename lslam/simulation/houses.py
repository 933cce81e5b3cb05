"""Houses: facades with recessed windows, doors and balconies, gabled or flat roofs, porches and chimneys.

Local frame: x along the street, the front at y = 0 facing -y, the lot behind at y > 0, z = 0 the ground at the door.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lslam.core.geometry import portable
from lslam.core.types.arrays import Floats
from lslam.simulation.scene_mesh import MeshBuilder, SceneMesh, Surface

Quad = list[tuple[float, float, float]]

FOUNDATION = -1.5  # m, walls reach below uneven ground
HIGHEST_ROOF = 5.0  # m from the eaves to the ridge


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
    """Add a wall from `start` to `end` (2,), its outside to the right, with a grid of windows."""
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

    def placed(quads: list[Quad]) -> Floats:
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
    builder.add_quads(placed(walls), Surface.WALL)
    builder.add_quads(placed(panes), Surface.GLASS)


def _balcony(builder: MeshBuilder, middle: Floats, along: Floats, outward: Floats, floor: float, reach: float) -> None:
    """Add a slab with a parapet on three sides."""
    a, b = middle - 1.1 * along, middle + 1.1 * along
    c, d = b + reach * outward, a + reach * outward
    top = floor + 0.95
    slab = [[[*p, z] for p in (a, b, c, d)] for z in (floor - 0.15, floor)]
    sides = [[[*p, floor - 0.15], [*q, floor - 0.15], [*q, top], [*p, top]] for p, q in ((a, d), (d, c), (c, b))]
    builder.add_quads(slab + sides, Surface.WALL)


def _gabled_roof(builder: MeshBuilder, width: float, depth: float, eaves: float, pitch: float, along: bool) -> None:
    """Add two slopes that overhang by 0.4 m and two gables; the ridge runs along the street or across it."""
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
    """Add a roof slab with a parapet, open above it."""
    w, low, high = width / 2, eaves, eaves + 0.5
    builder.add_quads([[[-w, 0, low], [w, 0, low], [w, depth, low], [-w, depth, low]]], Surface.ROOF)
    corners = [(-w, 0.0), (w, 0.0), (w, depth), (-w, depth)]
    parapet = [
        [[*p, low - 0.3], [*q, low - 0.3], [*q, high], [*p, high]]
        for p, q in zip(corners, corners[1:] + corners[:1], strict=True)
    ]
    builder.add_quads(parapet, Surface.WALL)


def _porch(builder: MeshBuilder, rng: np.random.Generator, width: float) -> None:
    """Add nothing, a porch with steps, or a bay as high as the ground floor, in front of the facade."""
    kind, u = rng.random(), rng.uniform(-0.3, 0.3) * width
    if kind < 0.3:
        builder.add_box([u - 1.0, -1.2, 2.5], [u + 1.0, 0.05, 2.65], Surface.ROOF)
        for x in (u - 0.95, u + 0.85):
            builder.add_box([x, -1.2, FOUNDATION], [x + 0.12, -1.08, 2.5], Surface.WALL)
        builder.add_box([u - 0.9, -0.9, FOUNDATION], [u + 0.9, 0.05, 0.3], Surface.PAVEMENT)
    elif kind < 0.5:
        builder.add_box([u - 1.3, -0.8, FOUNDATION], [u + 1.3, 0.05, 3.0], Surface.WALL)
