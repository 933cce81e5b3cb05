"""What is in a sequence, in numbers, and what is wrong with it: the facts behind `lslam info`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np

from lslam.core.config.input import PreprocessConfig
from lslam.core.errors import LslamError
from lslam.core.types.arrays import Longs
from lslam.core.types.scan import Span
from lslam.core.types.sequence import Sequence
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats.bag_files import Bag, BagTopic, open_bag
from lslam.io.formats.text_tables import utc_of
from lslam.io.readers import bag as bag_reader
from lslam.io.readers.lookup import find_folder
from lslam.odometry.frontend.point_times import with_point_times
from lslam.pipeline.doctor import Facts, Finding
from lslam.pipeline.doctor.examine_imu import examine_imu
from lslam.pipeline.doctor.examine_positions import examine_gaps, examine_gnss, examine_jumps
from lslam.pipeline.doctor.examine_scans import examine_points, examine_stamps, examine_times, rings_rule
from lslam.pipeline.doctor.examine_turns import examine_turns
from lslam.pipeline.doctor.examine_units import examine_units


def examine_bag(bag: Bag, uses: Mapping[str, str]) -> Facts:
    """JSON-ready facts; times are those of recording.

    uses : what each topic that is used is used for; `remarks` are sentences about files that were left out, lost or unpacked

    A rate is that of the steps between the first and the last message, None below two.
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
    """What is in the bag of this name or path, where it is one that can be opened; None where it is none."""
    try:
        path = find_folder(name_or_path, data_root)
        return None if bag_reader.locate(path) is None else examine_bag(open_bag(path), {})
    except (LslamError, OSError):
        return None


def _span(bag: Bag, topic: BagTopic) -> tuple[int, int] | None:
    stamps = topic.stamps_ns.tolist()
    return (min(stamps), max(stamps)) if stamps else None


def _rate(bag: Bag, topic: BagTopic) -> float | None:
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


def inspect(sequence: Sequence, samples: int | None = 50, is_quick: bool = False) -> Facts:
    """JSON-ready facts about `sequence`; point statistics come from `samples` scans spread evenly, all when None.

    `findings` are what is wrong: `code`, `what`, `way_out`; `problems` the same as sentences. Scans that cannot be read are
    among them. With `is_quick` no scan is registered, so the IMU's clock and axes are not compared with the scans, and
    no clock of points without times is sought.
    """
    findings = [Finding("recording", sentence) for sentence in sequence.problems]
    n = len(sequence)
    wanted = n if samples is None else min(n, samples)
    indices = np.unique(np.linspace(0, n - 1, wanted).round().astype(int)) if n else np.zeros(0, int)
    time = examine_stamps(sequence, findings)
    clocked = with_point_times(sequence, PreprocessConfig(), is_stated_only=is_quick)
    notes = list(clocked.notes)
    points = examine_points(clocked, indices, findings)
    examine_times(clocked, points, findings)
    rule, sentence = rings_rule(sequence)
    if sentence:
        notes.append(sentence)
    limits = points["per_point_times"]
    choice = getattr(clocked, "clock_choice", None)
    if is_quick and limits is None and choice is None and not clocked.motion_compensated:
        notes.append(
            "point times: no field has them; whether the order of the points tells them is not looked into, because that "
            "takes registrations"
        )
    units = examine_units(sequence, sequence.ground_truth, sweep=None if limits is None else Span(*limits))
    findings += units
    imu = examine_imu(sequence, findings)
    is_clock_wrong = any(f.code in ("scan-unit", "imu-unit") for f in units)
    turns = None if imu is None or is_quick or is_clock_wrong else examine_turns(sequence, findings)
    if turns is not None and not turns["is_judged"]:
        notes.append("IMU: the sensor hardly turns in the first scans, so its clock and axes could not be checked")
    gnss = examine_gnss(sequence, findings)
    findings += [*examine_gaps(sequence), *examine_jumps(sequence.ground_truth)]
    bag: Bag | None = getattr(sequence, "bag", None)
    follows = set().union(*(_FOLLOWS.get(f.code, set()) for f in units))
    findings = [f for f in findings if f.code not in follows]
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
        "motion_compensated": clocked.motion_compensated,
        "vertical_correction_deg": float(getattr(sequence, "correction_deg", 0.0)),
        "extrinsics": {
            key: None if T is None else np.asarray(T).tolist() for key, T in vars(sequence.calibration).items()
        },
        "imu": None if imu is None else {**imu, "turns": turns},
        "gnss": gnss,
        "ground_truth": _ground_truth(sequence.ground_truth, sequence.stamps_ns),
        "notes": notes,
        "findings": [asdict(finding) for finding in findings],
        "problems": [str(finding) for finding in findings],
    }


def _ground_truth(truth: Trajectory | None, stamps_ns: Longs) -> Facts | None:
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
