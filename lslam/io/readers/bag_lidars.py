"""LiDARs of a bag: sensors that share a topic, revolutions split into several messages, and the places of sensors."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Bools, Floats, Longs, Stamps
from lslam.core.errors import InputError, UsageError
from lslam.core.geometry import se3, so3
from lslam.core.types.scan import NO_RING, has_return
from lslam.io.formats.bag_files import Bag, BagTopic, read_header
from lslam.io.formats.bag_streams import Transforms, chain, is_static, read_transforms
from lslam.io.formats.point_cloud import PointCloud
from lslam.io.formats.sensor_messages import decode_livox, decode_pointcloud2
from lslam.io.readers.ground_truth import Voice

ALL = "all"
NO_NAME = "unnamed"

_MOST = 40  # parts of a revolution; more messages of one stamp come from a clock that stands still
_STAMPS_LOOKED_AT = 40  # stamps; of more of them so many are looked at before the recording is read
_BINS = 90  # of azimuth
_FULL = 5 / 6  # of all directions, by 12 deg: the sensor turns, and what it sees again is another revolution
_MOST_OVERLAP = 0.2  # of azimuths or of the time: parts of one revolution meet at their seams

# Further messages of a scan, by the first of them.
Halves = Mapping[int, tuple[int, ...]]

# What moves by less over a whole recording is rigid: the rounding of a driver, the play of a joint.
_STILL = 1e-3  # m, rad
# Messages of /tf that are held against /tf_static.
_TRANSFORMS_LOOKED_AT = 100


@dataclass(frozen=True)
class ScanIndex:
    """Scans of one LiDAR: its name and frame, the message numbers (N,) on `topic`, and their header stamps (N,), ns.

    halves : further messages of a scan
    """

    topic: BagTopic
    name: str
    frame: str
    messages: Longs
    stamps_ns: Longs
    halves: Halves

    def __str__(self) -> str:
        return f"{self.name} of {self.topic.name}"


def name_lidars(frames: Sequence[str], ids: Sequence[int | None]) -> list[str]:
    """Name of the sensor of each message: its frame; with Livox's `lidar_id` where one frame has several, `livox:1`."""
    several = {frame for frame, count in Counter(f for f, _ in set(zip(frames, ids, strict=True))).items() if count > 1}
    return [
        f"{frame or NO_NAME}:{number}" if frame in several else frame or NO_NAME
        for frame, number in zip(frames, ids, strict=True)
    ]


def choose_lidars(topic: BagTopic, names: Sequence[str], choice: str | None, voice: Voice) -> list[tuple[str, Bools]]:
    """LiDARs of a topic to read, the leading one first: their names, and (N,) bool, the messages of each.

    names : (N,) of the sensor of each message; choice : names separated by commas, `all`, or None

    If `choice` is None the LiDAR with the most messages is read, and the others are named in the problems. A name that
    replaces another in the middle of the recording is the same LiDAR. Raises UsageError for names that the topic does not
    have.
    """
    counts = Counter(names)
    changes = [k for k, (a, b) in enumerate(pairwise(names), 1) if a != b]
    first, *others = (name for name, _ in counts.most_common())
    if choice not in (None, ALL):
        chosen = _parse_frames(topic, counts, str(choice))
    elif len(changes) < len(counts):
        if changes:
            voice.problems.append(
                f"{topic.name}: the frame of the scans changes from {names[0]} to {names[changes[0]]} at message {changes[0]}: "
                "taken for one LiDAR that was renamed; --lidar-frame takes the scans of one name"
            )
        return [(names[0], np.ones(len(names), np.bool_))]
    elif choice == ALL:
        chosen = [first, *others]
    else:
        chosen = [first]
        left_out = ", ".join(f"{name} ({counts[name]})" for name in others)
        voice.problems.append(
            f"{topic.name} holds the scans of {len(counts)} LiDARs in turns: those of {first} ({counts[first]} messages) are "
            f"read, those of {left_out} are not; --lidar-frame {others[0]} takes another one, --lidar-frame {ALL} merges them"
        )
    return [(name, np.array(names) == name) for name in chosen]


