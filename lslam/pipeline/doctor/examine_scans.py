"""The scans of a recording: their stamps, points, per-point times and rings."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.errors import InputError
from lslam.core.types.arrays import Longs
from lslam.core.types.scan import FARTHEST_M, NO_RING, Scan
from lslam.core.types.sequence import Sequence
from lslam.odometry.integrity.directions import MOST_EMPTIED, emptied, filled_directions
from lslam.pipeline.doctor import Facts, Finding, plural
from lslam.registration.preprocessing.rings import RingRule
from lslam.registration.preprocessing.views import with_rings

# A sweep lasts one period; drivers that cut it elsewhere stay well within these.
_SWEEP = (0.2, 1.6)
# A tenth of a sweep past the stamp is no other sweep.
_BESIDE = 0.1


def examine_stamps(sequence: Sequence, findings: list[Finding]) -> Facts:
    """Rate and gaps of the scans; stamps that go back were replaced by the reader, which said so."""
    stamps = sequence.stamps_ns
    steps = np.diff(stamps) * 1e-9
    median = float(np.median(steps)) if len(steps) else 0.0
    gaps = np.flatnonzero(steps > 1.5 * median) if median > 0 else np.zeros(0, int)
    if len(gaps):
        worst = int(gaps[np.argmax(steps[gaps])])
        findings.append(
            Finding(
                "scan-gaps",
                f"{plural(len(gaps), 'gap')} in the scans, the longest {steps[worst]:.3f} s after scan {worst}",
                "the motion prior bridges short ones; run the parts apart with --start and --count where it does not",
            )
        )
    return {
        "start_ns": int(stamps[0]) if len(stamps) else None,
        "end_ns": int(stamps[-1]) if len(stamps) else None,
        "duration_s": float((stamps[-1] - stamps[0]) * 1e-9) if len(stamps) else 0.0,
        "rate_hz": float(sequence.rate_hz),
        "period_s": {"min": float(steps.min()), "median": median, "max": float(steps.max())} if len(steps) else None,
        "gaps": [{"after_scan": int(k), "seconds": float(steps[k])} for k in gaps],
    }


def examine_points(sequence: Sequence, indices: NDArray[Any], findings: list[Finding]) -> Facts:
    """Statistics over the scans `indices`; those that cannot be read are counted, and the first of them named."""
    scans: list[Facts] = []
    unreadable: list[str] = []
    for index in indices:
        try:
            scans.append(_scan_facts(sequence.scan(int(index))))
        except InputError as error:
            unreadable.append(str(error))
    findings += [Finding("scan-unreadable", f"scan cannot be read: {sentence}") for sentence in unreadable[:3]]
    if len(unreadable) > 3:
        more = f"{len(unreadable) - 3} more of the {len(indices)} scans looked at cannot be read"
        findings.append(Finding("scan-unreadable", more))
    empty = sum(1 for s in scans if s["count"] == 0)
    if empty:
        what = f"{empty} of the {len(indices)} scans looked at hold no points"
        findings.append(Finding("scan-empty", what, "a run skips them and bridges the motion"))
    faulty = [s for s in scans if s["fault"]]
    if faulty:
        what = f"in {len(faulty)} of the {len(indices)} scans looked at not all is right; scan {faulty[0]['index']}"
        findings.append(Finding("scan-faults", f"{what}: {faulty[0]['fault']}", "a run uses the rest of these scans"))
    full = [s for s in scans if s["count"]]
    far = [s for s in full if s["far"]]
    if far:
        what = (
            f"{sum(s['far'] for s in far)} points of {len(far)} of the {len(indices)} scans looked at lie beyond "
            f"{FARTHEST_M / 1e3:g} km, where no LiDAR sees"
        )
        findings.append(Finding("points-far", what, "a run leaves them out; check the type and unit of x, y, z"))
    _examine_frame([s["directions"] for s in full if s["valid"]], findings)
    total = sum(s["count"] for s in full)
    measured = [s for s in full if s["valid"]]
    return {
        "scans_read": len(scans),
        "scans_unreadable": len(unreadable),
        "scans_empty": empty,
        "count": _spread([s["count"] for s in scans]),
        "range_m": _ranges(measured),
        "share_nan": sum(s["nan"] for s in full) / total if total else 0.0,
        "share_zero": sum(s["zero"] for s in full) / total if total else 0.0,
        "elevation_deg": [min(s["low"] for s in measured), max(s["high"] for s in measured)] if measured else None,
        "intensity": _limits([s["intensity"] for s in full]),
        "per_point_times": _limits([s["times"] for s in full]),
        "rings": _limits([s["rings"] for s in full]),
    }


def _examine_frame(directions: list[Longs], findings: list[Finding]) -> None:
    """Whether the scans are seen from their sensor, which sees something below it, or above, wherever it goes."""
    shares = [emptied(directions[0], later) for later in directions[1:]]
    if len(shares) > 1 and np.median(shares) > MOST_EMPTIED:
        findings.append(
            Finding(
                "points-frame",
                f"{100 * np.median(shares):.0f} % of the directions that hold points in the first scan hold none in others",
                "the clouds seem to be in the frame of a world, where a run finds no motion: give them in the sensor's",
            )
        )


def examine_times(sequence: Sequence, points: Facts, findings: list[Finding]) -> None:
    """Whether scans can be deskewed, and whether per-point times fill a sweep."""
    limits = points["per_point_times"]
    if limits is None:
        if sequence.motion_compensated is not True:
            findings.append(
                Finding(
                    "no-point-times",
                    "no per-point times and not known to be motion compensated",
                    "scans cannot be deskewed (state motion_compensated, or per_point, in sequence.toml)",
                )
            )
        return
    sweeps = (limits[1] - limits[0]) * sequence.rate_hz
    is_about_stamp = limits[0] * sequence.rate_hz < _BESIDE and limits[1] * sequence.rate_hz > -_BESIDE
    if not is_about_stamp or not _SWEEP[0] <= sweeps <= _SWEEP[1]:
        findings.append(
            Finding(
                "point-times",
                f"per-point times run from {limits[0]:.6g} to {limits[1]:.6g} s, {sweeps:.2g} sweeps at "
                f"{sequence.rate_hz:g} Hz",
                "they should be s from the scan's stamp and fill one sweep that holds it; state point_time_unit or rate_hz in "
                "sequence.toml",
            )
        )


def rings_rule(sequence: Sequence) -> tuple[str | None, str]:
    """How methods that need rings would find them, and a sentence; None where they could not."""
    try:
        ringed = with_rings(sequence)
    except InputError as error:
        return None, f"no rings, which loam and lego-loam need (loam-livox does not), can be found: {error}"
    rule: RingRule | None = getattr(ringed, "rule", None)
    return (None, "") if rule is None else (rule.kind, str(rule))


def _scan_facts(scan: Scan) -> Facts:
    points = scan.points
    finite = np.isfinite(points).all(axis=1)
    zero = (points == 0).all(axis=1)
    far = finite & (np.abs(points) >= FARTHEST_M).any(axis=1)
    good = points[finite & ~zero].astype(np.float64)
    ranges = np.linalg.norm(good, axis=1)
    elevation = np.degrees(np.arctan2(good[:, 2], np.hypot(good[:, 0], good[:, 1])))
    facts: Facts = {"count": len(scan), "valid": len(good), "nan": int((~finite).sum()), "zero": int(zero.sum())}
    facts |= {"far": int(far.sum()), "index": scan.index, "fault": scan.fault}
    if len(good):
        facts["directions"] = filled_directions(good.astype(np.float32))
        facts["ranges"] = [float(v) for v in np.percentile(ranges, [0, 5, 50, 95, 100])]
        # One per cent on either side: single points close by have wild elevations.
        facts["low"], facts["high"] = (float(v) for v in np.percentile(elevation, [1, 99]))
    for name, values in (("intensity", scan.intensity), ("times", scan.times), ("rings", scan.rings)):
        known = None if values is None else values[np.isfinite(values) & ((values != NO_RING) | (name != "rings"))]
        facts[name] = None if known is None or not len(known) else [float(known.min()), float(known.max())]
    return facts


def _spread(values: list[int]) -> Facts | None:
    return {"min": min(values), "median": float(np.median(values)), "max": max(values)} if values else None


def _ranges(scans: list[Facts]) -> Facts | None:
    if not scans:
        return None
    table = np.array([s["ranges"] for s in scans])
    p5, median, p95 = (float(v) for v in np.median(table[:, 1:4], axis=0))
    return {"min": float(table[:, 0].min()), "p5": p5, "median": median, "p95": p95, "max": float(table[:, 4].max())}


def _limits(pairs: list[list[float] | None]) -> list[float] | None:
    """Smallest and largest value over scans; None when half of them or more lack the field."""
    known = [p for p in pairs if p is not None]
    if 2 * len(known) <= len(pairs):
        return None
    return [min(p[0] for p in known), max(p[1] for p in known)]
