"""OpenStreetMap extracts of a scene: an exact one, and one perturbed like real maps, with a record of the changes as JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.errors import InputError, OutputError, cause
from lslam.core.geometry import portable
from lslam.core.geometry.geodesy import from_local
from lslam.core.types.building import Building, Footprint, footprint_polygon, footprints_of
from lslam.core.untrusted import MISFIT, parse_json
from lslam.io.formats.atomic import write_text
from lslam.io.formats.osm_buildings import buildings_of, height_of
from lslam.io.formats.osm_data import DECIMALS, AreaMaker, OsmData, Place
from lslam.io.formats.osm_files import write_osm
from lslam.simulation.city import City
from lslam.simulation.osm_city import OsmCity

SCHEMA = "lslam-osm-perturbation-1"
EXACT, PERTURBED = "map.osm", "map_perturbed.osm"
RECORD = "truth/map_perturbation.json"  # below truth/: no method may read it
ROADSIDE = 7.0  # m from the middle of a street that stay free of houses not yet built


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
    future_buildings: tuple[Building, ...]
    attribution: str | None = None


def perturb(buildings: Sequence[Building], perturbation: Perturbation) -> list[Building]:
    """Apply a perturbation to the exact map. Raises ValueError when map and perturbation do not belong together."""
    by_id = {b.osm_id: b for b in buildings}
    if set(by_id) != {c.id for c in perturbation.changes}:
        raise ValueError("the perturbation was drawn for other buildings than these")
    common = np.array(perturbation.shift_m)
    changed = []
    for change in perturbation.changes:
        if change.missing or change.merged_into is not None:
            continue
        building = join_outlines(by_id[change.id], change, by_id)
        if change.simplify_m > 0:
            building = simplify_outlines(building, change.simplify_m)
        c, s = portable.cos(change.turn_rad), portable.sin(change.turn_rad)
        R, middle = np.array([[c, -s], [s, c]]), building.middle
        if change.turn_rad == 0:
            # Nothing but the shift, to the last bit.
            R, middle = np.eye(2), np.zeros(2)
        changed.append(building.transform(R, middle - portable.rotate(R, middle) + np.array(change.shift_m) + common))
    return changed + [building.transform(np.eye(2), common) for building in perturbation.future_buildings]


def join_outlines(building: Building, change: Change, by_id: dict[str, Building]) -> Building:
    """Building with the outlines of those merged into it, gaps closed; `by_id` holds all buildings by number."""
    from shapely import union_all

    if not change.merged_with:
        return building
    parts = [building, *(by_id[other] for other in change.merged_with)]
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
        for b in perturbation.future_buildings
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
    """Two values as floats."""
    x, y = values
    return float(x), float(y)


@dataclass(frozen=True)
class MapFaults:
    """Size of the errors of a map. Shares are of all buildings, at least one of each kind where there are eight or more.

    offset : m, shift of the whole map; shift_share, turn_share, simplify_share, merge_share, missing : of buildings so changed
    new : not yet built buildings, as a share of the others; shift, turn, tolerance : greatest sizes, m, rad, m
    swing : m, no corner moves farther than this by turning; gap : m, only neighbours this near are merged

    OpenStreetMap is often off by 1 to 3 m as a whole.
    """

    offset: float = 1.5
    shift_share: float = 0.25
    shift: float = 1.5
    turn_share: float = 0.12
    turn: float = float(np.radians(4.0))
    swing: float = 2.0
    simplify_share: float = 0.15
    tolerance: float = 2.0
    merge_share: float = 0.06
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
    for k in _pick(rng, loses, round(faults.simplify_share * len(buildings))):
        changes[k] = replace(changes[k], simplify_m=tolerances[k])
    for k in _pick(rng, present, len(_some(rng, len(buildings), faults.turn_share))):
        # Whoever traced a long building saw when it was turned by much.
        most = min(faults.turn, faults.swing / _radius(buildings[k]))
        turn = float(rng.uniform(0.25, 1.0) * most * rng.choice([-1, 1]))
        changes[k] = replace(changes[k], turn_rad=turn)
    for k in _pick(rng, present, len(_some(rng, len(buildings), faults.shift_share))):
        size, way = rng.uniform(0.3, 1.0) * faults.shift, rng.uniform(0, 2 * np.pi)
        changes[k] = replace(changes[k], shift_m=(float(size * portable.cos(way)), float(size * portable.sin(way))))
    count = len(_some(rng, len(buildings), faults.new))
    return Perturbation(common, tuple(changes), _draw_new(buildings, count, rng, keep_clear))


def _some(rng: np.random.Generator, count: int, share: float) -> list[int]:
    """Random indices of 0..count-1, a `share` of them, in order; at least one if count is eight or more."""
    number = max(round(share * count), 1 if count >= 8 and share > 0 else 0)
    return _pick(rng, list(range(count)), number)


def _pick(rng: np.random.Generator, candidates: list[int], number: int) -> list[int]:
    """At most `number` random ones of the candidates, in order."""
    chosen = rng.permutation(len(candidates))[: max(number, 0)]
    return [candidates[k] for k in np.sort(chosen)]


def _draw_merges(
    buildings: Sequence[Building],
    present: list[int],
    faults: MapFaults,
    rng: np.random.Generator,
    changes: list[Change],
) -> set[int]:
    """Merge pairs of close neighbours: marks `changes`, returns the buildings that were merged into others."""
    by_id = {b.osm_id: b for b in buildings}
    gone: set[int] = set()
    used: set[int] = set()
    number = len(_some(rng, len(buildings), faults.merge_share))
    plain = [k for k in present if len(buildings[k].footprints) == 1 and not buildings[k].footprints[0].holes]
    shapes = {k: footprint_polygon(buildings[k].footprints[0]) for k in plain}
    for k in _pick(rng, plain, len(plain)) if number else []:
        partners = [j for j in plain if j != k and j not in used and shapes[k].distance(shapes[j]) <= faults.gap]
        if k in used or not partners or len(gone) == number:
            continue
        j = partners[int(rng.integers(len(partners)))]
        change = replace(changes[k], merged_with=(buildings[j].osm_id,), gap_m=faults.gap)
        if len(join_outlines(buildings[k], change, by_id).footprints) == 1:
            changes[k], changes[j] = change, replace(changes[j], merged_into=buildings[k].osm_id)
            gone.add(j)
            used |= {j, k}
    return gone


def _radius(building: Building) -> float:
    """Distance from the middle to the farthest corner, m."""
    corners = np.concatenate([footprint.outer for footprint in building.footprints])
    return float(np.linalg.norm(corners - building.middle, axis=1).max())


def _corners(building: Building) -> int:
    """Number of corners of a building's outlines."""
    return sum(len(ring) for footprint in building.footprints for ring in footprint.rings)


