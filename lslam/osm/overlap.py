"""Overlap removal: displaced buildings are separated, party walls aligned, and all other displacements kept.

Del Tufo, section 3.5. Contacts are hard constraints between buildings. Each displacement is weighted by its information, from
sightings and the map's prior; an unseen building has that of the prior alone.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.stopping import checking
from lslam.core.types.building import Building, about, footprint_polygon, is_canopy

TOUCHING_M = 0.05  # m; walls of neighbours at most this far apart on the map are a party wall
PARTY_WALL_M = 0.5  # m; least length of a party wall
OVERLAP_M = 0.005  # m; by which each of two buildings may overlap the other: half the tolerance
LARGEST_TURN_RAD = np.radians(60.0)  # largest rotation of a building (Del Tufo)
LARGEST_MOVE_M = 5.0  # m; largest displacement of a building
FLUSH_WORTH = 1.0  # m; cost of a move that aligns no walls, so that aligned walls are preferred
PARALLEL = np.cos(np.radians(10.0))
SHORTEST_WALL_M = 0.3  # m; shorter walls are not aligned
SEPARATION_ROUNDS = 20  # most rounds of separation
STEPS = 10  # of Gauss-Newton
CONTACT_SIGMA_M = 1e-4  # m; one sigma of a contact
NESTED_SHARE = 0.5  # share of the smaller building's area; a larger overlap on the map is a building part or a copy
log = logging.getLogger("lslam")


@dataclass(frozen=True)
class Contact:
    """The `point` (2,) of building `owner` is constrained to the line of the `wall` (2, 2) of building `other`; m, on the map."""

    owner: int
    point: Floats
    other: int
    wall: Floats


class Solid:
    """Geometry of a building: its shape, its walls, and its area less `OVERLAP_M`."""

    def __init__(self, number: int, building: Building) -> None:
        from shapely import MultiPolygon, make_valid

        self.number = number
        self.middle = building.middle
        shape = make_valid(MultiPolygon([footprint_polygon(f) for f in building.footprints]))
        self.shape, self.core = shape, shape.buffer(-OVERLAP_M, join_style="mitre")
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
        """The displaced area less `OVERLAP_M`, of shapely."""
        return _transform(self.core, *about(self.middle, displacement))


def party_contacts(one: Solid, other: Solid) -> list[Contact]:
    """Contacts of the party walls of `one` and `other` on the map; none where the two overlap."""
    if one.shape.distance(other.shape) > TOUCHING_M or one.core.intersects(other.core):
        return []
    found = []
    for wall in one.walls:
        for facing in other.walls:
            u, along = _direction(facing)
            away = wall - facing[0]
            if along < PARTY_WALL_M or (wall[1] - wall[0]) @ u > -PARALLEL * np.linalg.norm(wall[1] - wall[0]):
                continue
            if np.abs(away @ [-u[1], u[0]]).max() > TOUCHING_M:
                continue
            s = np.clip(away @ u, 0.0, along)
            if abs(s[1] - s[0]) >= PARTY_WALL_M:
                found += [Contact(one.number, facing[0] + t * u, other.number, facing) for t in s]
    return found


def separate(one: Solid, at: Floats, other: Solid, other_at: Floats) -> list[Contact]:
    """Contacts after the smallest move of `one` that separates the two, displaced by `at` and `other_at` (3,).

    Empty when no move of less than `LARGEST_MOVE_M` m and `LARGEST_TURN_RAD` separates the two.
    """
    from shapely import prepare

    ours, theirs = one.walls_at(at), other.walls_at(other_at)
    core, obstacle = one.core_at(at), other.core_at(other_at)
    prepare(obstacle)
    moves = [*_alignments(one, ours, other, theirs), *_touches(ours, theirs)]
    for move in sorted((m for m in moves if m.price < LARGEST_MOVE_M + FLUSH_WORTH), key=lambda m: m.price):
        if not _transform(core, move.rotation, move.shift).intersects(obstacle):
            return [_on_map(contact, one, other) for contact in move.contacts]
    return []


@dataclass(frozen=True)
class _Move:
    """A rigid move of the first building, its cost, m, and the contacts after it, each (side, corner, wall).

    side : 0 when the corner is the first building's and the wall the second's, else 1
    """

    rotation: Floats
    shift: Floats
    price: float
    contacts: tuple[tuple[int, int, int], ...]


def _alignments(one: Solid, ours: Floats, other: Solid, theirs: Floats) -> Iterator[_Move]:
    """Moves of `one`, its walls at `ours` (V, 2, 2), m, that align a wall, or corners, with those of `other` at `theirs`."""
    middle = ours[:, 0].mean(axis=0)
    for a, wall in enumerate(ours):
        u, length = _direction(wall)
        for b, facing in enumerate(theirs):
            v, along = _direction(facing)
            # Walls that face each other have opposite directions.
            turn = np.arctan2(u[1] * v[0] - u[0] * v[1], -(u @ v))
            if min(length, along) < SHORTEST_WALL_M or abs(turn) > LARGEST_TURN_RAD:
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
    """Moves by translation alone, one per wall: the deepest corner of one building is put on a wall of the other.

    ours, theirs : walls (V, 2, 2), m
    """
    for side, corners, walls in ((0, ours[:, 0], theirs), (1, theirs[:, 0], ours)):
        for k, wall in enumerate(walls):
            u, length = _direction(wall)
            if length < SHORTEST_WALL_M:
                continue
            n = np.array([u[1], -u[0]])
            depth = (wall[0] - corners) @ n
            deepest = int(np.argmax(depth))
            if depth[deepest] > 0:
                shift = depth[deepest] * n * (1 if side == 0 else -1)
                yield _move(ours, ours[:, 0], np.eye(2), shift, ((side, deepest, k),), FLUSH_WORTH)


def _move(
    ours: Floats,
    corners: Floats,
    rotation: Floats,
    push: Floats,
    contacts: tuple[tuple[int, int, int], ...],
    extra: float = 0.0,
) -> _Move:
    """The move that rotates our walls `ours` (V, 2, 2) by `rotation` (2, 2) and shifts their turned `corners` (V, 2) by `push`.

    Its length is that of the farthest corner's way, m, plus `extra`.
    """
    farthest = float(np.linalg.norm(corners + push - ours[:, 0], axis=1).max())
    return _Move(rotation, corners[0] + push - rotation @ ours[0, 0], farthest + extra, contacts)


def _direction(wall: Floats) -> tuple[Floats, float]:
    """Unit direction (2,) and length, m, of a wall."""
    along = wall[1] - wall[0]
    length = max(float(np.linalg.norm(along)), 1e-9)
    return along / length, length


def _transform(shape: Any, rotation: Floats, shift: Floats) -> Any:
    """A shapely geometry rotated by (2, 2) and shifted by (2,), m."""
    from shapely.affinity import affine_transform

    return affine_transform(shape, [*rotation.ravel(), *shift])


def _on_map(contact: tuple[int, int, int], one: Solid, other: Solid) -> Contact:
    """The contact of a move's (side, corner, wall), with the corner and the wall as on the map."""
    side, corner, wall = contact
    owner, holder = (one, other) if side == 0 else (other, one)
    return Contact(owner.number, owner.walls[corner, 0], holder.number, holder.walls[wall])


