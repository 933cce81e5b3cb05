"""Where two buildings touch, or should: party walls on the map, and the smallest move that takes an overlap apart.

Del Tufo, section 3.5. Among the moves that lay a corner on a corner or a wall on a wall and leave no overlap the smallest
is taken. A move counts as what it does to the corner that goes farthest, so that turning a house has its price.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.types.building import Building, about, footprint_polygon

Floats = NDArray[np.float64]

TOUCHING = 0.05  # m; walls of neighbours that lie so near one another on the map are one wall
SHARED = 0.5  # m of it at least
SLACK = 0.005  # m each of two buildings may stand in the other: half the tolerance
STEEPEST = np.radians(60.0)  # by which a building is turned at most (Del Tufo)
LARGEST = 5.0  # m; largest displacement of a building
FLUSH_WORTH = 1.0  # m more than a bare touch that walls flush with each other may cost
PARALLEL = np.cos(np.radians(10.0))
SHORTEST = 0.3  # m; walls under this length are ornaments


@dataclass(frozen=True)
class Contact:
    """The `point` (2,) of building `owner` lies on the line of the `wall` (2, 2) of building `other`; m, all as on the map."""

    owner: int
    point: Floats
    other: int
    wall: Floats


class Solid:
    """A building as a thing that others cannot enter: its rings, its walls, and its ground less `SLACK`."""

    def __init__(self, number: int, building: Building) -> None:
        from shapely import MultiPolygon, make_valid

        self.number = number
        self.middle = building.middle
        shape = make_valid(MultiPolygon([footprint_polygon(f) for f in building.footprints]))
        self.shape, self.core = shape, shape.buffer(-SLACK, join_style="mitre")
        rings = [ring for f in building.footprints for ring in f.rings]
        # Wall k runs from corner k to corner after[k].
        self.walls = np.concatenate([np.stack([r, np.roll(r, -1, axis=0)], axis=1) for r in rings])
        first = np.cumsum([0, *map(len, rings)])
        self.after = np.concatenate([a + np.roll(np.arange(len(r)), -1) for a, r in zip(first, rings, strict=False)])
        self.before = np.argsort(self.after)

    def walls_at(self, displacement: Floats) -> Floats:
        """(W, 2, 2) walls of the displaced building, m."""
        R, shift = about(self.middle, displacement)
        return np.asarray(self.walls @ R.T + shift)

    def core_at(self, displacement: Floats) -> Any:
        """The displaced ground less `SLACK`, of shapely."""
        return _transformed(self.core, *about(self.middle, displacement))


def party_contacts(one: Solid, other: Solid) -> list[Contact]:
    """Contacts of the walls that `one` and `other` share on the map; none of buildings that stand in each other."""
    if one.shape.distance(other.shape) > TOUCHING or one.core.intersects(other.core):
        return []
    found = []
    for wall in one.walls:
        for facing in other.walls:
            u, along = _direction(facing)
            away = wall - facing[0]
            if along < SHARED or (wall[1] - wall[0]) @ u > -PARALLEL * np.linalg.norm(wall[1] - wall[0]):
                continue
            if np.abs(away @ [-u[1], u[0]]).max() > TOUCHING:
                continue
            s = np.clip(away @ u, 0.0, along)
            if abs(s[1] - s[0]) >= SHARED:
                found += [Contact(one.number, facing[0] + t * u, other.number, facing) for t in s]
    return found


def separate(one: Solid, at: Floats, other: Solid, other_at: Floats) -> list[Contact]:
    """Contacts that the smallest separating move of `one` makes, both displaced by `at` and `other_at` (3,).

    Empty when no move of less than `LARGEST` m and `STEEPEST` takes the two apart.
    """
    from shapely import prepare

    ours, theirs = one.walls_at(at), other.walls_at(other_at)
    core, obstacle = one.core_at(at), other.core_at(other_at)
    prepare(obstacle)
    moves = [*_alignments(one, ours, other, theirs), *_touches(ours, theirs)]
    for move in sorted((m for m in moves if m.price < LARGEST + FLUSH_WORTH), key=lambda m: m.price):
        if not _transformed(core, move.rotation, move.shift).intersects(obstacle):
            return [_on_map(contact, one, other) for contact in move.contacts]
    return []


@dataclass(frozen=True)
class _Move:
    """A rigid move of the first building, what it costs, m, and (side, corner or wall, wall) of the contacts it makes.

    side : 0 when the corner is the first building's and the wall the second's, else 1
    """

    rotation: Floats
    shift: Floats
    price: float
    contacts: tuple[tuple[int, int, int], ...]


def _alignments(one: Solid, ours: Floats, other: Solid, theirs: Floats) -> Iterator[_Move]:
    """Walls laid on walls, and corners on corners with one of their walls on each other."""
    middle = ours[:, 0].mean(axis=0)
    for a, wall in enumerate(ours):
        u, length = _direction(wall)
        for b, facing in enumerate(theirs):
            v, along = _direction(facing)
            # Walls that face each other run against each other.
            turn = np.arctan2(u[1] * v[0] - u[0] * v[1], -(u @ v))
            if min(length, along) < SHORTEST or abs(turn) > STEEPEST:
                continue
            rotation, _ = about(middle, np.array([0.0, 0.0, turn]))
            turned = middle + (ours[:, 0] - middle) @ rotation.T
            n = np.array([v[1], -v[0]])
            last, end = int(one.after[a]), int(other.after[b])
            flush = ((0, a, b), (0, last, b)) if length <= along else ((1, b, a), (1, end, a))
            yield _move(ours, turned, rotation, (facing[0] - turned[a]) @ n * n, flush)
            # One end of our wall on the far end of theirs, so that the corners meet.
            yield _move(ours, turned, rotation, facing[1] - turned[a], (*flush, (0, a, end)))
            yield _move(ours, turned, rotation, facing[0] - turned[last], (*flush, (0, last, int(other.before[b]))))


def _touches(ours: Floats, theirs: Floats) -> Iterator[_Move]:
    """Corners pushed out as far as walls, without a turn."""
    for side, corners, walls in ((0, ours[:, 0], theirs), (1, theirs[:, 0], ours)):
        for k, wall in enumerate(walls):
            u, length = _direction(wall)
            if length < SHORTEST:
                continue
            n = np.array([u[1], -u[0]])
            depth = (wall[0] - corners) @ n
            deepest = int(np.argmax(depth))
            if depth[deepest] > 0:
                shift = depth[deepest] * n * (1 if side == 0 else -1)
                yield _move(ours, ours[:, 0], np.eye(2), shift, ((side, deepest, k),), FLUSH_WORTH)


def _move(
    ours: Floats, turned: Floats, rotation: Floats, push: Floats, contacts: tuple[tuple[int, int, int], ...],
    extra: float = 0.0,
) -> _Move:  # fmt: skip
    """The move that takes our corners to `turned` + `push`."""
    farthest = float(np.linalg.norm(turned + push - ours[:, 0], axis=1).max())
    return _Move(rotation, turned[0] + push - rotation @ ours[0, 0], farthest + extra, contacts)


def _direction(wall: Floats) -> tuple[Floats, float]:
    """Unit direction (2,) and length, m, of a wall."""
    along = wall[1] - wall[0]
    length = max(float(np.linalg.norm(along)), 1e-9)
    return along / length, length


def _transformed(shape: Any, rotation: Floats, shift: Floats) -> Any:
    from shapely.affinity import affine_transform

    return affine_transform(shape, [*rotation.ravel(), *shift])


def _on_map(contact: tuple[int, int, int], one: Solid, other: Solid) -> Contact:
    side, corner, wall = contact
    owner, holder = (one, other) if side == 0 else (other, one)
    return Contact(owner.number, owner.walls[corner, 0], holder.number, holder.walls[wall])
