"""Per-point times of a sensor that turns, where its scans have no time field: by column, by order or by azimuth.

The order of the points, block by block or ring after ring, proposes clocks, which the agreement of scans has to confirm.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.types.scan import Scan
from lslam.registration.preprocessing.rings import organised_rows, ring_seam

_FULL = 2 * np.pi
# Blocks of a sweep, about a degree each, and points in a block of rings, at least.
_BLOCKS, _FEWEST = 360, 24
# Length of the mean of unit vectors to the points of a block: they lie within some 40 deg.
_NARROW = 0.85
# Net turn of the blocks over the sum of their steps: 0 for points in no order, 1 for an even turn.
_STRAIGHT = 0.6
# Turns of points in the order of firing; ring after ring they are as many as rings, with two returns one after the other two.
_SWEEP = (0.3, 1.3)
_RINGS = 1.6
# A step back by more is a step forward over a gap.
_GAP_RAD = np.radians(60.0)


@dataclass(frozen=True)
class FollowedSweep:
    """The azimuth along the order of the points of one sweep.

    sense : 1 counter-clockwise from above, -1 clockwise; begin_rad : azimuth of the first points
    turned_rad : (N,) angle from there to each point, by blocks of points, so that the offsets of lasers average out
    """

    sense: int
    begin_rad: float
    turned_rad: Floats


@dataclass(frozen=True)
class RingOrder:
    """Points that go round several times, ring after ring: the sense of each turn, and the azimuth of the first points, rad."""

    sense: int
    begin_rad: float


def follow_sweep(points: NDArray[Any]) -> FollowedSweep | None:
    """The sweep along the order of points (N, 3), m; None where their azimuth does not go round once in that order."""
    blocks = _Blocks.of(points, _BLOCKS)
    if blocks is None or not blocks.has_order or not _SWEEP[0] <= blocks.turns <= _SWEEP[1]:
        return None
    turn_rad = np.maximum.accumulate(blocks.turn_rad)
    # Block means lie in the middles of the blocks.
    slope = np.median(np.diff(turn_rad)) / np.median(np.diff(blocks.middles))
    at = np.arange(len(points), dtype=np.float64)
    along = np.interp(at, blocks.middles, turn_rad)
    along += slope * (np.minimum(at - blocks.middles[0], 0) + np.maximum(at - blocks.middles[-1], 0))
    return FollowedSweep(
        blocks.sense, float(blocks.angles[0] + blocks.sense * along[0]), np.asarray(along - along[0], np.float64)
    )


def follow_rings(points: NDArray[Any]) -> RingOrder | None:
    """The order of points (N, 3), m, that are stored ring after ring; None where they are not."""
    blocks = _Blocks.of(points, len(points) // _FEWEST)
    if blocks is None or not blocks.has_order or blocks.turns < _RINGS:
        return None
    return RingOrder(blocks.sense, float(blocks.angles[0]))


@dataclass(frozen=True)
class _Blocks:
    """Mean azimuths of blocks of points in their order.

    middles : (B,) index of the middle of each block; angles : (B,) rad; turn_rad : (B,) from the first block, in the sense
    """

    middles: Floats
    angles: Floats
    turn_rad: Floats
    sense: int
    has_order: bool

    @property
    def turns(self) -> float:
        """Whole turns from the first block to the last."""
        return float(self.turn_rad[-1]) / _FULL

    @classmethod
    def of(cls, points: NDArray[Any], count: int) -> _Blocks | None:
        """Blocks of equally many points (N, 3) that are finite and off the axis; None where they are too few."""
        x, y = points[:, 0].astype(np.float64), points[:, 1].astype(np.float64)
        flat = np.hypot(x, y)
        where = np.flatnonzero(np.isfinite(flat) & (flat > 0))
        count = min(count, len(where) // _FEWEST)
        if count < 16:
            return None
        starts = np.linspace(0, len(where), count, endpoint=False).astype(np.int64)
        sizes = np.diff(np.append(starts, len(where)))
        cosine, sine, middle = (
            np.add.reduceat(values[where], starts) / sizes
            for values in (_quotient(x, flat), _quotient(y, flat), np.arange(len(points), dtype=np.float64))
        )
        angles = np.arctan2(sine, cosine)
        steps = np.remainder(np.diff(angles) + np.pi, _FULL) - np.pi
        sense = 1 if steps.sum() >= 0 else -1
        steps = sense * steps
        steps[steps < -_GAP_RAD] += _FULL
        has_order = (
            float(np.median(np.hypot(cosine, sine))) > _NARROW
            and abs(float(steps.sum())) > _STRAIGHT * float(np.abs(steps).sum())
            and _is_even(steps)
        )
        return cls(middle, angles, np.concatenate([[0.0], np.cumsum(steps)]), sense, has_order)


def _is_even(steps: Floats) -> bool:
    """Whether most steps go forward."""
    return bool((steps > 0).mean() > _STRAIGHT)


def _quotient(values: Floats, by: Floats) -> Floats:
    """Quotient of values by the positive ones of `by`, elsewhere 0."""
    return np.divide(values, by, out=np.zeros_like(values), where=by > 0)


Kind = Literal["columns", "order", "azimuth"]

# Share of a turn by which the first point of a scan may lie before the azimuth at which sweeps begin.
_EARLY = 0.1
# rad; columns are even where nine in ten of the points lie so near to their azimuth, lasers being offset by some degrees.
_EVEN_RAD = np.radians(12.0)
# Points of a scan that tell whether its columns are even.
_LOOKED_AT = 4000


@dataclass(frozen=True)
class SweepClock:
    """When each point of a scan was measured, as a share of the sweep, 0 to 1, and the sweep's length.

    kind : columns: by the column of an organised cloud; order: by the azimuth that is followed along the order of the points,
        or by the index alone where `sense` is 0; azimuth: by the azimuth of each point
    seconds : length of a sweep, s; is_stamp_at_end : the stamp belongs to the sweep's end, not to its start
    rows, is_columnwise : of `columns`: number of rows, and whether points are stored column after column
    sense : 1 counter-clockwise from above, -1 clockwise; 0 unknown
    begin_rad : azimuth at which sweeps begin; None: each with its first point
    is_reversed : the shares run backwards; turn : share of a sweep that is added, modulo 1
    """

    kind: Kind
    seconds: float
    is_stamp_at_end: bool = False
    rows: int = 0
    is_columnwise: bool = False
    sense: int = 0
    begin_rad: float | None = None
    is_reversed: bool = False
    turn: float = 0.0

    def times_of(self, points: NDArray[Any]) -> tuple[NDArray[np.float32], str]:
        """Times (N,) float32, s from the stamp, of points (N, 3); and why another rule had to be used, else empty."""
        shares, why = self._shares(points)
        shares = 1 - shares if self.is_reversed else shares
        if self.turn:
            shares = np.mod(shares + self.turn, 1.0)
        begin_s = -self.seconds if self.is_stamp_at_end else 0.0
        return (begin_s + self.seconds * shares).astype(np.float32), why

    def _shares(self, points: NDArray[Any]) -> tuple[Floats, str]:
        """Share of the sweep (N,), 0 to 1, at each of points (N, 3); and why another rule had to be used, else empty."""
        n = len(points)
        if self.kind == "columns":
            why = f"{n} points are not {self.rows} rows of equal length"
            if n % self.rows == 0:
                index, columns = np.arange(n), n // self.rows
                shares = (index // self.rows if self.is_columnwise else index % columns) / columns
                if not self.sense or even_begin(points, shares, self.sense) is not None:
                    return shares, ""
                why = "its columns do not turn as those of the other scans"
            if self.begin_rad is None:
                return np.arange(n) / max(n, 1), f"{why}: the order of the points instead"
            return _share_of_turn(azimuths(points), self.begin_rad, self.sense), f"{why}: the azimuth of each instead"
        if self.kind == "azimuth":
            return _share_of_turn(azimuths(points), self.begin_rad or 0.0, self.sense), ""
        if not self.sense:
            return np.arange(n) / max(n, 1), ""
        sweep = follow_sweep(points)
        if sweep is None or sweep.sense != self.sense:
            why = "its points are not in the order of those of the other scans"
            if self.begin_rad is None:
                return np.arange(n) / max(n, 1), f"{why}: their index instead"
            return _share_of_turn(azimuths(points), self.begin_rad, self.sense), f"{why}: the azimuth of each instead"
        late = 0.0
        if self.begin_rad is not None:
            late = float(_share_of_turn(np.array([sweep.begin_rad]), self.begin_rad, self.sense)[0])
            late = late - 1 if late > 1 - _EARLY else late
        return late + sweep.turned_rad / _FULL, ""

    def facts(self) -> dict[str, Any]:
        """The clock as plain values, for a manifest."""
        return asdict(self)

    def __str__(self) -> str:
        how = {
            "columns": f"the columns of clouds of {self.rows} rows",
            "order": "the order of the points",
            "azimuth": "the azimuth of the points",
        }[self.kind]
        details = []
        if self.sense:
            sense = self.sense * (-1 if self.is_reversed else 1)
            details.append("counter-clockwise" if sense > 0 else "clockwise")
            begin = self.begin_deg
            details.append("each from its first point" if begin is None else f"from azimuth {round(begin)} deg")
        elif self.is_reversed:
            details.append("backwards")
        instant = "end" if self.is_stamp_at_end else "start"
        details.append(f"{self.seconds:.3g} s a sweep, stamped at its {instant}")
        return f"{how}, {', '.join(details)}"

    @property
    def begin_deg(self) -> float | None:
        """Azimuth of the first point of a sweep, deg from -180 to 180; None where none is fixed."""
        if self.begin_rad is None:
            return None
        share = -self.turn if not self.is_reversed else self.turn
        angle = self.begin_rad + self.sense * _FULL * share
        return float(np.degrees(np.remainder(angle + np.pi, _FULL) - np.pi))


def azimuths(points: NDArray[Any]) -> Floats:
    """(N,) rad, counter-clockwise from x; 0 for points that are not finite."""
    angle = np.arctan2(points[:, 1], points[:, 0]).astype(np.float64)
    return np.where(np.isfinite(angle), angle, 0.0)


def even_begin(points: NDArray[Any], shares: Floats, sense: int) -> float | None:
    """Azimuth, rad, of share 0, if points (N, 3) turn in this sense in proportion to `shares` (N,) of the sweep; else None.

    0 where no point is usable. sense : 1 counter-clockwise, -1 clockwise
    """
    step = len(points) // _LOOKED_AT | 1  # odd: rows are even in number
    points, shares = points[::step], shares[::step]
    is_used = np.isfinite(points).all(axis=1) & (points[:, :2] != 0).any(axis=1)
    if not is_used.any():
        return 0.0
    apart = np.exp(1j * (azimuths(points[is_used]) - sense * _FULL * shares[is_used]))
    middle = apart.mean()
    off = np.abs(np.angle(apart * np.conj(middle)))
    return float(np.angle(middle)) if np.percentile(off, 90) < _EVEN_RAD else None


def _share_of_turn(angle: Floats, begin_rad: float, sense: int) -> Floats:
    """Shares of a turn (N,), 0 to 1, from `begin_rad` to each angle (N,), rad; sense : 1 counter-clockwise, -1 clockwise."""
    return np.asarray(np.mod((angle - begin_rad) * (sense / _FULL), 1.0))


def is_same_motion(first: SweepClock, second: SweepClock, points: NDArray[Any]) -> bool:
    """Whether two clocks give nearly all points (N, 3) times that differ by one constant: deskewing cannot tell them apart."""
    apart = first.times_of(points)[0] - second.times_of(points)[0]
    return float((np.abs(apart - np.median(apart)) > _APART * first.seconds).mean()) < _FEW


# Share of a sweep by which times must differ, and of the points for which they must.
_APART, _FEW = 0.1, 0.04


# Share of the azimuths that the points of a sensor that turns lie in, at least, in bins of ten degrees.
_COVERED, _BINS = 0.5, 36
# rad; the sweeps of a sensor begin at one azimuth when most of its scans begin within this of their middle.
_FIXED_RAD = np.radians(10.0)
# Share of the scans that must have the same order.
_MOST = 0.8


@dataclass(frozen=True)
class Proposal:
    """A clock that runs forward; `is_guess` : its sense, or where it begins, does not follow from the order of the points."""

    clock: SweepClock
    is_guess: bool = False


def propose_clock(scans: list[Scan], nominal: SweepClock, rows: int | None) -> Proposal | None:
    """The clock that the points of some scans of a recording allow for; None where the sensor makes no full turns.

    nominal : length and stamp of a sweep; rows : of organised clouds, stored row after row, where that is stated
    """
    if not scans or _coverage(scans) < _COVERED:
        return None
    clock = columns_clock(scans, nominal, rows) or order_clock(scans, nominal)
    return azimuth_proposal(scans, nominal) if clock is None else Proposal(clock)


def columns_clock(scans: list[Scan], nominal: SweepClock, rows: int | None) -> SweepClock | None:
    """The columns of organised clouds that turn evenly; None for other clouds."""
    if rows:
        layouts = {(rows, False) if len(scan) % rows == 0 else None for scan in scans}
    else:
        layouts = {None if rule is None else (rule.count, rule.columns) for rule in map(organised_rows, scans)}
    layout = layouts.pop() if len(layouts) == 1 else None
    if layout is None:
        return None
    clock = replace(nominal, kind="columns", rows=layout[0], is_columnwise=layout[1])
    shares = [
        (clock.times_of(scan.points)[0] / clock.seconds + clock.is_stamp_at_end).astype(np.float64) for scan in scans
    ]
    for sense in (-1, 1):
        begins = [even_begin(scan.points, share, sense) for scan, share in zip(scans, shares, strict=True)]
        if None not in begins:
            return replace(clock, sense=sense, begin_rad=_common(np.array(begins)))
    return None


def order_clock(scans: list[Scan], nominal: SweepClock) -> SweepClock | None:
    """The order of points that go round once in it, as they were fired; None for other orders."""
    sweeps = [sweep for sweep in (follow_sweep(scan.points) for scan in scans) if sweep is not None]
    if len(sweeps) <= _MOST * len(scans) or len({sweep.sense for sweep in sweeps}) != 1:
        return None
    begin = _common(np.array([sweep.begin_rad for sweep in sweeps]))
    return replace(nominal, kind="order", sense=sweeps[0].sense, begin_rad=begin)


def azimuth_proposal(scans: list[Scan], nominal: SweepClock) -> Proposal:
    """A clock by the azimuth of each point; the order of the points gives the sense and the begin of sweeps if it can.

    Otherwise the proposal is a guess: counter-clockwise, from -x.
    """
    guess = replace(nominal, kind="azimuth", sense=1, begin_rad=-np.pi)
    by_order = order_clock(scans, nominal)
    if by_order is not None and by_order.begin_rad is not None:
        return Proposal(replace(by_order, kind="azimuth"))
    rings = [follow_rings(scan.points) for scan in scans]
    senses = {ring.sense for ring in rings if ring is not None}
    if sum(ring is not None for ring in rings) <= _MOST * len(scans) or len(senses) != 1:
        return Proposal(guess, is_guess=True)
    sense = senses.pop()
    begins = []
    for scan, ring in zip(scans, rings, strict=True):
        seam = ring_seam(scan.points)
        if seam is not None:
            begins.append(_first_azimuth(scan) + sense * seam)
        elif ring is not None:
            begins.append(ring.begin_rad)
    begin = _common(np.array(begins))
    return Proposal(replace(guess, sense=sense, begin_rad=-np.pi if begin is None else begin), is_guess=begin is None)


def _coverage(scans: list[Scan]) -> float:
    """Share of the azimuths in which there are points."""
    angle = np.concatenate([azimuths(scan.points[(scan.points[:, :2] != 0).any(axis=1)]) for scan in scans])
    return float((np.histogram(angle, _BINS, (-np.pi, np.pi))[0] > 0).mean())


def _first_azimuth(scan: Scan) -> float:
    """Azimuth, rad, of the first usable point of a scan; 0 without one."""
    points = scan.points
    usable = np.flatnonzero(np.isfinite(points).all(axis=1) & (points[:, :2] != 0).any(axis=1))
    return float(azimuths(points[usable[:1]])[0]) if len(usable) else 0.0


def _common(angles: Floats) -> float | None:
    """The angle, rad, that most of `angles` (N,) lie near; None where they do not."""
    if not len(angles):
        return None
    apart = np.abs(np.remainder(angles[:, None] - angles + np.pi, 2 * np.pi) - np.pi) < _FIXED_RAD
    best = apart[np.argmax(apart.sum(axis=1))]
    if best.sum() < 0.5 * len(angles):
        return None
    return float(np.angle(np.exp(1j * angles[best]).mean()))
