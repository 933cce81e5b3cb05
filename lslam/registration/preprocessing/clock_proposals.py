"""Which clocks the order of the points allows for: proposals, which the agreement of scans has to confirm."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lslam.core.types.arrays import Floats
from lslam.core.types.scan import Scan
from lslam.registration.preprocessing.firing_order import follow_rings, follow_sweep
from lslam.registration.preprocessing.rings import organised_rows, ring_seam
from lslam.registration.preprocessing.sweep_clock import SweepClock, azimuths, even_begin

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
    """The azimuth, its sense and where sweeps begin by the order of the points as far as that tells them."""
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