@dataclass(frozen=True)
class Separation:
    """Displaced buildings without overlaps.

    displacements : (B, 3) x, y (m), yaw (rad) about each building's middle
    contacts : all constraints; left : pairs that overlap still, because no small move separates them
    """

    displacements: Floats
    contacts: tuple[Contact, ...]
    left: tuple[tuple[int, int], ...]


def remove_overlaps(buildings: Sequence[Building], displacements: Floats, information: Floats) -> Separation:
    """The least displacements that separate overlapping buildings and keep party walls aligned.

    displacements : (B, 3) x, y (m), yaw (rad) about each building's `middle`
    information : (B, 3, 3) of these, 1/m2 and 1/rad2, positive definite

    Buildings without contacts keep their displacement exactly. Canopies, buildings that begin above the ground and those
    that overlap on the map by more than `NESTED_SHARE` are not separated.
    """
    targets = np.asarray(displacements, np.float64).reshape(-1, 3)
    if not len(targets):
        return Separation(targets, (), ())
    solids = [Solid(k, building) for k, building in enumerate(buildings)]
    solid_ground = [s for s, b in zip(solids, buildings, strict=True) if not is_canopy(b) and b.base <= 0]
    on_map = np.zeros_like(targets)
    nested = {(i, j) for i, j in _overlapping(solid_ground, on_map) if _is_building_part(solids[i], solids[j])}
    contacts = {(i, j): party_contacts(solids[i], solids[j]) for i, j in _neighbours(solid_ground)}
    inseparable: set[tuple[int, int]] = set()
    moved = _constrain(solids, targets, information, contacts)
    for _ in checking(range(SEPARATION_ROUNDS)):
        pairs = [pair for pair in _overlapping(solid_ground, moved) if pair not in nested and pair not in inseparable]
        if not pairs:
            break
        for i, j in pairs:
            contacts[i, j] = separate(solids[i], moved[i], solids[j], moved[j])
            if not contacts[i, j]:
                inseparable.add((i, j))
        moved = _constrain(solids, targets, information, contacts)
    left = tuple(pair for pair in _overlapping(solid_ground, moved) if pair not in nested)
    if left:
        log.warning("%d pairs of buildings overlap, and no small move separates them", len(left))
    return Separation(moved, tuple(c for some in contacts.values() for c in some), left)


