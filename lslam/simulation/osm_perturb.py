"""Perturbation of an exact map: buildings shifted, simplified, merged, missing or only planned, recorded as JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lslam.core.errors import InputError
from lslam.core.geometry import portable
from lslam.core.types.building import Building, Footprint, footprint_polygon, footprints_of
from lslam.core.untrusted import MISFIT, parse_json
from lslam.io.formats.atomic import write_text

SCHEMA = "lslam-osm-perturbation-1"


@dataclass(frozen=True)
class Change:
    """Changes of one building of the exact map, in the order of application; the common shift of the map comes last.

    missing : it is left out; merged_into : it became part of that building; merged_with, gap_m : its outline was joined
    with those, across gaps up to gap_m; simplify_m : tolerance of Douglas-Peucker; turn_rad : counter-clockwise about the
    middle of its bounding box; shift_m : east, north
    """

    id: str
    missing: bool = False
    merged_into: str | None = None
    merged_with: tuple[str, ...] = ()
    gap_m: float = 0.0
    simplify_m: float = 0.0
    turn_rad: float = 0.0
    shift_m: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Perturbation:
    """All changes of an exact map: `shift_m` of the whole, one `Change` per building, and planned buildings.

    attribution : what outputs made from the map must carry (ODbL), if anything
    """

    shift_m: tuple[float, float]
    changes: tuple[Change, ...]
    not_yet_built: tuple[Building, ...]
    attribution: str | None = None


def perturb(buildings: Sequence[Building], perturbation: Perturbation) -> list[Building]:
    """Apply a perturbation to the exact map. Raises ValueError when map and perturbation do not belong together."""
    known = {b.osm_id: b for b in buildings}
    if set(known) != {c.id for c in perturbation.changes}:
        raise ValueError("the perturbation was drawn for other buildings than these")
    common = np.array(perturbation.shift_m)
    found = []
    for change in perturbation.changes:
        if change.missing or change.merged_into is not None:
            continue
        building = join_outlines(known[change.id], change, known)
        if change.simplify_m > 0:
            building = simplify_outlines(building, change.simplify_m)
        c, s = portable.cos(change.turn_rad), portable.sin(change.turn_rad)
        R, middle = np.array([[c, -s], [s, c]]), building.middle
        if change.turn_rad == 0:
            # Nothing but the shift, to the last bit.
            R, middle = np.eye(2), np.zeros(2)
        found.append(building.transform(R, middle - portable.rotate(R, middle) + np.array(change.shift_m) + common))
    return found + [building.transform(np.eye(2), common) for building in perturbation.not_yet_built]


def join_outlines(building: Building, change: Change, known: dict[str, Building]) -> Building:
    """Building with the outlines of those merged into it, gaps closed; `known` holds all buildings by number."""
    from shapely import union_all

    if not change.merged_with:
        return building
    parts = [building, *(known[other] for other in change.merged_with)]
    grown = [
        footprint_polygon(f).buffer(change.gap_m / 2 + 0.01, join_style="mitre", mitre_limit=2)
        for part in parts
        for f in part.footprints
    ]
    closed = union_all(grown).buffer(-change.gap_m / 2 - 0.01, join_style="mitre", mitre_limit=2).simplify(0.02)
    return replace(building, footprints=footprints_of(closed))


def simplify_outlines(building: Building, tolerance: float) -> Building:
    """Building with fewer corners, the outline changed by at most `tolerance` m (Douglas-Peucker)."""
    shapes = (footprint_polygon(f).simplify(tolerance) for f in building.footprints)
    return replace(building, footprints=tuple(f for shape in shapes for f in footprints_of(shape)))


def write_perturbation(path: Path, perturbation: Perturbation) -> None:
    """Write `perturbation` as JSON, atomically; it reads back equal."""
    new = [
        {"id": b.osm_id, "outline_m": b.footprints[0].outer.tolist(), "height_m": b.height, "tags": dict(b.tags)}
        for b in perturbation.not_yet_built
    ]
    tree = {
        "schema": SCHEMA,
        "attribution": perturbation.attribution,
        "frame": "m, x east and y north of the extract's origin, before the common shift",
        "shift_m": perturbation.shift_m,
        "buildings": [asdict(change) for change in perturbation.changes],
        "not_yet_built": new,
    }
    write_text(path, json.dumps(tree, indent=1, allow_nan=False) + "\n")


def read_perturbation(path: Path) -> Perturbation:
    """Read a file of `write_perturbation`. Raises InputError naming the file."""
    try:
        tree = parse_json(path.read_bytes())
        if tree["schema"] != SCHEMA:
            raise ValueError(f"schema {tree['schema']!r}, expected {SCHEMA!r}")
        changes = tuple(
            Change(**{**c, "merged_with": tuple(c["merged_with"]), "shift_m": _pair(c["shift_m"])})
            for c in tree["buildings"]
        )
        new = tuple(
            Building(b["id"], (Footprint(np.array(b["outline_m"], np.float64)),), b["height_m"], tags=b["tags"])
            for b in tree["not_yet_built"]
        )
        return Perturbation(_pair(tree["shift_m"]), changes, new, tree["attribution"])
    except (OSError, *MISFIT) as error:
        raise InputError(f"{path} is no record of a perturbed map: {error}") from None


def _pair(values: Any) -> tuple[float, float]:
    x, y = values
    return float(x), float(y)


@dataclass(frozen=True)
class MapFaults:
    """Size of the errors of a map. Shares are of all buildings, at least one of each kind where there are eight or more.

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
    """Draw random errors for a map of `buildings`. The same generator state gives the same errors.

    keep_clear : shapely geometry, m, without planned buildings (the streets)
    """
    heading = rng.uniform(0, 2 * np.pi)
    common = (float(faults.offset * portable.cos(heading)), float(faults.offset * portable.sin(heading)))
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
        changes[k] = replace(changes[k], shift_m=(float(size * portable.cos(way)), float(size * portable.sin(way))))
    count = len(_some(rng, len(buildings), faults.new))
    return Perturbation(common, tuple(changes), _draw_new(buildings, count, rng, keep_clear))


def _some(rng: np.random.Generator, count: int, share: float) -> list[int]:
    """Random indices of 0..count-1, a `share` of them, in order; at least one if count is eight or more."""
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
    """Merge pairs of close neighbours: marks `changes`, returns the buildings that were merged into others."""
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
    """Distance from the middle to the farthest corner, m."""
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
        centre = near + rng.uniform(8, 30) * np.array([portable.cos(turn), portable.sin(turn)])
        R = np.array([[portable.cos(turn), -portable.sin(turn)], [portable.sin(turn), portable.cos(turn)]])
        outline = centre + portable.product(half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]), R.T)
        shape = footprint_polygon(Footprint(outline))
        if not taken.intersects(shape):
            taken = taken.union(shape.buffer(1.0))
            height = 3.0 * float(rng.integers(1, 4))
            name = f"way/{number - 1 - len(found)}"
            found.append(Building(name, (Footprint(outline),), height, tags={"building": "house"}))
    return tuple(found)