def _draw_new(
    buildings: Sequence[Building], count: int, rng: np.random.Generator, keep_clear: Any
) -> tuple[Building, ...]:
    """Planned houses on free ground near others; fewer where there is no room."""
    from shapely import union_all

    taken = [footprint_polygon(f).buffer(1.0) for b in buildings for f in b.footprints]
    taken = union_all(taken if keep_clear is None else [*taken, keep_clear])
    number = min([0, *(int(b.osm_id.split("/")[1]) for b in buildings)])
    houses: list[Building] = []
    for _ in range(40 * count):
        if len(houses) == count:
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
            name = f"way/{number - 1 - len(houses)}"
            houses.append(Building(name, (Footprint(outline),), height, tags={"building": "house"}))
    return tuple(houses)


@dataclass(frozen=True)
class Extracts:
    """Paths of the two maps and the record, and the perturbation itself."""

    exact: Path
    perturbed: Path
    record: Path
    perturbation: Perturbation


def write_extracts(
    folder: Path,
    city: City,
    origin: NDArray[Any],
    rng: np.random.Generator,
    faults: MapFaults | None = None,
) -> Extracts:
    """Write `map.osm`, `map_perturbed.osm` and `truth/map_perturbation.json` below `folder`, each atomically.

    city : its x is east, its y north of `origin`
    origin : (3,) lat, lon (deg), height (m) of the city frame's x = y = 0
    faults : magnitudes of the errors of the perturbed copy, None for the defaults
    Raises InputError: the city has no buildings; OutputError: `folder` cannot be written.

    The perturbation starts from the exact map after rounding to 1e-7 deg, so `perturb` of that map and the record
    reproduces the perturbed file byte for byte.
    """
    attribution = city.attribution if isinstance(city, OsmCity) else None
    buildings = city_buildings(city)
    if not buildings:
        raise InputError("a scene without buildings has no OpenStreetMap extract")
    data = osm_from_buildings(buildings, origin, attribution)
    exact = buildings_of(data, origin).buildings
    drawn = draw_perturbation(exact, faults or MapFaults(), rng, _streets(city))
    perturbation = replace(drawn, attribution=attribution)
    extracts = Extracts(folder / EXACT, folder / PERTURBED, folder / RECORD, perturbation)
    try:
        extracts.record.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{extracts.record.parent} cannot be made: {cause(error)}") from None
    write_osm(extracts.exact, data)
    write_osm(extracts.perturbed, osm_from_buildings(perturb(exact, perturbation), origin, attribution))
    write_perturbation(extracts.record, perturbation)
    return extracts


