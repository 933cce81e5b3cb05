"""What a person knows of a recording, as the back end takes it: resolved to scans and keyframes."""

from __future__ import annotations

from collections.abc import Sequence as Many
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lslam.backend.georeferencing import require_crs
from lslam.backend.manual_files import read_control_points, read_named_pairs
from lslam.config import Config
from lslam.errors import InputError
from lslam.geometry.se3 import poses_at
from lslam.maps.georeference import to_wgs84
from lslam.types.constraint import Instant, KnownPair, Manual, NamedPair
from lslam.types.scan_result import ScanResult
from lslam.types.sequence import Selection, Sequence
from lslam.types.trajectory import Keyframe

# Beyond the first and the last scan a control point's stamp is that of a pose only as far as seconds are rounded.
ROUNDING_NS = 5_000_000


@dataclass(frozen=True)
class KeyframePairs:
    """Named pairs between keyframes, the older first."""

    known: list[KnownPair]
    forbidden: list[tuple[int, int]]
    problems: list[str] = field(default_factory=list)


def read_manual(config: Config, sequence: Sequence) -> Manual:
    """The files that `loops.file` and `graph.control` name; raises InputError, also for what the sequence does not have.

    Raises UsageError for coordinates that PROJ does not know.
    """
    pairs = read_named_pairs(Path(config.loops.file)) if config.loops.file else []
    points = read_control_points(Path(config.graph.control)) if config.graph.control else []
    numbers = sequence.indices if isinstance(sequence, Selection) else np.arange(len(sequence))
    period = int(1e9 / sequence.rate_hz) if sequence.rate_hz > 0 else 0
    ends = [(end, period) for pair in pairs for end in (pair.first, pair.second)]
    for instant, slack in (*ends, *((point.at, ROUNDING_NS) for point in points)):
        span = int(sequence.stamps_ns[0]) - slack, int(sequence.stamps_ns[-1]) + slack
        if instant.scan is not None and instant.scan not in numbers:
            raise InputError(
                f"{instant.said}: scan {instant.scan} is none of the run's, which are {numbers[0]} to {numbers[-1]}"
            )
        if instant.stamp_ns is not None and not span[0] <= instant.stamp_ns <= span[1]:
            raise InputError(
                f"{instant.said}: the stamp {1e-9 * instant.stamp_ns:.3f} s is none of the run's, which are "
                f"{1e-9 * span[0]:.3f} to {1e-9 * span[1]:.3f} s"
            )
    for point in points:
        require_crs(to_wgs84(point.position[None], point.epsg, point.height_epsg, config.gnss.geoid)[0], config.gnss)
    return Manual(tuple(pairs), tuple(points))


def stamp_of(instant: Instant, results: Many[ScanResult]) -> int:
    """ns; within those of the run."""
    stamps = {result.index: result.stamp_ns for result in results}
    stamp = stamps[instant.scan] if instant.scan is not None else instant.stamp_ns
    assert stamp is not None
    return int(np.clip(stamp, results[0].stamp_ns, results[-1].stamp_ns))


def keyframe_pairs(pairs: Many[NamedPair], results: Many[ScanResult], keyframes: Many[Keyframe]) -> KeyframePairs:
    """The pairs by their nearest keyframes; a sentence for each whose scans share one, which is no pair."""
    stamps = np.array([k.stamp_ns for k in keyframes])
    found = KeyframePairs([], [])
    for pair in pairs:
        ends = []
        for instant in (pair.first, pair.second):
            stamp = stamp_of(instant, results)
            ends.append((int(np.abs(stamps - stamp).argmin()), stamp))
        (a, _), (b, _) = ends
        taken = {(known.a, known.b) for known in found.known}
        if a == b:
            found.problems.append(f"{pair.first.said}: both scans belong to one keyframe: there is no loop to close")
        elif pair.verdict == "forbidden":
            found.forbidden.append((min(a, b), max(a, b)))
        elif (min(a, b), max(a, b)) in taken:
            found.problems.append(f"{pair.first.said}: the pair is named twice, it counts once")
        else:
            found.known.append(_known(pair, ends, results, keyframes))
    found.problems.extend(
        f"{known.said}: the pair is known and forbidden: it holds, and nothing else is closed there"
        for known in found.known
        if (known.a, known.b) in found.forbidden
    )
    return found


def _known(
    pair: NamedPair, ends: list[tuple[int, int]], results: Many[ScanResult], keyframes: Many[Keyframe]
) -> KnownPair:
    """The keyframes lie beside the scans, as odometry has it."""
    (first, at_first), (second, at_second) = ends
    stamps = np.array([r.stamp_ns for r in results])
    poses = np.stack([r.T_world_lidar for r in results])
    of_first, of_second = poses_at(stamps, poses, np.array([at_first, at_second]))
    shift = of_first[:3, :3] @ np.array([*pair.place, 0.0])
    shift += keyframes[second].T_world_lidar[:3, 3] - of_second[:3, 3]
    shift -= keyframes[first].T_world_lidar[:3, 3] - of_first[:3, 3]
    a, b = min(first, second), max(first, second)
    if a != first:
        shift = -shift
    return KnownPair(a, b, keyframes[a].T_world_lidar[:3, :3].T @ shift, pair.within, pair.first.said)