def _parse_frames(topic: BagTopic, counts: Counter[str], choice: str) -> list[str]:
    """Names in the option --lidar-frame, without repetitions. Raises UsageError for a name that the topic lacks."""
    chosen = [name.strip().lstrip("/") for name in choice.split(",")]
    strange = [name for name in chosen if name not in counts]
    if strange:
        flags = "\n".join(f"  --lidar-frame {name}  ({count} messages)" for name, count in counts.items())
        raise UsageError(
            f"--lidar-frame {choice}: no message of {topic.name} is of {strange[0]!r}; choose among:\n{flags}"
        )
    return list(dict.fromkeys(chosen))


def read_cloud(bag: Bag, topic: BagTopic, k: int) -> tuple[PointCloud, int]:
    """Points of message `k`, offset of their time base from the header's stamp, ns. Raises InputError for a damaged one."""
    where = Path(f"{bag.path}, {topic.name}, message {k}")
    data = bag.message(topic, k)
    if not topic.type.endswith("CustomMsg"):
        return decode_pointcloud2(bag.decode(topic, data), where), 0
    header = read_header(topic, data)
    cloud, timebase = decode_livox(data, header.end, topic.encoding == "ros1", header.order, where)
    shift = timebase - header.stamp_ns
    return cloud, shift if abs(shift) < 10**9 else 0


def put_together(bag: Bag, topic: BagTopic, group: tuple[int, ...]) -> tuple[PointCloud, int, tuple[int, ...]]:
    """Cloud of the messages of one scan, the offset of its time base from the first stamp (ns), and the joined messages.

    Raises InputError when one is damaged.
    """
    cloud, shift = read_cloud(bag, topic, group[0])
    parts = []
    for k in group[1:]:
        more, base = read_cloud(bag, topic, k)
        whole = join(cloud, more, base - shift)
        if whole is not None and len(more):
            cloud = whole
            parts.append(k)
    return cloud, shift, tuple(parts)


def find_halves(bag: Bag, topic: BagTopic, messages: Stamps, stamps: Stamps, frames: list[str], voice: Voice) -> Halves:
    """Find further parts of scans among `messages` (N,), by their stamps (N,) and frames; notes go to `voice`.

    Of many stamps only a sample is checked. A message that turns out to be no part is dropped when the scan is read.
    """
    by_stamp: dict[tuple[int, str], list[int]] = {}
    for message, stamp, frame in zip(messages.tolist(), stamps.tolist(), frames, strict=True):
        by_stamp.setdefault((stamp, frame), []).append(message)
    groups = [tuple(group) for (stamp, _), group in by_stamp.items() if stamp and 1 < len(group) <= _MOST]
    if not groups:
        return {}
    parts: dict[int, tuple[int, ...]] = {}
    for n in np.unique(
        np.linspace(0, len(groups) - 1, min(len(groups), _STAMPS_LOOKED_AT)).round().astype(int)
    ).tolist():
        parts[n] = ()
        with suppress(InputError):
            parts[n] = put_together(bag, topic, groups[n])[2]
    if not any(parts.values()):
        return {}
    halves = {group[0]: others for n, group in enumerate(groups) if (others := parts.get(n, group[1:]))}
    sample = "" if len(parts) == len(groups) else f", as {sum(map(bool, parts.values()))} of {len(parts)} looked at are"
    voice.notes.append(
        f"{topic.name}: {len(halves)} scans come in several messages of one stamp, which see other directions, rings or times: "
        f"put together{sample}"
    )
    return halves


def join(a: PointCloud, b: PointCloud, later_ns: int = 0) -> PointCloud | None:
    """One cloud of two parts of a scan, in the order they were measured; None where they are not parts of one scan.

    later_ns : offset of the base of b's times, in which case times are ns
    """
    if not len(a) or not len(b):
        return a if len(a) else b
    if later_ns:
        a, b = _shift_times(a, 0), _shift_times(b, later_ns)
    is_alike = (a.times is None) == (b.times is None) and (a.rings is None) == (b.rings is None)
    if not is_alike or not _is_complement(a.select(has_return(a.points)), b.select(has_return(b.points))):
        return None
    first, last = a, b
    if a.times is not None and b.times is not None and _when(b.times)[1] < _when(a.times)[1]:
        first, last = b, a
    of_last = {clock.name: clock.values for clock in last.clocks}
    clocks = (
        replace(clock, values=np.concatenate([clock.values, of_last[clock.name]]))
        for clock in first.clocks
        if clock.name in of_last
    )
    columns = {name: (getattr(first, name), getattr(last, name)) for name in ("points", "intensity", "rings", "labels")}
    joined: dict[str, Any] = {
        name: None if x is None or y is None else np.concatenate([x, y]) for name, (x, y) in columns.items()
    }
    return replace(first, clocks=tuple(clocks), **joined)


