"""Overlap removal: displaced buildings taken apart, party walls flush, and everything else as it was measured.

Del Tufo, section 3.5. Contacts are hard constraints between buildings; the information of each building, from scans or
only from the map's prior, weights its displacement. An unseen building is held near its place by that prior.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.osm.contacts import TOUCHING, Contact, Solid, party_contacts, separate
from lslam.stopping import checking
from lslam.types.building import Building, about, is_canopy

Floats = NDArray[np.float64]

ROUNDS = 20  # after which overlaps are left as they are
STEPS = 10  # of Gauss-Newton
HARD = 1e-4  # m; one sigma of a contact
NESTED = 0.5  # share of the smaller building's ground; if more overlaps on the map it is meant so: a part, a copy

log = logging.getLogger("lslam")


@dataclass(frozen=True)
class Untangled:
    """Displaced buildings that do not stand in each other.

    displacements : (B, 3) x, y (m), yaw (rad) about each building's middle
    contacts : those that hold; left : pairs that still overlap, because no small move takes them apart
    """

    displacements: Floats
    contacts: tuple[Contact, ...]
    left: tuple[tuple[int, int], ...]


def remove_overlaps(
    buildings: Sequence[Building], displacements: NDArray[np.float64], information: NDArray[np.float64]
) -> Untangled:
    """Move displaced buildings as little as it takes to part those that overlap, and to keep party walls flush.

    Parameters
    ----------
    displacements : (B, 3) x, y (m), yaw (rad) about each building's `middle`
    information : (B, 3, 3) of these, 1/m2 and 1/rad2, positive definite: what is known of each, the weak prior included

    Buildings in no contact keep their displacement to the last bit. Canopies, buildings that begin above the ground and
    those that the map itself puts into each other by more than `NESTED` are let alone.
    """
    wanted = np.asarray(displacements, np.float64).reshape(-1, 3)
    if not len(wanted):
        return Untangled(wanted, (), ())
    solids = [Solid(k, building) for k, building in enumerate(buildings)]
    solid_ground = [s for s, b in zip(solids, buildings, strict=True) if not is_canopy(b) and b.base <= 0]
    on_map = np.zeros_like(wanted)
    meant = {(i, j) for i, j in _overlapping(solid_ground, on_map) if _is_nested(solids[i], solids[j])}
    contacts = {(i, j): party_contacts(solids[i], solids[j]) for i, j in _neighbours(solid_ground)}
    hopeless: set[tuple[int, int]] = set()
    moved = _settled(solids, wanted, information, contacts)
    for _ in checking(range(ROUNDS)):
        pairs = [pair for pair in _overlapping(solid_ground, moved) if pair not in meant and pair not in hopeless]
        if not pairs:
            break
        for i, j in pairs:
            contacts[i, j] = separate(solids[i], moved[i], solids[j], moved[j])
            if not contacts[i, j]:
                hopeless.add((i, j))
        moved = _settled(solids, wanted, information, contacts)
    left = tuple(pair for pair in _overlapping(solid_ground, moved) if pair not in meant)
    if left:
        log.warning("%d pairs of buildings overlap and no small move takes them apart", len(left))
    return Untangled(moved, tuple(c for held in contacts.values() for c in held), left)


def _overlapping(solids: Sequence[Solid], displacements: Floats) -> list[tuple[int, int]]:
    """Pairs of buildings that stand in each other by more than the tolerance."""
    from shapely import STRtree

    cores = [s.core_at(displacements[s.number]) for s in solids]
    return _pairs(solids, STRtree(cores).query(cores, predicate="intersects"))


def _neighbours(solids: Sequence[Solid]) -> list[tuple[int, int]]:
    """Pairs that touch on the map."""
    from shapely import STRtree

    shapes = [s.shape for s in solids]
    return _pairs(solids, STRtree(shapes).query(shapes, predicate="dwithin", distance=TOUCHING))


def _pairs(solids: Sequence[Solid], found: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Numbers of the buildings in each pair of rows, once, in order."""
    return sorted((solids[a].number, solids[b].number) for a, b in found.T.tolist() if a < b)


def _is_nested(one: Solid, other: Solid) -> bool:
    shared = one.shape.intersection(other.shape).area
    return bool(shared > NESTED * min(one.shape.area, other.shape.area))


def _settled(
    solids: Sequence[Solid], wanted: Floats, information: Floats, contacts: dict[tuple[int, int], list[Contact]]
) -> Floats:
    """The displacements (B, 3) nearest to `wanted` at which all contacts hold, group by group of touching buildings."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    pairs = np.array([pair for pair, held in contacts.items() if held], np.intp).reshape(-1, 2)
    moved = wanted.copy()
    count = len(solids)
    links = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (count, count))
    _, group = connected_components(links, directed=False)
    for name in np.unique(group[pairs[:, 0]]):
        members = np.flatnonzero(group == name)
        held = [c for (i, _), some in contacts.items() if group[i] == name for c in some]
        middles = np.array([solids[m].middle for m in members.tolist()])
        moved[members] = _group(members.tolist(), middles, wanted[members], information[members], held)
    return moved


def _group(members: list[int], middles: Floats, wanted: Floats, information: Floats, held: list[Contact]) -> Floats:
    """Gauss-Newton on one group; dense, since a block of houses has few."""
    place = {m: k for k, m in enumerate(members)}
    moved = wanted.copy()
    size = 3 * len(members)
    known = np.zeros((size, size))
    for k, own in enumerate(information):
        known[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = own
    for _ in range(STEPS):
        rows, values = np.zeros((len(held), size)), np.zeros(len(held))
        for row, contact in enumerate(held):
            i, j = place[contact.owner], place[contact.other]
            found = _residual(contact, middles[i], moved[i], middles[j], moved[j])
            values[row], rows[row, 3 * i : 3 * i + 3], rows[row, 3 * j : 3 * j + 3] = found
        normal = known + rows.T @ rows / HARD**2
        gradient = known @ (moved - wanted).ravel() + rows.T @ values / HARD**2
        step = np.linalg.solve(normal, gradient).reshape(-1, 3)
        moved -= step
        if np.abs(step).max() < 1e-7:
            break
    return moved


def _residual(
    contact: Contact, owner_middle: Floats, owner_at: Floats, other_middle: Floats, other_at: Floats
) -> tuple[float, Floats, Floats]:
    """Distance of the displaced point outside the displaced wall, m, and its derivatives by both displacements (3,)."""
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