def osm_from_buildings(buildings: Sequence[Building], origin: NDArray[Any], attribution: str | None) -> OsmData:
    """Extract of `buildings` (local frame at `origin`), degrees rounded to 7 decimals as in a file.

    Nodes, and rings of multipolygons, get negative numbers, which no element of OpenStreetMap has.
    """
    data = OsmData(attribution=attribution)
    names = [(kind, int(number)) for kind, number in (building.osm_id.split("/") for building in buildings)]
    maker = AreaMaker(data, {number for _, number in names}, shares_nodes=False)
    for name, building in zip(names, buildings, strict=True):
        polygons = [[_places(ring, origin) for ring in footprint.rings] for footprint in building.footprints]
        tags = _written_tags(building)
        maker.add(name, polygons, tags, {"type": "multipolygon", **tags})
    return data


def city_buildings(city: City) -> list[Building]:
    """Buildings of a city, m, in its frame; those of a generated one get negative numbers and heights rounded to 0.1 m."""
    from shapely import Polygon

    if isinstance(city, OsmCity):
        return city.buildings
    heights: list[float | None] = [round(height, 1) for height in city.heights]
    heights = heights or [None] * len(city.footprints)
    return [
        Building(f"way/-{k}", footprints_of(Polygon(outline)), height, tags={"building": "house"})
        for k, (outline, height) in enumerate(zip(city.footprints, heights, strict=True), 1)
    ]


def _places(ring: Floats, origin: NDArray[Any]) -> list[Place]:
    """Corners (K, 2), m, as degrees rounded as in a file."""
    fixes = from_local(np.column_stack([ring, np.zeros(len(ring))]), origin)
    return [(round(lat, DECIMALS), round(lon, DECIMALS)) for lat, lon, _ in fixes.tolist()]


def _written_tags(building: Building) -> dict[str, str]:
    """Tags of a building; its height is added where the tags lack it or differ."""
    tags = {"building": "yes", **building.tags}
    if building.height is not None and height_of(tags) != building.height:
        tags["height"] = f"{building.height:.10g}"
    return tags


def _streets(city: City) -> Any:
    """Area of all streets, None where there are none."""
    from shapely import LineString, union_all

    streets = city.streets or ([] if city.street is None else [city.street])
    lines = [LineString(street.position(street.sample(2.0))).buffer(ROADSIDE) for street in streets]
    return union_all(lines) if lines else None
