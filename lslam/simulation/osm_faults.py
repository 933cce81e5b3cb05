"""What is wrong with a map, drawn by chance: which buildings are off, missing, merged, simplified or not yet built."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lslam.simulation.osm_perturb import Change, Perturbation, join_outlines, simplify_outlines
from lslam.types.building import Building, Footprint, footprint_polygon


@dataclass(frozen=True)
class MapFaults:
    """How wrong the map is. Shares are of all buildings, at least one of each where there are eight or more.

    offset : m, shift of the whole map; shifted, turned, simplified, merged, missing : shares of buildings so changed
    new : not yet built buildings, as a share of the others; shift, turn, tolerance : greatest sizes, m, rad, m
    swing : m, no corner moves farther than this by turning; gap : m, only neighbours this near are merged

    OpenStreetMap is often off by 1 to 3 m as a whole.
    """

    offset: float = 1.5
    shifted: float = 0.25
    shift: float = 1.5
    turned: float = 0.12
    turn: float = float(np.radians(4.0))
    swing: float = 2.0
    simplified: float = 0.15
    tolerance: float = 2.0
    merged: float = 0.06
    gap: float = 1.5
    missing: float = 0.08
    new: float = 0.05


def draw_perturbation(
    buildings: Sequence[Building], faults: MapFaults, rng: np.random.Generator, keep_clear: Any = None
) -> Perturbation:
    """Draw what is wrong with a map of `buildings`. The same generator state gives the same faults.

    keep_clear : shapely geometry, m, where nobody would build (the streets)
    """
    heading = rng.uniform(0, 2 * np.pi)
    common = (float(faults.offset * np.cos(heading)), float(faults.offset * np.sin(heading)))
    changes = [Change(b.osm_id) for b in buildings]
    missing = _some(rng, len(buildings), faults.missing)
    for k in missing:
        changes[k] = replace(changes[k], missing=True)
    present = [k for k in range(len(buildings)) if k not in missing]
    gone = _draw_merges(buildings, present, faults, rng, changes)
    present = [k for k in present if k not in gone]
    outlines = {k: join_outlines(buildings[k], changes[k], {b.osm_id: b for b in buildings}) for k in present}
    # Only an outline with corners to lose can be simplified.
    tolerances = {k: float(rng.uniform(0.4, 1.0) * faults.tolerance) for k in present}
    loses = [k for k in present if _corners(simplify_outlines(outlines[k], tolerances[k])) < _corners(outlines[k])]
    for k in _pick(rng, loses, round(faults.simplified * len(buildings))):
        changes[k] = replace(changes[k], simplify_m=tolerances[k])
    for k in _pick(rng, present, len(_some(rng, len(buildings), faults.turned))):
        # Whoever traced a long building saw when it was turned by much.
        most = min(faults.turn, faults.swing / _radius(buildings[k]))
        turn = float(rng.uniform(0.25, 1.0) * most * rng.choice([-1, 1]))
        changes[k] = replace(changes[k], turn_rad=turn)
    for k in _pick(rng, present, len(_some(rng, len(buildings), faults.shifted))):
        size, way = rng.uniform(0.3, 1.0) * faults.shift, rng.uniform(0, 2 * np.pi)
        changes[k] = replace(changes[k], shift_m=(float(size * np.cos(way)), float(size * np.sin(way))))
    count = len(_some(rng, len(buildings), faults.new))
    return Perturbation(common, tuple(changes), _draw_new(buildings, count, rng, keep_clear))


def _some(rng: np.random.Generator, count: int, share: float) -> list[int]:
    """That share of 0..count-1, in order; at least one of eight or more."""
    wanted = max(round(share * count), 1 if count >= 8 and share > 0 else 0)
    return _pick(rng, list(range(count)), wanted)


def _pick(rng: np.random.Generator, candidates: list[int], wanted: int) -> list[int]:
    chosen = rng.permutation(len(candidates))[: max(wanted, 0)]
    return [candidates[k] for k in np.sort(chosen)]


def _draw_merges(
    buildings: Sequence[Building],
    present: list[int],
    faults: MapFaults,
    rng: np.random.Generator,
    changes: list[Change],
) -> set[int]:
    """Pairs of near neighbours whose outlines become one; marks `changes`, returns those swallowed."""
    known = {b.osm_id: b for b in buildings}
    gone: set[int] = set()
    used: set[int] = set()
    wanted = len(_some(rng, len(buildings), faults.merged))
    plain = [k for k in present if len(buildings[k].footprints) == 1 and not buildings[k].footprints[0].holes]
    shapes = {k: footprint_polygon(buildings[k].footprints[0]) for k in plain}
    for k in _pick(rng, plain, len(plain)) if wanted else []:
        partners = [j for j in plain if j != k and j not in used and shapes[k].distance(shapes[j]) <= faults.gap]
        if k in used or not partners or len(gone) == wanted:
            continue
        j = partners[int(rng.integers(len(partners)))]
        change = replace(changes[k], merged_with=(buildings[j].osm_id,), gap_m=faults.gap)
        if len(join_outlines(buildings[k], change, known).footprints) == 1:
            changes[k], changes[j] = change, replace(changes[j], merged_into=buildings[k].osm_id)
            gone.add(j)
            used |= {j, k}
    return gone


def _radius(building: Building) -> float:
    """From the middle to the farthest corner, m."""
    corners = np.concatenate([footprint.outer for footprint in building.footprints])
    return float(np.linalg.norm(corners - building.middle, axis=1).max())


def _corners(building: Building) -> int:
    return sum(len(ring) for footprint in building.footprints for ring in footprint.rings)


def _draw_new(
    buildings: Sequence[Building], count: int, rng: np.random.Generator, keep_clear: Any
) -> tuple[Building, ...]:
    """Planned houses on free ground near others; fewer where there is no room."""
    from shapely import union_all

    taken = [footprint_polygon(f).buffer(1.0) for b in buildings for f in b.footprints]
    taken = union_all(taken if keep_clear is None else [*taken, keep_clear])
    number = min([0, *(int(b.osm_id.split("/")[1]) for b in buildings)])
    found: list[Building] = []
    for _ in range(40 * count):
        if len(found) == count:
            break
        near = buildings[int(rng.integers(len(buildings)))].middle
        half, turn = rng.uniform(3.5, 8.0, 2), rng.uniform(0, 2 * np.pi)
        centre = near + rng.uniform(8, 30) * np.array([np.cos(turn), np.sin(turn)])
        R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        outline = centre + (half * [[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ R.T
        shape = footprint_polygon(Footprint(outline))
        if not taken.intersects(shape):
            taken = taken.union(shape.buffer(1.0))
            height = 3.0 * float(rng.integers(1, 4))
            name = f"way/{number - 1 - len(found)}"
            found.append(Building(name, (Footprint(outline),), height, tags={"building": "house"}))
    return tuple(found)