def _shift_times(cloud: PointCloud, later_ns: int) -> PointCloud:
    """Cloud with times in ns from an earlier base."""
    clocks = (replace(clock, values=clock.values.astype(np.int64) + later_ns) for clock in cloud.clocks)
    return replace(cloud, clocks=tuple(clocks))


def _is_complement(a: PointCloud, b: PointCloud) -> bool:
    """Whether b covers other azimuths or rings than a or, for a sensor with a limited view, other times."""
    of_a, of_b = _azimuths(a), _azimuths(b)
    if np.minimum(of_a, of_b).sum() <= _MOST_OVERLAP * min(of_a.sum(), of_b.sum()):
        return True
    if a.rings is not None and b.rings is not None:
        own = b.rings[b.rings != NO_RING]
        if len(own) and not np.isin(own, a.rings).any():
            return True
    is_turning = max(float(of.reshape(-1, 3).any(axis=1).mean()) for of in (of_a, of_b)) > _FULL
    if is_turning or a.times is None or b.times is None:
        return False
    (a0, _, a1), (b0, _, b1) = _when(a.times), _when(b.times)
    shorter = min(a1 - a0, b1 - b0)
    return shorter > 0 and min(a1, b1) - max(a0, b0) <= _MOST_OVERLAP * shorter


def _azimuths(cloud: PointCloud) -> Longs:
    """(90,) number of points in each sector of 4 deg."""
    return np.histogram(np.degrees(np.arctan2(cloud.points[:, 1], cloud.points[:, 0])), _BINS, (-180, 180))[0]


def _when(times: NDArray[Any]) -> tuple[float, float, float]:
    """Begin, middle and end of the times, in their unit, without outliers; zeros where there are none."""
    values = times.astype(np.float64)
    values = values[np.isfinite(values)]
    begin, middle, end = np.percentile(values, (1, 50, 99)) if len(values) else (0.0, 0.0, 0.0)
    return float(begin), float(middle), float(end)


@dataclass
class Links:
    """Transforms between frames, of /tf_static (`static`), else /tf too; uses_tf : whether a chain needed /tf."""

    bag: Bag
    voice: Voice
    static: Transforms = field(default_factory=dict)
    uses_tf: bool = False

    def __post_init__(self) -> None:
        """Read /tf_static; name pairs of frames with contradicting transforms."""
        for pair, poses in self._read(True).items():
            self.static[pair] = poses[-1]
            if not _is_still(poses):
                self.voice.problems.append(
                    f"/tf_static says more than one thing of {pair[0]} -> {pair[1]}, {_spread_text(poses)}: the last one counts"
                )
        for pair, poses in self._read(False, _TRANSFORMS_LOOKED_AT).items() if self.static else ():
            if pair in self.static and not _is_still(both := np.concatenate([self.static[pair][None], poses])):
                self.voice.problems.append(
                    f"/tf says another thing of {pair[0]} -> {pair[1]} than /tf_static, {_spread_text(both)}: /tf_static counts"
                )

    def find(self, a: str, b: str) -> tuple[Floats, str] | None:
        """`T_a_b` (4, 4) along static transforms, and their source in words; None when no chain connects the frames."""
        if (T := chain(self.static, a, b)) is not None:
            return T, "the same frame" if a == b else "from /tf_static"
        if not a or not b:
            return None
        if (T := chain(self._still, a, b)) is not None:
            self.uses_tf = True
            return T, "from /tf, which always says the same of it"
        return None

    def why_not(self, a: str, b: str) -> str:
        """Reason, in words, why `find` returns no transform."""
        if not a or not b:
            return "messages name no frame"
        moving = {pair: poses[0] for pair, poses in self._of_tf.items() if pair not in self._still}
        every = {**moving, **self._still}
        if moving and chain(every, a, b) is not None:
            broken = [pair for pair in moving if chain({p: T for p, T in every.items() if p != pair}, a, b) is None]
            links = []
            for parent, child in broken or moving:
                poses = self._of_tf[parent, child]
                how = "/tf says only once" if len(poses) == 1 else f"changes on /tf ({_spread_text(poses)})"
                links.append(f"{parent} -> {child}, which {how}")
            return f"the way from frame {a} to {b} leads over {', '.join(links)}"
        there = "no transform leads" if every else "there is no /tf_static that leads"
        return f"{there} from frame {a} to {b}"

    @cached_property
    def _of_tf(self) -> Transforms:
        """All transforms of /tf, (N, 4, 4) by pair of frames."""
        return self._read(False)

    @cached_property
    def _still(self) -> Transforms:
        """Transforms that do not change: those of /tf_static, and those of /tf whose repetitions are equal."""
        same = {pair: poses[0] for pair, poses in self._of_tf.items() if len(poses) > 1 and _is_still(poses)}
        return {**same, **self.static}

    def _read(self, wants_static: bool, most: int | None = None) -> Transforms:
        """Transforms of the static or the dynamic topics, from their first `most` messages (None: all)."""
        problems = self.voice.problems if most is None else []
        poses_of: dict[tuple[str, str], list[Floats]] = {}
        for topic in self.bag.of_type("TFMessage"):
            if is_static(topic) == wants_static:
                for pair, poses in read_transforms(self.bag, topic, problems, most).items():
                    poses_of.setdefault(pair, []).append(poses)
        return {pair: np.concatenate(pieces) for pair, pieces in poses_of.items()}


