"""Sequences seen in another way: rings or times of points filled in by a rule, classes left out, several LiDARs as one.

Of several LiDARs a scan is a sweep of the first, with what the others measured meanwhile.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Bools, Floats, Longs
from lslam.core.config.input import PreprocessConfig
from lslam.core.errors import InputError
from lslam.core.labels import table_of
from lslam.core.types.scan import NO_RING, Scan, Span
from lslam.core.types.sequence import Sequence, SequenceView, readable
from lslam.registration.preprocessing.rings import RingRule, decide_rings
from lslam.registration.preprocessing.sweep_clock import SweepClock

log = logging.getLogger("lslam")
# Scans a rule, or the span of sweeps, is decided on: the first that can be read.
_LOOKED_AT = 5
# More than any LiDAR has: the rings of the k-th one begin at k times this.
RINGS_APART = 512
# A sweep is over after so many of its periods, where the leading LiDAR pauses.
_LONGEST_SWEEP = 1.5
_SYNCHRONOUS_NS = 1_000_000  # clouds without times that are no further apart belong to one instant
# Points nearer to their own sensor hit what carries it; the run's gate measures from the leading one.
_NEAREST_M = float(PreprocessConfig.model_fields["range_min"].default)


class ClockView(SequenceView):
    """The sequence with the times of its points by `clock`, without any where that is None; all else is the sequence's own.

    later : scans from which on another clock tells them
    """

    def __init__(
        self, whole: Sequence, clock: SweepClock | None, later: Iterable[tuple[int, SweepClock | None]] = (), **own: Any
    ) -> None:
        super().__init__(whole, **own)
        self.sweep_clock = clock
        self._clocks = [(0, clock), *later]

    def scan(self, index: int) -> Scan:
        """Read scan `index`; points that break the rule are named in its `fault`. Raises InputError as the sequence does."""
        scan = self.whole.scan(index)
        clock = next(clock for first, clock in reversed(self._clocks) if first <= index)
        if clock is None:
            return replace(scan, times=None)
        if not len(scan):
            return replace(scan, times=np.zeros(0, np.float32))
        times, why = clock.times_of(scan.points)
        if why:
            log.warning("scan %d: point times: %s", scan.index, why)
        return replace(scan, times=times)


class RingView(SequenceView):
    """A sequence with the rings of its scans filled in; all else is the sequence's own.

    is_strict : points without a ring are left out, and scans without rings are an error
    """

    def __init__(self, whole: Sequence, rule: RingRule, is_strict: bool = True) -> None:
        super().__init__(whole, notes=[*whole.notes, str(rule)])
        self.rule, self._is_strict = rule, is_strict

    def scan(self, index: int) -> Scan:
        """Read scan `index` and find its rings, by itself where it does not obey the rule.

        Raises InputError when it cannot be read, or when rings are required and cannot be found.
        """
        scan = self.whole.scan(index)
        if not len(scan):
            return scan
        try:
            rings = self.rule.rings_of(scan)
        except InputError as error:
            try:
                rule = decide_rings([scan])
            except InputError:
                if self._is_strict:
                    raise error from None
                log.warning("scan %d: its points get no ring: %s", scan.index, error)
                return scan
            rings = rule.rings_of(scan)
            why = f"{error}: {rule}"
            scan = replace(scan, fault="; ".join(filter(None, (scan.fault, why))))
        scan = replace(scan, rings=rings)
        has_ring = rings != NO_RING
        return scan if has_ring.all() or not self._is_strict else scan.select(has_ring)


class WithoutClasses(SequenceView):
    """A sequence whose scans lack the points of some classes; all else is the sequence's own."""

    def __init__(self, whole: Sequence, classes: Iterable[str]) -> None:
        names = tuple(classes)
        super().__init__(whole, notes=[*whole.notes, f"points of {', '.join(names)} are left out"])
        self._is_dropped = table_of(names)

    def scan(self, index: int) -> Scan:
        """Read scan `index` and leave points out; one without labels stays whole, with a `fault`.

        Raises InputError as the sequence does.
        """
        scan = self.whole.scan(index)
        if scan.labels is None:
            why = "its points have no labels and none is left out"
            return replace(scan, fault="; ".join(filter(None, (scan.fault, why)))) if len(scan) else scan
        dropped = self._is_dropped[scan.labels]
        return scan.select(~dropped) if dropped.any() else scan


def with_rings(sequence: Sequence, choice: str = "auto", is_strict: bool = True) -> Sequence:
    """`sequence` with rings in every scan, found as `input.rings` says; the rule is among its notes.

    is_strict : as of `RingView`

    The first scans of the recording decide, whatever part of it is used, so that a run that is resumed decides alike.
    Raises InputError naming --rings when there are no rings to be found.
    """
    if isinstance(sequence, MergedLidars):  # each of them by itself
        return sequence.with_rings(choice, is_strict)
    scans = [scan for _, scan in islice(readable(range(len(sequence)), sequence.scan), _LOOKED_AT)]
    if not scans:
        return sequence  # nothing can be read, which is said in its turn
    rows = getattr(sequence, "rows", None)
    try:
        if rows and choice == "auto":
            rule = RingRule("rows", rows)  # as the reader filled them in
        else:
            rule = decide_rings(scans, choice, rows or getattr(sequence, "rings", None))
    except InputError as error:
        raise InputError(f"{sequence.path}: {error}") from None
    return RingView(sequence, rule, is_strict)


