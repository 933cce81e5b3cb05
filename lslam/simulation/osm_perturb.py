"""A perturbed map from an exact one: buildings moved, simplified, merged, missing or not yet built, on record as JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError
from lslam.formats.atomic import write_text
from lslam.types.building import Building, Footprint, footprint_polygon, footprints_of
from lslam.untrusted import MISFIT, parse_json

Floats = NDArray[np.float64]

SCHEMA = "lslam-osm-perturbation-1"


@dataclass(frozen=True)
class Change:
    """What happened to one building of the exact map, in this order; the common shift of the map comes last.

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
    """All that was done to an exact map: `shift_m` of the whole, one `Change` per building, buildings not yet built.

    attribution : what outputs made from the map must carry (ODbL), if anything
    """

    shift_m: tuple[float, float]
    changes: tuple[Change, ...]
    not_yet_built: tuple[Building, ...]
    attribution: str | None = None


def perturb(buildings: Sequence[Building], perturbation: Perturbation) -> list[Building]:
    """The perturbed map from the exact one.

    Raises ValueError when the two do not belong together.
    """
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
        c, s = np.cos(change.turn_rad), np.sin(change.turn_rad)
        R, middle = np.array([[c, -s], [s, c]]), building.middle
        if change.turn_rad == 0:
            # Nothing but the shift, to the last bit.
            R, middle = np.eye(2), np.zeros(2)
        found.append(building.moved(R, middle - R @ middle + np.array(change.shift_m) + common))
    return found + [building.moved(np.eye(2), common) for building in perturbation.not_yet_built]


def map_errors(buildings: Sequence[Building], perturbation: Perturbation) -> dict[str, Floats]:
    """By number, what moves each building of the perturbed map to where it really stands: x, y (m), yaw (rad) about its middle.

    buildings : the exact map. Buildings that are not built yet stand nowhere, and missing ones are on no map.
    """
    known, on_map = {b.osm_id: b for b in buildings}, {b.osm_id: b for b in perturb(buildings, perturbation)}
    found = {}
    for change in perturbation.changes:
        if change.id not in on_map:
            continue
        real, drawn = join_outlines(known[change.id], change, known), on_map[change.id]
        real = simplify_outlines(real, change.simplify_m) if change.simplify_m > 0 else real
        moved = drawn.displaced(np.array([0.0, 0.0, -change.turn_rad]))
        found[change.id] = np.array([*(real.middle - moved.middle), -change.turn_rad])
    return found


def join_outlines(building: Building, change: Change, known: dict[str, Building]) -> Building:
    """The building with the outlines of those merged into it, gaps closed; `known` has all buildings by number."""
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
    """The building with fewer corners, none more than `tolerance` m off (Douglas-Peucker)."""
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
    """Read what `write_perturbation` wrote. Raises InputError naming the file."""
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
