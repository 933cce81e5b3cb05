"""Which beam each point belongs to, where the recording does not say: rows, order in the file, or elevation."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lslam.core.config.input import RINGS
from lslam.core.errors import InputError, UsageError
from lslam.core.types.arrays import Floats
from lslam.core.types.scan import NO_RING, Scan
from lslam.registration.kernels import ring_order
from lslam.registration.preprocessing.beams import elevation_borders

Kind = Literal["field", "rows", "order", "elevation"]

FEWEST, MOST = 4, 300  # rings of any LiDAR that LOAM is meant for
_USUAL_ROWS = (256, 192, 128, 96, 80, 64, 48, 40, 32, 20, 16)  # more first: half of the rows are rows as well
_LEAST_PER_RING = 20
# Azimuth may go back this far within a ring, by noise and by the lasers' offsets, without a new ring beginning.
_BACKWARD = np.radians(5.0)
# From ring to ring elevation jumps by more than this at least.
_TILT = np.radians(0.08)
# Beams of any LiDAR are farther apart than this.
_CLOSEST = np.radians(0.05)
# Of points stored ring after ring this share goes a little further than the one before.
_AHEAD = 0.8


@dataclass(frozen=True)
class RingRule:
    """How the rings of a recording's scans are found.

    count : number of rings; columns : of `rows`, whether points are ordered column after column
    borders : of `elevation`, (count - 1,) rad between the beams, increasing
    """

    kind: Kind
    count: int
    columns: bool = False
    borders: tuple[float, ...] = ()

    def __str__(self) -> str:
        how = {
            "field": "the ring field of the points",
            "rows": f"the {'columns' if self.columns else 'rows'} of the organised clouds",
            "order": "from the azimuth wraps of the file order",
            "elevation": "from clusters of elevation",
        }[self.kind]
        return f"rings: {self.count}, {how}"

    def rings_of(self, scan: Scan) -> NDArray[np.uint16]:
        """(N,) ring of each point; from the top one, where it is not the field's own number.

        Raises InputError when the scan does not obey the rule.
        """
        if self.kind == "field":
            if scan.rings is None:
                raise InputError(f"scan {scan.index} has no ring field, unlike the first one: see --rings")
            return scan.rings
        if self.kind == "rows":
            return _rows(scan, self.count, self.columns)
        if self.kind == "order":
            rings = rings_by_order(scan.points)
            if rings is None:
                raise InputError(f"scan {scan.index} is not in ring order, unlike the first one: see --rings")
            return rings
        elevation = elevations(scan.points)
        return (self.count - 1 - np.searchsorted(self.borders, elevation)).astype(np.uint16)


def decide_rings(scans: list[Scan], wanted: str = "auto", known: int | None = None) -> RingRule:
    """The rule for a recording, from a few of its scans.

    Parameters
    ----------
    wanted : auto, field, rows[:N], order or elevation[:N], what `input.rings` may be
    known : number of beams, where the recording says it

    Raises
    ------
    UsageError : `wanted` is none of these. InputError : the scans do not have such rings, or none at all.
    """
    kind, count = parse_rings(wanted)
    # The end of a sweep, which a driver may begin with, says nothing of its order.
    usual = np.median([len(scan) for scan in scans])
    whole = [scan for scan in scans if 2 * len(scan) >= usual]
    first = whole[0]
    rules = {
        "field": lambda: _decide_field(scans),
        "rows": lambda: _decide_rows(whole, count or known),
        "order": lambda: _decide_order(first),
        "elevation": lambda: _decide_elevation(scans, count, known),
    }
    for name in rules if kind == "auto" else [kind]:
        rule = rules[name]()
        if rule is not None:
            return rule
    raise InputError(_refusal(kind, count, first))


def parse_rings(rule: str) -> tuple[str, int | None]:
    """`rows:64` -> ("rows", 64). Raises UsageError for what `input.rings` does not know."""
    match = RINGS.fullmatch(rule)
    if match is None:
        raise UsageError(f"--rings {rule}: auto, field, order, rows[:N] or elevation[:N] is needed")
    kind, count = match.group(1) or match.group(2), match.group(3)
    return kind, int(count) if count else None


def elevations(points: NDArray[Any]) -> NDArray[np.float32]:
    """(N,) angle above the sensor's horizon, rad; NaN for points at the origin and those that are not finite."""
    p = np.asarray(points, np.float32)
    with np.errstate(invalid="ignore", over="ignore"):
        flat = np.sqrt(p[:, 0] ** 2 + p[:, 1] ** 2)
        elevation = np.arctan2(p[:, 2], flat)
    elevation[~np.isfinite(flat) | ((flat == 0) & (p[:, 2] == 0))] = np.nan
    return np.asarray(elevation)


def rings_by_order(points: NDArray[Any]) -> NDArray[np.uint16] | None:
    """(N,) rings of points stored ring after ring, as in KITTI: a new one begins where the azimuth passes the seam.

    None when the points are not ordered so.
    """
    return _cut_rings(points)[0]


def ring_seam(points: NDArray[Any]) -> float | None:
    """Angle, rad, from the first point, in the sense of rotation, to the azimuth at which all rings begin; None as above."""
    rings, seam = _cut_rings(points)
    return None if rings is None else seam


