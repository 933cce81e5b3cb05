"""Facts and faults of a sequence, in numbers, for `lslam info`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Longs
from lslam.core.config.input import PreprocessConfig
from lslam.core.errors import InputError, LslamError
from lslam.core.printable import count_of
from lslam.core.types.scan import FARTHEST_M, NO_RING, Scan, Span
from lslam.core.types.sequence import Sequence
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats.bag_files import Bag, BagTopic, open_bag
from lslam.io.formats.text_tables import utc_of
from lslam.io.readers import bag as bag_reader
from lslam.io.readers import find_folder
from lslam.odometry.frontend.point_times import with_point_times
from lslam.odometry.integrity.pair_registration import EMPTIED_SHARE, empty_share, filled_directions
from lslam.pipeline.doctor import Facts, Finding, Findings
from lslam.pipeline.doctor.examine_cameras import examine_cameras
from lslam.pipeline.doctor.examine_imu import examine_imu
from lslam.pipeline.doctor.examine_positions import examine_gaps, examine_gnss, examine_jumps, examine_units
from lslam.pipeline.doctor.examine_turns import examine_turns
from lslam.registration.preprocessing.rings import RingRule
from lslam.registration.preprocessing.views import with_rings

# A sweep lasts one period; drivers that cut it elsewhere stay well within these.
_SWEEP = (0.2, 1.6)
# A tenth of a sweep past the stamp is no other sweep.
_BESIDE = 0.1


def examine_bag(bag: Bag, uses: Mapping[str, str]) -> Facts:
    """JSON-ready facts about a bag; times are those of recording.

    uses : purpose of each topic in use; `remarks` are sentences about files that were left out, lost or unpacked

    A rate, Hz, is by the time from the first to the last message, None below two messages.
    """
    spans = [span for topic in bag.topics if (span := _span(bag, topic)) is not None]
    begin = min((first for first, _ in spans), default=None)
    end = max((last for _, last in spans), default=None)
    began = None if begin is None else utc_of(np.array([begin], np.int64))
    return {
        "files": [str(file) for file in bag.files],
        "remarks": [*bag.notes, *bag.losses],
        "size_bytes": sum(file.stat().st_size for file in bag.files),
        "start_ns": begin,
        "start_utc": began[0].isoformat() if began else None,
        "duration_s": None if begin is None or end is None else (end - begin) * 1e-9,
        "messages": sum(len(topic) for topic in bag.topics),
        "topics": [
            {
                "name": topic.name,
                "type": topic.type,
                "messages": len(topic),
                "rate_hz": _rate(bag, topic),
                "used_for": uses.get(topic.name) if len(topic) else None,
            }
            for topic in bag.topics
        ],
    }


def bag_at(name_or_path: str, data_root: Path | None) -> Facts | None:
    """Facts about the bag of this name or path; None where there is none that can be opened."""
    try:
        path = find_folder(name_or_path, data_root)
        return None if bag_reader.locate(path) is None else examine_bag(open_bag(path), {})
    except (LslamError, OSError):
        return None


def _span(bag: Bag, topic: BagTopic) -> tuple[int, int] | None:
    """Earliest and latest time of recording of a topic, ns; None without messages."""
    stamps = topic.stamps_ns.tolist()
    return (min(stamps), max(stamps)) if stamps else None


def _rate(bag: Bag, topic: BagTopic) -> float | None:
    """Messages per second of a topic; None below two messages."""
    span = _span(bag, topic)
    if span is None or span[0] == span[1]:
        return None
    return (len(topic) - 1) / ((span[1] - span[0]) * 1e-9)


SCHEMA = 2
# What a stamp in the wrong unit brings about is no finding of its own.
_FOLLOWS = {
    "scan-unit": {"imu-apart", "gnss-apart", "point-times", "no-point-times", "truth-gaps"},
    "imu-unit": {"imu-rate", "imu-gaps", "imu-apart", "imu-accel-unit"},
    "gnss-unit": {"gnss-apart", "gnss-jumps"},
    "point-unit": {"point-times"},
    "truth-unit": {"truth-gaps"},
}


def inspect(
    sequence: Sequence,
    samples: int | None = 50,
    is_quick: bool = False,
    with_cameras: bool = False,
    on_start: Callable[[str, int], None] = lambda stage, total: None,
    on_step: Callable[[], None] = lambda: None,
) -> Facts:
    """JSON-ready facts about `sequence`; point statistics come from `samples` scans spread evenly, all when None.

    `findings` are the faults: `code`, `what`, `way_out`; `problems` the same as sentences. Unreadable scans are
    among them. With `is_quick` no scan is registered, so the IMU's clock and axes are not compared with the scans, and
    no clock of points without times is sought. With `with_cameras` cameras are checked against the scans, which are registered
    for it; raises InputError where there is none.
    on_start(stage, number of its scans, 0 without any), then on_step() per scan
    """
    findings = Findings(Finding("recording", sentence) for sentence in sequence.problems)
    n = len(sequence)
    count = n if samples is None else min(n, samples)
    indices = np.unique(np.linspace(0, n - 1, count).round().astype(int)) if n else np.zeros(0, int)
    time = examine_stamps(sequence, findings)
    on_start("point times", 0)
    recording = with_point_times(sequence, PreprocessConfig(), is_stated_only=is_quick)
    notes = list(recording.notes)
    on_start("points", len(indices))
    points = examine_points(recording, indices, findings, on_step)
    on_start("sensors", 0)
    examine_times(recording, points, findings)
    rule, sentence = rings_rule(sequence)
    if sentence:
        notes.append(sentence)
    limits = points["per_point_times"]
    choice = getattr(recording, "clock_choice", None)
    if is_quick and limits is None and choice is None and not recording.motion_compensated:
        notes.append(
            "point times: no field has them; whether the order of the points tells them is not looked into, because that "
            "takes registrations"
        )
    units = Findings()
    examine_units(sequence, units, sequence.ground_truth, sweep=None if limits is None else Span(*limits))
    findings += units
    imu = examine_imu(sequence, findings)
    is_clock_wrong = any(f.code in ("scan-unit", "imu-unit") for f in units)
    turns = None if imu is None or is_quick or is_clock_wrong else examine_turns(sequence, findings)
    if turns is not None and not turns["is_judged"]:
        notes.append("IMU: the sensor hardly turns in the first scans, so its clock and axes could not be checked")
    cameras = examine_cameras(recording, findings) if with_cameras else None
    gnss = examine_gnss(sequence, findings)
    examine_gaps(sequence, findings)
    examine_jumps(sequence.ground_truth, findings)
    bag: Bag | None = getattr(sequence, "bag", None)
    follows = set().union(*(_FOLLOWS.get(f.code, set()) for f in units))
    findings = Findings(f for f in findings if f.code not in follows)
    return {
        "schema": SCHEMA,
        "name": sequence.name,
        "path": str(sequence.path),
        "format": sequence.kind,
        "sensor": getattr(sequence, "sensor", None),
        "bag": None if bag is None else examine_bag(bag, getattr(sequence, "uses", {})),
        "scans": n,
        "time": time,
        "points": points,
        "point_times": None if choice is None else choice.facts(),
        "rings_rule": rule,
        "motion_compensated": recording.motion_compensated,
        "vertical_correction_deg": float(getattr(sequence, "correction_deg", 0.0)),
        "extrinsics": {
            key: None if T is None else np.asarray(T).tolist() for key, T in sequence.calibration.extrinsics.items()
        },
        "imu": None if imu is None else {**imu, "turns": turns},
        **({} if cameras is None else {"cameras": cameras}),
        "gnss": gnss,
        "ground_truth": _ground_truth(sequence.ground_truth, sequence.stamps_ns),
        "notes": notes,
        "findings": [asdict(finding) for finding in findings],
        "problems": [str(finding) for finding in findings],
    }


def _ground_truth(truth: Trajectory | None, stamps_ns: Longs) -> Facts | None:
    """Facts of the ground truth: numbers of poses, frame, path length and extent, m, during the scans; None without it."""
    if truth is None or not len(truth):
        return None
    inside = (truth.stamps_ns >= stamps_ns[0]) & (truth.stamps_ns <= stamps_ns[-1])
    part = truth.select(inside)
    positions = part.positions
    extent = np.ptp(positions, axis=0).tolist() if len(part) else [0.0, 0.0, 0.0]
    return {
        "poses": len(truth),
        "poses_during_scans": len(part),
        "frame": truth.frame,
        "source": truth.source,
        "path_length_m": float(part.path_lengths[-1]) if len(part) else 0.0,
        "extent_m": [float(v) for v in extent],
    }


def examine_stamps(sequence: Sequence, findings: Findings) -> Facts:
    """Check rate and gaps of the scans. Stamps that went back have been replaced, and reported, by the reader."""
    stamps = sequence.stamps_ns
    steps = np.diff(stamps) * 1e-9
    median = float(np.median(steps)) if len(steps) else 0.0
    gaps = np.flatnonzero(steps > 1.5 * median) if median > 0 else np.zeros(0, int)
    if len(gaps):
        worst = int(gaps[np.argmax(steps[gaps])])
        findings.add(
            "scan-gaps",
            f"{count_of(len(gaps), 'gap')} in the scans, the longest {steps[worst]:.3f} s after scan {worst}",
            "the motion prior bridges short ones; run the parts apart with --start and --count where it does not",
        )
    return {
        "start_ns": int(stamps[0]) if len(stamps) else None,
        "end_ns": int(stamps[-1]) if len(stamps) else None,
        "duration_s": float((stamps[-1] - stamps[0]) * 1e-9) if len(stamps) else 0.0,
        "rate_hz": float(sequence.rate_hz),
        "period_s": {"min": float(steps.min()), "median": median, "max": float(steps.max())} if len(steps) else None,
        "gaps": [{"after_scan": int(k), "seconds": float(steps[k])} for k in gaps],
    }


def examine_points(
    sequence: Sequence, indices: NDArray[Any], findings: Findings, on_step: Callable[[], None] = lambda: None
) -> Facts:
    """Statistics over the scans `indices`, `on_step` after each. Unreadable ones are counted, a finding names the first."""
    scans: list[Facts] = []
    unreadable: list[str] = []
    for index in indices:
        try:
            scans.append(_scan_facts(sequence.scan(int(index))))
        except InputError as error:
            unreadable.append(str(error))
        on_step()
    findings += [Finding("scan-unreadable", f"scan cannot be read: {sentence}") for sentence in unreadable[:3]]
    if len(unreadable) > 3:
        more = f"{len(unreadable) - 3} more of the {len(indices)} scans looked at cannot be read"
        findings.add("scan-unreadable", more)
    empty = sum(1 for s in scans if s["count"] == 0)
    if empty:
        what = f"{empty} of the {len(indices)} scans looked at hold no points"
        findings.add("scan-empty", what, "a run skips them and bridges the motion")
    faulty = [s for s in scans if s["fault"]]
    if faulty:
        what = f"in {len(faulty)} of the {len(indices)} scans looked at not all is right; scan {faulty[0]['index']}"
        findings.add("scan-faults", f"{what}: {faulty[0]['fault']}", "a run uses the rest of these scans")
    full = [s for s in scans if s["count"]]
    far = [s for s in full if s["far"]]
    if far:
        what = (
            f"{sum(s['far'] for s in far)} points of {len(far)} of the {len(indices)} scans looked at lie beyond "
            f"{FARTHEST_M / 1e3:g} km, where no LiDAR sees"
        )
        findings.add("points-far", what, "a run leaves them out; check the type and unit of x, y, z")
    _examine_frame([s["directions"] for s in full if s["valid"]], findings)
    total = sum(s["count"] for s in full)
    measured = [s for s in full if s["valid"]]
    return {
        "scans_read": len(scans),
        "scans_unreadable": len(unreadable),
        "scans_empty": empty,
        "count": _range([s["count"] for s in scans]),
        "range_m": _ranges(measured),
        "share_nan": sum(s["nan"] for s in full) / total if total else 0.0,
        "share_zero": sum(s["zero"] for s in full) / total if total else 0.0,
        "elevation_deg": [min(s["low"] for s in measured), max(s["high"] for s in measured)] if measured else None,
        "intensity": _limits([s["intensity"] for s in full]),
        "per_point_times": _limits([s["times"] for s in full]),
        "rings": _limits([s["rings"] for s in full]),
    }


def _examine_frame(directions: list[Longs], findings: Findings) -> None:
    """Finding if many directions with points in the first scan have none later: the clouds seem to be in a world's frame."""
    shares = [empty_share(directions[0], later) for later in directions[1:]]
    if len(shares) > 1 and np.median(shares) > EMPTIED_SHARE:
        findings.add(
            "points-frame",
            f"{100 * np.median(shares):.0f} % of the directions that hold points in the first scan hold none in others",
            "the clouds seem to be in the frame of a world, where a run finds no motion: give them in the sensor's",
        )


