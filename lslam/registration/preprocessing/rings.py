"""Which beam each point belongs to, where the recording does not say: rows, order in the file, or elevation.

Beams are clusters among the elevations of points.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.config.input import RINGS
from lslam.core.errors import InputError, UsageError
from lslam.core.types.scan import NO_RING, Scan
from lslam.registration.kernels import ring_order

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


def decide_rings(scans: list[Scan], choice: str = "auto", beams: int | None = None) -> RingRule:
    """The rule for a recording, from a few of its scans.

    Parameters
    ----------
    choice : auto, field, rows[:N], order or elevation[:N], what `input.rings` may be
    beams : number of beams, where the recording says it

    Raises
    ------
    UsageError : `choice` is none of these. InputError : the scans do not have such rings, or none at all.
    """
    kind, count = parse_rings(choice)
    # The end of a sweep, which a driver may begin with, says nothing of its order.
    usual = np.median([len(scan) for scan in scans])
    whole = [scan for scan in scans if 2 * len(scan) >= usual]
    first = whole[0]
    rules = {
        "field": lambda: _decide_field(scans),
        "rows": lambda: _decide_rows(whole, count or beams),
        "order": lambda: _decide_order(first),
        "elevation": lambda: _decide_elevation(scans, count, beams),
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
    """Rings (N,) of points stored ring after ring, None where they are not, and their seam, rad.

    All rings begin at the seam, so it is the angle at which most jumps of elevation happen.
    """
    turned, slope, jumps, ahead = ring_order.follow(np.ascontiguousarray(points, np.float32), _BACKWARD, _TILT)
    if ahead < _AHEAD:
        return None, 0.0
    before = np.maximum(jumps - 1, 0)
    seam = _most_covered_angle(turned[before], turned[jumps])
    rings, slopes, counts = ring_order.cut_rings(turned, slope, seam)
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


def _most_covered_angle(start: Floats, end: Floats) -> float:
    """The angle within 0..2 pi that most of the arcs from `start` to `end` (M,), rad, contain: the middle of their overlap."""
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
    """The rule to take the ring field; None where most scans lack it or it holds one value."""
    fields = [np.unique(s.rings[s.rings != NO_RING]) for s in scans if s.rings is not None]
    if 2 * len(fields) <= len(scans):
        return None
    values = np.unique(np.concatenate(fields))
    # A driver that fills the field with zeros says nothing.
    return RingRule("field", len(values)) if len(values) > 1 else None


def _decide_rows(scans: list[Scan], count: int | None) -> RingRule | None:
    """The row layout that most scans have, of `count` rows if given; None without one."""
    rule, having = Counter(organised_rows(scan, count) for scan in scans).most_common(1)[0]
    return rule if 2 * having > len(scans) else None


def organised_rows(scan: Scan, count: int | None = None) -> RingRule | None:
    """The rule of an organised cloud, of `count` rows where that is known; None for other clouds."""
    for rows in (count,) if count else _USUAL_ROWS:
        if len(scan) % rows or len(scan) // rows < _LEAST_PER_RING or rows < FEWEST:
            continue
        for columns in (False, True):
            if _has_rows(scan.points, rows, columns):
                return RingRule("rows", rows, columns)
    return None


def _has_rows(points: NDArray[np.float32], rows: int, columns: bool) -> bool:
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
    """(N,) row of each point; raises InputError where the points are not `rows` rows of equal length.

    columns : whether points are stored column after column
    """
    if len(scan) % rows:
        raise InputError(f"scan {scan.index}: {len(scan)} points are not {rows} rows of equal length: see --rings")
    index = np.arange(len(scan))
    return (index % rows if columns else index // (len(scan) // rows)).astype(np.uint16)


def _decide_order(scan: Scan) -> RingRule | None:
    """The rule to cut rings by the order of the points; None where the scan is not stored ring after ring."""
    rings = rings_by_order(scan.points)
    return None if rings is None else RingRule("order", int(rings.max()) + 1)


def _decide_elevation(scans: list[Scan], count: int | None, beams: int | None) -> RingRule | None:
    """The rule by clusters of elevation, `count` of them if given; None where there are none or more than `beams`."""
    pooled = np.concatenate([elevations(s.points) for s in scans])
    borders = elevation_borders(pooled[np.isfinite(pooled)].astype(np.float64), count)
    if borders is None or (beams is not None and count is None and len(borders) + 1 > beams):
        return None
    return RingRule("elevation", len(borders) + 1, borders=tuple(borders.tolist()))


def _refusal(kind: str, count: int | None, scan: Scan) -> str:
    """Message that the scans have no rings of the `kind`, with what to do instead."""
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


_BIN_DEG = 0.01
_WIDTHS_DEG = (0.02, 0.04, 0.08, 0.16, 0.32)  # smoothing that is tried, the finest first
_VALLEY = 0.3  # between two beams the density falls below this share of the smaller one
_LEAST_POINTS = 5  # of a beam
_SMALL = 0.05  # of the points of a usual beam: fewer are strays
_TIGHT = 0.15  # median distance from the beam over the distance between beams; 0.25 is no clustering at all


def elevation_borders(elevation: Floats, count: int | None = None) -> Floats | None:
    """Borders (beams - 1,) rad, increasing, between the beams that elevations (N,), rad, cluster round.

    Beams may be unevenly spaced and differ much in their points. With `count` exactly so many are found. None when the
    elevations do not cluster.
    """
    for width in _WIDTHS_DEG:
        borders = _borders(elevation, width)
        n = len(borders) + 1
        if (count is not None and n == count) or (
            count is None and FEWEST <= n <= MOST and _is_tight(elevation, borders)
        ):
            return borders
    return None


def ring_gap(points: NDArray[np.float32]) -> float:
    """The usual angle, rad, between neighbouring rings of points (N, 3), LiDAR frame; 0 where elevations do not cluster."""
    p = points.astype(np.float64)
    borders = elevation_borders(np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1])))
    return 0.0 if borders is None else float(np.median(np.diff(borders)))


def _borders(elevation: Floats, width_deg: float) -> Floats:
    """Elevations, rad, at the minima between the peaks of a histogram smoothed by `width_deg`."""
    edges = np.radians(np.arange(-90.0, 90.0 + _BIN_DEG, _BIN_DEG))
    counts = np.histogram(elevation, edges)[0].astype(np.float64)
    reach = round(3 * width_deg / _BIN_DEG)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) * _BIN_DEG / width_deg) ** 2)
    density = np.convolve(counts, weights, mode="same")
    centres = (edges[:-1] + edges[1:]) / 2
    valleys = _valleys(density)
    return np.asarray(centres[_without_small(valleys, np.concatenate([[0.0], np.cumsum(counts)]))])


def _valleys(density: Floats) -> list[int]:
    """Bins of the minima of a density that are deep enough below the peaks on both sides."""
    rising = np.diff(density, prepend=0.0) > 0
    peaks = np.flatnonzero(rising & (np.diff(density, append=0.0) <= 0))
    heights: list[float] = []
    borders: list[int] = []
    for k, peak in enumerate(peaks):
        if k:
            low = peaks[k - 1] + density[peaks[k - 1] : peak + 1].argmin()
            flat = np.flatnonzero(density[low:peak] > density[low])
            borders.append(int(low + (flat[0] if len(flat) else 0) // 2))
        heights.append(float(density[peak]))
        while borders and density[borders[-1]] >= _VALLEY * min(heights[-2:]):
            heights[-2:] = [max(heights[-2:])]
            borders.pop()
    return borders


def _without_small(borders: list[int], total: Floats) -> list[int]:
    """The borders (bins) without those of clusters with next to no points, which join the smaller neighbour.

    total : number of points up to each bin
    """
    while borders:
        mass = np.diff(total[[0, *borders, len(total) - 1]])
        least = int(mass.argmin())
        if mass[least] >= max(_LEAST_POINTS, _SMALL * float(np.median(mass))):
            break
        left, right = (mass[k] if 0 <= k < len(mass) else np.inf for k in (least - 1, least + 1))
        borders = [b for k, b in enumerate(borders) if k != (least - 1 if left < right else least)]
    return borders


def _is_tight(elevation: Floats, borders: Floats) -> bool:
    """Whether points lie near the middle of their cluster, measured by the distance to the next one."""
    beam = np.searchsorted(borders, elevation)
    order = np.lexsort((elevation, beam))
    parts = np.split(elevation[order], np.flatnonzero(np.diff(beam[order])) + 1)
    middles = np.array([np.median(part) for part in parts])
    spread = np.median(np.concatenate([np.abs(part - middle) for part, middle in zip(parts, middles, strict=True)]))
    return bool(spread < _TIGHT * np.median(np.diff(middles)))
