"""Building pages of the report: map before and after with observed walls, displacements, and constraints."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.geometry import se2
from lslam.core.printable import count_of
from lslam.core.types.building import Building, BuildingCorrection, CorrectedMap, KeyframeMatch, OsmMatches
from lslam.core.types.comparison import Table
from lslam.core.types.run_record import RunRecord
from lslam.reports.plots import Figure
from lslam.reports.svg import MOST_POINTS, Track, plane_chart

MOST_WALLS = 2500  # drawn; the page stays small
MOST_ROWS = 60
DRAWN_M = 30.0  # m round the way that are drawn
KINDS = ("steady", "wandering")  # of drift, as the manifest has them


@dataclass(frozen=True)
class BuildingPages:
    """Figures and tables of the section."""

    figures: list[Figure]
    tables: list[Table]


def building_pages(record: RunRecord) -> BuildingPages | None:
    """Section of a run that was constrained by a map of buildings; None for others."""
    if record.osm is None or record.buildings is None:
        return None
    poses = se2.of_se3(record.trajectory.poses[record.keyframe_scans])
    tables = drift_tables(record) + building_tables(record.buildings, record.osm)
    return BuildingPages(building_figures(record.buildings, record.osm, poses), tables)


def building_figures(result: CorrectedMap, matches: OsmMatches, poses: Floats) -> list[Figure]:
    """Plans: buildings before and after with the observed walls, and where the map constrained the trajectory.

    poses : (K, 3) x, y (m), yaw (rad) of all keyframes in the map frame
    """
    low, high = poses[:, :2].min(axis=0) - DRAWN_M, poses[:, :2].max(axis=0) + DRAWN_M
    near = [c for c in result.buildings if ((c.building.middle >= low) & (c.building.middle <= high)).all()]
    walls = _seen_walls(matches.keyframes, poses)
    gone = [c for c in near if c.status == "absent"]
    drawn = [
        ("s5", "walls seen", _segments(walls)),
        ("gt", "buildings on the map", _outlines(c.building for c in near)),
        ("s1", "where they stand", _outlines(c.real_building for c in near if c.status != "absent")),
        ("s2", "absent in the scans", _outlines(c.real_building for c in gone)),
        ("s4", "new: walls without a building", _segments(result.new_walls)),
    ]
    tracks = [Track(label, part, style) for style, label, lines in drawn for part in _parts(lines)]
    legend = tuple((style, label) for style, label, lines in drawn if len(lines))
    caption = (
        f"x east, y north of the run's origin. Mode {result.mode}. {result.attribution or 'A map nobody surveyed.'}"
    )
    plan = plane_chart(tracks, "buildings from above, before and after", width=720, tallest=760, by="own")
    return [Figure("Buildings before and after, from above", plan, legend, caption, wide=True), _holds(matches, poses)]


def drift_tables(record: RunRecord) -> list[Table]:
    """Tables of drift that was estimated from walls or loops and removed, constant or varying; empty without any."""
    known = record.manifest.get("graph", {})
    kind, claim = next(((kind, known[f"{kind}_drift"]) for kind in KINDS if f"{kind}_drift" in known), ("", None))
    if claim is None:
        return []
    words = (
        ("east_percent", "to the east, %"),
        ("north_percent", "to the north, %"),
        ("x_percent", "along x, %"),
        ("y_percent", "along y, %"),
        ("z_percent", "along z, %"),
        ("about_x_deg_per_100m", "turn about x, deg/100 m"),
        ("about_y_deg_per_100m", "turn about y, deg/100 m"),
        ("left_deg_per_100m", "turn to the left, deg/100 m"),
    )
    told_of = [(word, claim[name]) for name, word in words if name in claim]
    rows: tuple[tuple[str, ...], ...] = tuple(
        (word, f"{one['estimate']:+.3f}", f"{one['sigma']:.3f}") for word, one in told_of
    )
    header: tuple[str, ...] = ("drift", "estimate", "sigma")
    if kind == "wandering":
        rows = tuple((*row, f"{one['rms']:.3f}") for row, (_, one) in zip(rows, told_of, strict=True))
        header = (*header, "rms, from place to place")
    told, then = "walls moved while they were passed", "the map held it"
    if "x_percent" in claim:
        told, then = "loops over different ways tell one rate", "they were closed"
    recipe = (
        f"So odometry ran away, in the mean over the way: {told}. It was set right before {then}. The logarithm of the "
        f"likelihood is higher with the drift by {claim['log_likelihood_gain']:.1f}; chance stays below "
        f"{claim['gain_by_chance']:.1f}."
    )
    return [Table(f"{kind.capitalize()} drift of odometry", header, rows, recipe)]


def building_tables(result: CorrectedMap, matches: OsmMatches) -> list[Table]:
    """Tables of displacements, largest first, and of the reasons why matches were rejected."""
    order = sorted(result.buildings, key=lambda c: (c.status == "unseen", -float(np.linalg.norm(c.displacement[:2]))))
    rows = tuple(_row(c) for c in order[:MOST_ROWS])
    counts = Counter(c.status for c in result.buildings)
    east, north = -result.shift
    recipe = (
        f"Real minus map, about the middle of each building; {count_of(len(result.buildings), 'building')}: "
        f"{counts['seen']} seen, {counts['unseen']} not, {counts['absent']} absent; the map as a whole lies {east:+.2f} m east "
        f"and {north:+.2f} m north of the run; {count_of(len(result.overlaps), 'pair')} still overlap. Confidence: to stand "
        "within 0.5 m of there."
    )
    header = ("building", "status", "east, m", "north, m", "turn, deg", "confidence", "matches", "given up")
    tables = [Table("Displacement of buildings", header, rows, recipe)]
    reasons: Counter[tuple[str, str]] = Counter()
    for kind, held in (("keyframe on the map", matches.keyframes), ("building on the walls seen", matches.local)):
        for match in held:
            # Without its number, so that equal ones can be counted.
            reason = re.sub(r"^[\d.]+ times", "… times", match.reason) or "given up"
            reasons[kind, "used" if match.is_accepted else reason] += 1
    rows = tuple((kind, reason, str(number)) for (kind, reason), number in reasons.most_common())
    recipe = "A keyframe's match holds the trajectory, a building's only moves that building."
    return [*tables, Table("Matches of walls", ("match", "what became of it", "how many"), rows, recipe)]


def _row(correction: BuildingCorrection) -> tuple[str, ...]:
    """Cells of a correction: building, status, shift east and north, m, yaw, deg, confidence, used and rejected matches."""
    east, north, yaw = correction.displacement
    name = correction.building.tags.get("name", "")
    return (
        f"{correction.building.osm_id} {name}".strip(),
        correction.status,
        f"{east:+.2f}",
        f"{north:+.2f}",
        f"{np.degrees(yaw):+.2f}",
        f"{correction.confidence:.2f}",
        str(correction.used_matches),
        str(correction.rejected_matches),
    )


def _holds(matches: OsmMatches, poses: Floats) -> Figure:
    """Figure of the path, `poses` (K, 3), with the parts where the map constrained the trajectory."""
    at = {match.keyframe: match for match in matches.keyframes}
    used = np.array([k for k, match in at.items() if match.is_accepted], np.intp)
    kinds = [
        ("s1", "held by walls of two directions", [k for k in used if at[int(k)].rank == 3]),
        ("s3", "held across parallel walls only", [k for k in used if at[int(k)].rank < 3]),
    ]
    refused = [k for k, match in at.items() if not match.is_accepted and match.kind != "none"]
    tracks = [Track("way", poses[:, :2], "gt", ends=True)]
    tracks += [Track(label, _dots(poses[keys, :2]), style) for style, label, keys in kinds if len(keys)]
    legend = [("gt", "way"), *((style, label) for style, label, keys in kinds if len(keys))]
    legend += [("bad", "match not used")] if refused else []
    chart = plane_chart(tracks, "matches along the way", points=poses[refused, :2], width=720, tallest=560, by="own")
    caption = f"{len(used)} of {count_of(len(at), 'keyframe')} held by the map."
    return Figure("Where the map held the trajectory, from above", chart, tuple(legend), caption, wide=True)


def _dots(xy: Floats) -> Floats:
    """Positions (K, 2) with NaN rows between, so that a chart draws points without connecting lines."""
    return np.stack([xy, np.full_like(xy, np.nan)], axis=1).reshape(-1, 2)


def _seen_walls(sights: Sequence[KeyframeMatch], poses: Floats) -> Floats:
    """(S, 2, 2) walls observed from a few evenly chosen keyframes, to keep the page small."""
    total = sum(len(s.walls) for s in sights)
    every = max(1, -(-total // MOST_WALLS))
    found = [se2.apply(poses[s.keyframe], s.walls) for s in sights[::every] if len(s.walls)]
    return np.concatenate(found) if found else np.zeros((0, 2, 2))


def _segments(walls: Floats) -> list[Floats]:
    """Walls (S, 2, 2) as lines."""
    return [np.asarray(wall) for wall in walls]


def _outlines(buildings: Iterable[Building]) -> list[Floats]:
    """Closed outlines of the buildings, holes included."""
    rings = (ring for building in buildings for footprint in building.footprints for ring in footprint.rings)
    return [np.concatenate([ring, ring[:1]]) for ring in rings]


def _parts(lines: list[Floats]) -> list[Floats]:
    """Pieces of a line (N, 2) that is broken by NaN, short enough to be drawn without thinning."""
    gap = np.full((1, 2), np.nan)
    parts: list[list[Floats]] = [[]]
    size = 0
    for line in lines:
        if size + len(line) + 1 > MOST_POINTS:
            parts.append([])
            size = 0
        parts[-1] += [line, gap]
        size += len(line) + 1
    return [np.concatenate(part) for part in parts if part]