def examine_times(sequence: Sequence, points: Facts, findings: Findings) -> None:
    """Check whether scans can be deskewed, and whether per-point times fill a sweep."""
    limits = points["per_point_times"]
    if limits is None:
        if sequence.motion_compensated is not True:
            findings.add(
                "no-point-times",
                "no per-point times and not known to be motion compensated",
                "scans cannot be deskewed (state motion_compensated, or per_point, in sequence.toml)",
            )
        return
    sweeps = (limits[1] - limits[0]) * sequence.rate_hz
    is_about_stamp = limits[0] * sequence.rate_hz < _BESIDE and limits[1] * sequence.rate_hz > -_BESIDE
    if not is_about_stamp or not _SWEEP[0] <= sweeps <= _SWEEP[1]:
        findings.add(
            "point-times",
            f"per-point times run from {limits[0]:.6g} to {limits[1]:.6g} s, {sweeps:.2g} sweeps at "
            f"{sequence.rate_hz:g} Hz",
            "they should be s from the scan's stamp and fill one sweep that holds it; state point_time_unit or rate_hz in "
            "sequence.toml",
        )


def rings_rule(sequence: Sequence) -> tuple[str | None, str]:
    """Source of rings for methods that need them, and a sentence; None without one."""
    try:
        ringed = with_rings(sequence)
    except InputError as error:
        return None, f"no rings, which loam and lego-loam need (loam-livox does not), can be found: {error}"
    rule: RingRule | None = getattr(ringed, "rule", None)
    return (None, "") if rule is None else (rule.kind, str(rule))


def _scan_facts(scan: Scan) -> Facts:
    """Facts of one scan: counts of points and faulty ones, quantiles of range (m) and elevation (deg), ranges of its fields."""
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


def _range(values: list[int]) -> Facts | None:
    """Minimum, median and maximum; None without values."""
    return {"min": min(values), "median": float(np.median(values)), "max": max(values)} if values else None


def _ranges(scans: list[Facts]) -> Facts | None:
    """Quantiles of range, m: of each scan, and of these the median, with the extremes of all."""
    if not scans:
        return None
    table = np.array([s["ranges"] for s in scans])
    p5, median, p95 = (float(v) for v in np.median(table[:, 1:4], axis=0))
    return {"min": float(table[:, 0].min()), "p5": p5, "median": median, "p95": p95, "max": float(table[:, 4].max())}


def _limits(pairs: list[list[float] | None]) -> list[float] | None:
    """Smallest and largest value over scans; None when at least half of them lack the field."""
    known = [p for p in pairs if p is not None]
    if 2 * len(known) <= len(pairs):
        return None
    return [min(p[0] for p in known), max(p[1] for p in known)]
