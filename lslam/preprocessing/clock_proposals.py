"""Which clocks the order of the points allows for: proposals, which the agreement of scans has to confirm."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lslam.preprocessing.firing_order import follow_rings, follow_sweep
from lslam.preprocessing.rings import organised_rows, ring_seam
from lslam.preprocessing.sweep_clock import SweepClock, azimuths
from lslam.types.scan import Scan

Floats = NDArray[np.float64]

# Share of the azimuths that the points of a sensor that turns lie in, at least, in bins of ten degrees.
_COVERED, _BINS = 0.5, 36
# rad; the sweeps of a sensor begin at one azimuth when most of its scans begin within this of their middle.
_FIXED_RAD = np.radians(10.0)


@dataclass(frozen=True)
class Proposal:
    """A clock that runs forward; `is_guess` : neither its sense nor where it begins follows from the order of the points."""

    clock: SweepClock
    is_guess: bool = False


def propose_clock(scans: list[Scan], seconds: float, rows: int | None, is_stamp_at_end: bool) -> Proposal | None:
    """The clock that the points of some scans of a recording allow for; None where the sensor makes no full turns.

    seconds : length of a sweep, s; rows : of organised clouds, stored row after row, where that is stated
    """
    if not scans or _coverage(scans) < _COVERED:
        return None
    clock = SweepClock("azimuth", seconds, is_stamp_at_end, sense=1, begin_rad=-np.pi)
    is_columnwise = _organised(scans, rows)
    if is_columnwise is not None:
        count, columnwise = is_columnwise
        return Proposal(SweepClock("columns", seconds, is_stamp_at_end, count, columnwise))
    sweeps = [follow_sweep(scan.points) for scan in scans]
    followed = [sweep for sweep in sweeps if sweep is not None]
    if len(followed) > 0.8 * len(scans) and len({sweep.sense for sweep in followed}) == 1:
        begin = _common(np.array([sweep.begin_rad for sweep in followed]))
        return Proposal(SweepClock("order", seconds, is_stamp_at_end, sense=followed[0].sense, begin_rad=begin))
    return _by_rings(scans, clock) or Proposal(clock, is_guess=True)


def _by_rings(scans: list[Scan], clock: SweepClock) -> Proposal | None:
    """The azimuth from where rings begin; None where the points are not stored ring after ring."""
    rings = [follow_rings(scan.points) for scan in scans]
    known = [ring for ring in rings if ring is not None]
    if len(known) <= 0.8 * len(scans) or len({ring.sense for ring in known}) != 1:
        return None
    sense = known[0].sense
    begins = []
    for scan, ring in zip(scans, rings, strict=True):
        seam = ring_seam(scan.points)
        if seam is not None:
            begins.append(_first_azimuth(scan) + sense * seam)
        elif ring is not None:
            begins.append(ring.begin_rad)
    begin = _common(np.array(begins))
    if begin is None:
        return Proposal(replace(clock, sense=sense), is_guess=True)
    return Proposal(replace(clock, sense=sense, begin_rad=begin))


def _organised(scans: list[Scan], rows: int | None) -> tuple[int, bool] | None:
    """Rows of organised clouds and whether they are stored column after column; None for other clouds."""
    if rows:
        return (rows, False) if all(len(scan) % rows == 0 for scan in scans) else None
    rules = [organised_rows(scan) for scan in scans]
    first = rules[0]
    if first is None or any(
        rule is None or (rule.count, rule.columns) != (first.count, first.columns) for rule in rules
    ):
        return None
    return first.count, first.columns


def _coverage(scans: list[Scan]) -> float:
    """Share of the azimuths in which there are points."""
    angle = np.concatenate([azimuths(scan.points[(scan.points[:, :2] != 0).any(axis=1)]) for scan in scans])
    return float((np.histogram(angle, _BINS, (-np.pi, np.pi))[0] > 0).mean())


def _first_azimuth(scan: Scan) -> float:
    points = scan.points
    known = np.flatnonzero(np.isfinite(points).all(axis=1) & (points[:, :2] != 0).any(axis=1))
    return float(np.arctan2(points[known[0], 1], points[known[0], 0])) if len(known) else 0.0


def _common(angles: Floats) -> float | None:
    """The angle, rad, that most of `angles` (N,) lie near; None where they do not."""
    if not len(angles):
        return None
    apart = np.abs(np.remainder(angles[:, None] - angles + np.pi, 2 * np.pi) - np.pi) < _FIXED_RAD
    best = apart[np.argmax(apart.sum(axis=1))]
    if best.sum() < 0.5 * len(angles):
        return None
    return float(np.angle(np.exp(1j * angles[best]).mean()))