@dataclass(frozen=True)
class FurtherLidar:
    """A LiDAR beside the leading one: its name, its scans, its place, `T_lidar_other` (4, 4), and what says that."""

    name: str
    scans: Sequence
    T_lidar_other: Floats
    source: str = "as stated"


@dataclass
class _Reading:
    """A further LiDAR as it is read: `sweep` of its scans, None without times; begins, ends : (N,) ns of its scans.

    cache : the scans that were used last, by index
    """

    lidar: FurtherLidar
    sweep: Span | None
    begins: Longs
    ends: Longs
    cache: dict[int, Scan | None]


class MergedLidars(SequenceView):
    """The scans of `whole`, the leading LiDAR, each with the points that `others` measured during its sweep.

    These come in the frame of the leading LiDAR, with times from its stamp, so that they are deskewed as its own points are.
    A scan without times is of one instant, and goes with the sweep whose stamp is nearest. Stamps, poses, ground truth and
    extrinsics are those of the leading LiDAR.
    """

    def __init__(self, whole: Sequence, others: list[FurtherLidar]) -> None:
        self.notes, self.problems = list(whole.notes), list(whole.problems)
        super().__init__(whole, rows=None, cols=None, rings=None)
        self.further_lidars = others
        stamps, sweep = whole.stamps_ns, _sweep_of(whole)
        self._period_ns = _period_ns(whole)
        begin_ns = 0 if sweep is None else round(sweep.begin_s * 1e9)
        self._edges = np.append(stamps + begin_ns, stamps[-1] + begin_ns + self._period_ns)
        self._sources = [_source(other, begin_ns + self._period_ns // 2) for other in others]
        self._is_timed = sweep is not None or any(
            source.sweep is not None or _apart_ns(stamps, source.lidar.scans.stamps_ns) > _SYNCHRONOUS_NS
            for source in self._sources
        )
        for source in self._sources:
            self._describe(source)
        if sweep is None and whole.motion_compensated is not True and any(s.sweep is not None for s in self._sources):
            self.problems.append(
                "the leading LiDAR has no per-point times: its points are taken to be of their scan's stamp"
            )

    def scan(self, index: int) -> Scan:
        """Read scan `index` of the leading LiDAR and the points of the others that belong to it.

        Raises InputError when it is unreadable.
        """
        scan = self.whole.scan(index)
        times = np.zeros(len(scan), np.float32) if scan.times is None and self._is_timed else scan.times
        parts = [replace(scan, times=times, lidars=np.zeros(len(scan), np.uint8))]
        for number, source in enumerate(self._sources, 1):
            parts += self._parts(source, index, scan.stamp_ns, number)
        return _join(scan, parts, self._is_timed)

    def with_rings(self, choice: str, is_strict: bool = True) -> Sequence:
        """The merged sequence with the rings of each LiDAR found separately; is_strict : as of `RingView`."""
        others = [replace(other, scans=with_rings(other.scans, choice, is_strict)) for other in self.further_lidars]
        return MergedLidars(with_rings(self.whole, choice, is_strict), others)

    def _parts(self, source: _Reading, index: int, stamp_ns: int, number: int) -> Iterator[Scan]:
        """The points of the `number`-th further LiDAR during sweep `index`, a part of each of its scans that overlaps."""
        begin, end = int(self._edges[index]), int(self._edges[index + 1])
        end = min(end, begin + round(_LONGEST_SWEEP * self._period_ns))
        first, last = int(np.searchsorted(source.ends, begin)), int(np.searchsorted(source.begins, end))
        cache = source.cache
        source.cache = cache = {k: cache[k] if k in cache else _read(source.lidar, k) for k in range(first, last)}
        for scan in cache.values():
            if scan is None or not len(scan):
                continue
            at_ns = np.full(len(scan), scan.stamp_ns)
            which = _is_far(scan.points)
            if source.sweep is not None:
                if scan.times is not None:
                    at_ns += np.round(scan.times.astype(np.float64) * 1e9).astype(np.int64)
                which &= (at_ns >= begin) & (at_ns < end)
            if which.any():
                yield _transform(scan, which, at_ns, stamp_ns, source.lidar.T_lidar_other, number)

    def _describe(self, source: _Reading) -> None:
        """Add how a further LiDAR is used to notes and problems; raise InputError when none of its scans falls into a sweep."""
        name, scans = source.lidar.name, source.lidar.scans
        self.notes += [f"{name}: {note}" for note in scans.notes]
        self.problems += [f"{name}: {problem}" for problem in scans.problems]
        inside = (source.ends >= self._edges[0]) & (source.begins < self._edges[-1])
        if not inside.any():
            raise InputError(
                f"{self.path}: the scans of {name} share no time with those of the leading LiDAR: they cannot be merged"
            )
        x, y, z = source.lidar.T_lidar_other[:3, 3]
        self.notes.append(
            f"merged: {int(inside.sum())} of {len(scans)} scans of {name}, at ({x:.3f}, {y:.3f}, {z:.3f}) m in the frame of the "
            f"leading LiDAR, {source.lidar.source}"
        )
        if source.sweep is None and scans.motion_compensated is not True:
            self.problems.append(f"{name}: no per-point times: its points are taken to be of their scan's stamp")


def _source(lidar: FurtherLidar, middle_ns: int) -> _Reading:
    """A further LiDAR with begin and end, ns, of each of its scans.

    middle_ns : added to the stamps of scans without times: from a stamp of the leading LiDAR to the begin of its sweep, and
        half a sweep more, so that they fall into the sweep whose stamp is nearest
    """
    sweep, stamps = _sweep_of(lidar.scans), lidar.scans.stamps_ns
    if sweep is None:
        return _Reading(lidar, None, stamps + middle_ns, stamps + middle_ns, {})
    spare = _period_ns(lidar.scans) // 2
    begins, ends = stamps + round(sweep.begin_s * 1e9) - spare, stamps + round(sweep.end_s * 1e9) + spare
    return _Reading(lidar, sweep, begins, ends, {})


def _sweep_of(sequence: Sequence) -> Span | None:
    """When sweeps begin and end, from the first scans that have points, None when these have no times."""
    first = readable(range(min(len(sequence), _LOOKED_AT)), sequence.scan)
    spans = [scan.span for _, scan in first if scan.times is not None]
    return Span(*np.median(spans, axis=0).tolist()) if spans else None


def _period_ns(sequence: Sequence) -> int:
    """Median time between scans, ns."""
    steps = np.diff(sequence.stamps_ns)
    return round(float(np.median(steps))) if len(steps) else round(1e9 / sequence.rate_hz)


def _apart_ns(stamps: Longs, others: Longs) -> float:
    """Median distance from stamps (M,) to the nearest of `others` (N,), ns."""
    nearest = np.interp(stamps, others, np.arange(len(others))).round().astype(int)
    return float(np.median(np.abs(stamps - others[nearest])))


def _read(lidar: FurtherLidar, index: int) -> Scan | None:
    """Read a scan; None, with a warning, when it cannot be read: the sweep then has the points of the other LiDARs only."""
    try:
        return lidar.scans.scan(index)
    except InputError as error:
        log.warning("%s: left out of the sweeps: %s", lidar.name, error)
        return None


def _is_far(points: NDArray[np.float32]) -> Bools:
    """Mask of the points (N, 3) that are finite and beyond the sensor and what carries it.

    Points (0, 0, 0), which are no returns, would become valid ones in another frame.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        squared = points[:, 0] ** 2 + points[:, 1] ** 2 + points[:, 2] ** 2
        return np.asarray((squared >= np.float32(_NEAREST_M**2)) & np.isfinite(squared))


def _transform(scan: Scan, which: Bools, at_ns: Longs, stamp_ns: int, T: Floats, number: int) -> Scan:
    """The points of `which` (N,), of the `number`-th further LiDAR, in the frame of the leading one by T (4, 4).

    at_ns : (N,) times of the points; stamp_ns : stamp of the merged scan, from which its times count
    """
    from lslam.core.kernels.transform import transform

    part = scan.select(which)
    points = np.empty_like(part.points)
    transform(np.ascontiguousarray(part.points), T, points)
    times = ((at_ns[which] - stamp_ns) * 1e-9).astype(np.float32)
    rings = part.rings
    if rings is not None:
        rings = np.where(rings == NO_RING, NO_RING, rings + np.uint16(number * RINGS_APART)).astype(np.uint16)
    return replace(part, points=points, times=times, rings=rings, lidars=np.full(len(part), number, np.uint8))


def _join(scan: Scan, parts: list[Scan], has_times: bool) -> Scan:
    """One scan of all points; a field that one of the LiDARs lacks is left out."""
    full = [part for part in parts if len(part)]
    if not full:
        return scan

    def column(name: str) -> NDArray[Any] | None:
        columns = [getattr(part, name) for part in full]
        return None if any(values is None for values in columns) else np.concatenate(columns)

    return replace(
        scan,
        points=np.concatenate([part.points for part in full]),
        intensity=column("intensity"),
        rings=column("rings"),
        labels=column("labels"),
        times=column("times") if has_times else None,
        lidars=column("lidars"),
        fault="; ".join(filter(None, dict.fromkeys(part.fault for part in full))),
    )