def _overlapping(solids: Sequence[Solid], displacements: Floats) -> list[tuple[int, int]]:
    """Pairs of buildings that overlap by more than the tolerance."""
    from shapely import STRtree

    cores = [s.core_at(displacements[s.number]) for s in solids]
    return _pairs(solids, STRtree(cores).query(cores, predicate="intersects"))


def _neighbours(solids: Sequence[Solid]) -> list[tuple[int, int]]:
    """Pairs of buildings that touch on the map."""
    from shapely import STRtree

    shapes = [s.shape for s in solids]
    return _pairs(solids, STRtree(shapes).query(shapes, predicate="dwithin", distance=TOUCHING_M))


def _pairs(solids: Sequence[Solid], rows: Longs) -> list[tuple[int, int]]:
    """Numbers of the two buildings of each pair, every pair once and sorted."""
    return sorted((solids[a].number, solids[b].number) for a, b in rows.T.tolist() if a < b)


def _is_building_part(one: Solid, other: Solid) -> bool:
    """Whether two buildings overlap on the map by so much that one is a part of the other."""
    shared = one.shape.intersection(other.shape).area
    return bool(shared > NESTED_SHARE * min(one.shape.area, other.shape.area))


def _constrain(
    solids: Sequence[Solid], targets: Floats, information: Floats, contacts: dict[tuple[int, int], list[Contact]]
) -> Floats:
    """The displacements (B, 3) nearest to `targets` that satisfy all contacts, for each group of touching buildings."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    pairs = np.array([pair for pair, some in contacts.items() if some], np.intp).reshape(-1, 2)
    moved = targets.copy()
    count = len(solids)
    links = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (count, count))
    _, group = connected_components(links, directed=False)
    for name in np.unique(group[pairs[:, 0]]):
        members = np.flatnonzero(group == name)
        own = [c for (i, _), some in contacts.items() if group[i] == name for c in some]
        middles = np.array([solids[m].middle for m in members.tolist()])
        moved[members] = _group(members.tolist(), middles, targets[members], information[members], own)
    return moved


def _group(
    members: list[int], middles: Floats, targets: Floats, information: Floats, contacts: list[Contact]
) -> Floats:
    """Displacements (M, 3) of buildings in contact, nearest to `targets` (M, 3) by `information`; dense Gauss-Newton.

    members : their numbers; middles : (M, 2) m
    """
    place = {m: k for k, m in enumerate(members)}
    moved = targets.copy()
    size = 3 * len(members)
    known = np.zeros((size, size))
    for k, own in enumerate(information):
        known[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = own
    for _ in range(STEPS):
        rows, values = np.zeros((len(contacts), size)), np.zeros(len(contacts))
        for row, contact in enumerate(contacts):
            i, j = place[contact.owner], place[contact.other]
            found = _residual(contact, middles[i], moved[i], middles[j], moved[j])
            values[row], rows[row, 3 * i : 3 * i + 3], rows[row, 3 * j : 3 * j + 3] = found
        normal = known + rows.T @ rows / CONTACT_SIGMA_M**2
        gradient = known @ (moved - targets).ravel() + rows.T @ values / CONTACT_SIGMA_M**2
        step = np.linalg.solve(normal, gradient).reshape(-1, 3)
        moved -= step
        if np.abs(step).max() < 1e-7:
            break
    return moved


def _residual(
    contact: Contact, owner_middle: Floats, owner_at: Floats, other_middle: Floats, other_at: Floats
) -> tuple[float, Floats, Floats]:
    """Signed distance, m, of a contact's point from its wall, positive outside, and Jacobians (3,) by both displacements.

    owner_at, other_at : displacements (3,) of the two buildings about their middles (2,), m
    """
    R, shift = about(owner_middle, owner_at)
    point = R @ contact.point + shift
    R, shift = about(other_middle, other_at)
    wall = contact.wall @ R.T + shift
    along = (wall[1] - wall[0]) / np.linalg.norm(wall[1] - wall[0])
    n = np.array([along[1], -along[0]])
    by_owner, by_other = (
        np.append(n, n @ [-arm[1], arm[0]])
        for arm in (point - owner_middle - owner_at[:2], point - other_middle - other_at[:2])
    )
    return float((point - wall[0]) @ n), by_owner, -by_other