def places_of(
    lidars: Sequence[ScanIndex], links: Links, places_in_toml: Mapping[str, Floats] | None
) -> list[tuple[Floats, str]]:
    """`T_leading_other` (4, 4) of each LiDAR after the first, which leads, and their sources in words.

    places_in_toml : `T_lidar_other` by frame or topic. If all LiDARs but one are named, the transforms are relative to that one.

    Raises InputError for a LiDAR without a known place. A shared frame proves nothing: the clouds may be in it already, or
    the drivers may all use one name.
    """
    named = [(places_in_toml or {}).get(one.name, (places_in_toml or {}).get(one.topic.name)) for one in lidars]
    if places_in_toml and sum(T is None for T in named) == 1:
        named = [np.eye(4) if T is None else T for T in named]
    leading, T_lidar_leading = lidars[0], named[0]
    places = []
    for other, T_lidar_other in zip(lidars[1:], named[1:], strict=True):
        if T_lidar_other is not None:
            T = T_lidar_other if T_lidar_leading is None else se3.inverse(T_lidar_leading) @ T_lidar_other
            places.append((T, "as stated"))
            continue
        is_same = other.frame == leading.frame
        place = None if is_same else links.find(leading.frame, other.frame)
        if place is None:
            key, why = other.name, links.why_not(leading.frame, other.frame)
            if is_same:
                key, why = other.topic.name, f"both are of frame {other.frame or NO_NAME}"
            raise InputError(
                f"{links.bag.path}: {other} cannot be merged with {leading}, {why}: state T_lidar_other, 12 numbers, in "
                f'sequence.toml, [lidars] "{key}" = [1, 0, 0, x, ...], or take one LiDAR with --lidar-topic or --lidar-frame'
            )
        places.append(place)
    return places


def _largest_difference(poses: Floats) -> tuple[float, float]:
    """Largest difference of poses (N, 4, 4) from the first: m, rad."""
    off = se3.inverse(poses[0]) @ poses
    metres, turns = (np.linalg.norm(part, axis=1) for part in (off[:, :3, 3], so3.log(off[:, :3, :3])))
    return float(metres.max()), float(turns.max())


def _is_still(poses: Floats) -> bool:
    """Whether repeated transforms (N, 4, 4) are equal."""
    return max(_largest_difference(poses)) <= _STILL


def _spread_text(poses: Floats) -> str:
    """Text on how far transforms (N, 4, 4) differ."""
    metres, turn = _largest_difference(poses)
    return f"{metres:.3f} m and {np.degrees(turn):.1f} deg apart"