def _cut_rings(points: NDArray[Any]) -> tuple[NDArray[np.uint16] | None, float]:
    """Rings and their seam: the angle at which most jumps of elevation happen, since all rings begin there."""
    turned, slope, jumps, ahead = ring_order.follow(np.ascontiguousarray(points, np.float32), _BACKWARD, _TILT)
    if ahead < _AHEAD:
        return None, 0.0
    before = np.maximum(jumps - 1, 0)
    seam = _stab(turned[before], turned[jumps])
    rings, slopes, counts = ring_order.cut(turned, slope, seam)
    if not FEWEST <= len(counts) <= MOST or counts.mean() < _LEAST_PER_RING or not _is_staircase(slopes):
        return None, seam
    return rings, seam


def _is_staircase(values: Floats) -> bool:
    """Whether nearly each of the values (M,) lies clearly below, or each above, the one before."""
    gaps = np.diff(values)
    gaps *= np.sign(np.median(gaps))
    usual = float(np.median(np.abs(gaps)))
    falls_through = gaps.sum() > 0.9 * np.abs(gaps).sum()
    return bool(falls_through and usual > _CLOSEST and (gaps > 0.25 * usual).mean() > 0.9)


def _stab(start: Floats, end: Floats) -> float:
    """The angle within 0..2 pi that most of the arcs from `start` to `end` (M,), rad, contain; the middle of where they meet."""
    full = 2 * np.pi
    low = np.remainder(start, full)
    high = low + np.minimum(end - start, full)
    low, high = np.concatenate([low, low + full]), np.concatenate([high, high + full])
    at = np.concatenate([low, high])
    order = np.lexsort((np.repeat([1, -1], len(low)), at))
    cover = np.cumsum(np.repeat([1, -1], len(low))[order])
    best = int(np.argmax(cover)) if len(cover) else 0
    if not len(cover) or best + 1 == len(order):
        return 0.0
    return float((at[order[best]] + at[order[best + 1]]) / 2 % full)


def _decide_field(scans: list[Scan]) -> RingRule | None:
    fields = [np.unique(s.rings[s.rings != NO_RING]) for s in scans if s.rings is not None]
    if 2 * len(fields) <= len(scans):
        return None
    values = np.unique(np.concatenate(fields))
    # A driver that fills the field with zeros says nothing.
    return RingRule("field", len(values)) if len(values) > 1 else None


def _decide_rows(scans: list[Scan], count: int | None) -> RingRule | None:
    """The layout of most scans: points that are stored ring after ring can be cut into rows where their number allows it."""
    rule, having = Counter(organised_rows(scan, count) for scan in scans).most_common(1)[0]
    return rule if 2 * having > len(scans) else None


def organised_rows(scan: Scan, count: int | None = None) -> RingRule | None:
    """The rule of an organised cloud, of `count` rows where that is known; None for other clouds."""
    for rows in (count,) if count else _USUAL_ROWS:
        if len(scan) % rows or len(scan) // rows < _LEAST_PER_RING or rows < FEWEST:
            continue
        for columns in (False, True):
            if _is_organised(scan.points, rows, columns):
                return RingRule("rows", rows, columns)
    return None


def _is_organised(points: NDArray[np.float32], rows: int, columns: bool) -> bool:
    """Whether each row keeps its elevation and lies below (or above) the one before."""
    table = elevations(points).reshape((-1, rows) if columns else (rows, -1))
    table = table.T if columns else table
    is_full = np.isfinite(table).sum(axis=1) >= 5
    if is_full.sum() < max(FEWEST, rows // 2):
        return False
    middle = np.nanmedian(table[is_full], axis=1)
    spread = np.nanmedian(np.abs(table[is_full] - middle[:, None]), axis=1)
    return _is_staircase(middle) and bool(np.median(spread) < 0.25 * np.median(np.abs(np.diff(middle))))


def _rows(scan: Scan, rows: int, columns: bool) -> NDArray[np.uint16]:
    if len(scan) % rows:
        raise InputError(f"scan {scan.index}: {len(scan)} points are not {rows} rows of equal length: see --rings")
    index = np.arange(len(scan))
    return (index % rows if columns else index // (len(scan) // rows)).astype(np.uint16)


def _decide_order(scan: Scan) -> RingRule | None:
    rings = rings_by_order(scan.points)
    return None if rings is None else RingRule("order", int(rings.max()) + 1)


def _decide_elevation(scans: list[Scan], count: int | None, known: int | None) -> RingRule | None:
    pooled = np.concatenate([elevations(s.points) for s in scans])
    borders = elevation_borders(pooled[np.isfinite(pooled)].astype(np.float64), count)
    if borders is None or (known is not None and count is None and len(borders) + 1 > known):
        return None
    return RingRule("elevation", len(borders) + 1, borders=tuple(borders.tolist()))


def _refusal(kind: str, count: int | None, scan: Scan) -> str:
    beams = f"{count} " if count else ""
    why = {
        "auto": "have no ring field, are not organised in rows, do not follow the beams in their order, and their "
        "elevations do not cluster (a merged or shuffled cloud, or a pattern that does not repeat)",
        "field": "have no ring field, or it says the same of all points",
        "rows": f"are not organised in {beams}rows, one elevation each ({len(scan)} points in scan {scan.index})",
        "order": "are not stored ring after ring",
        "elevation": f"have no {beams}clusters of elevation",
    }[kind]
    way = (
        "give --rings rows:N or elevation:N, rows and cols in sequence.toml, or"
        if kind == "auto"
        else "try --rings auto, or"
    )
    return f"--rings {kind}: the scans {why}; {way} use --method loam-livox or icp, which need no rings"
