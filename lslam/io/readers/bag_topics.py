"""Choice of the topics of a bag, and the order of their messages by stamp."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from lslam.core.arrays import Bools, Stamps
from lslam.core.errors import InputError, LslamError, UsageError
from lslam.io.formats.bag_files import Bag, BagTopic, Header, read_header
from lslam.io.formats.bag_listing import missing_parts
from lslam.io.formats.bag_streams import Stream, read_fixes, read_imu
from lslam.io.formats.sensor_messages import decoding_advice, is_packets, livox_id, maker_by_name, packet_topics
from lslam.io.formats.text_tables import seconds_text
from lslam.io.readers.bag_lidars import ScanIndex, choose_lidars, find_halves, name_lidars
from lslam.io.readers.clocks import MESSAGES_PER_STAMP, Clock, agree, runs, say_jitter, stands_still
from lslam.io.readers.ground_truth import Voice

CLOUDS = ("PointCloud2", "CustomMsg")
HEADER = 512  # bytes of a message that hold its header
_LATE_NS = 10**9  # stamps that go back further are no jitter, nor by more than so many messages
_LATE_STEPS = 10
_CROWDED_RATIO = 1.5  # times as many messages as the rate makes: they tell of a time that others have told of
_APART_NS = 60 * 10**9  # parts of one recording follow each other sooner
_FEW = 4  # messages that may come late at the seam of two parts


def choose_clouds(bag: Bag, choice: str | None, voice: Voice) -> list[BagTopic]:
    """The topics `choice`, or the only one with clouds; without any, the only one with packets that can be decoded.

    choice : names separated by commas

    Raises UsageError listing the flags when there are several or one of `choice` does not exist, InputError when there is none.
    """
    clouds, packets = bag.of_type(*CLOUDS), packet_topics(bag)
    if choice is not None:
        names = dict.fromkeys(name.strip() for name in choice.split(","))
        return [_find_topic(bag, clouds + packets, name, "--lidar-topic", "clouds") for name in names]
    if clouds and packets:
        left_out = ", ".join(t.name for t in packets)
        voice.notes.append(f"raw packets on {left_out} are left out, for there are clouds; --lidar-topic reads them")
    clouds = clouds or packets
    if len(clouds) == 1:
        return clouds
    if clouds:
        raise UsageError(
            f"{bag.path} has clouds on {len(clouds)} topics, choose one, or several LiDARs to merge:\n"
            f"{_flags(clouds, '--lidar-topic')}"
        )
    raw = [t for t in bag.topics if len(t) and is_packets(t.type)]
    nameless = [t for t in bag.topics if len(t) and not t.type]
    if raw:
        where = f" on {raw[0].name} ({raw[0].type}, {len(raw[0])} messages)"
        raise InputError(f"{bag.path} holds {decoding_advice(maker_by_name(raw[0].name, raw[0].type), where)}")
    if nameless:
        raise InputError(
            f"{bag.path} lacks the type definition of {', '.join(t.name for t in nameless)} and has no other clouds: record it "
            "again, or add the schemas, with the sensor's message package installed"
        )
    raise InputError(f"{bag.path} holds no clouds (PointCloud2 or Livox CustomMsg); {_listing(bag)}")


def check_parts(bag: Bag, topic: BagTopic) -> None:
    """Raise UsageError when the files of a folder are not parts of one recording.

    Parts of one recording follow each other closely in time and do not overlap.
    """
    stamps: dict[Path, list[Stamps]] = {}
    for recording, part in topic.parts:
        if len(part):
            stamps.setdefault(recording.path, []).append(part.stamps_ns)
    spans = ((path, np.concatenate(pieces)) for path, pieces in stamps.items())
    parts = sorted((int(own.min()), int(own.max()), len(own), path) for path, own in spans)
    for (begin, end, count, path), (start, stop, following_count, following) in pairwise(parts):
        wrong = ""
        if start - end > _APART_NS:
            wrong = f"{following.name} begins {(start - end) * 1e-9:.0f} s after {path.name} has ended"
        elif end - start > 0.5 * min(stop - start, end - begin) and min(count, following_count) >= _FEW:
            wrong = f"{following.name} and {path.name} hold {topic.name} of the same {(min(end, stop) - start) * 1e-9:.1f} s"
        if wrong:
            gaps = "".join(f"; {sentence}" for sentence in missing_parts(bag.path, bag.files))
            raise UsageError(
                f"{bag.path} holds {len(bag.files)} bags that are no parts of one recording: {wrong}{gaps}; name one of them, "
                f"for example {path}"
            )


@dataclass(frozen=True)
class Companion:
    """Kind of stream beside the scans: name, flag, message type or types (`A or B`), reader, and the options that need it."""

    name: str
    flag: str
    type: str
    read: Callable[[Bag, BagTopic, list[str]], Stream]
    wish: str


IMU = Companion("IMU", "--imu-topic", "Imu", read_imu, "--imu")
GNSS = Companion("GNSS", "--gnss-topic", "NavSatFix", read_fixes, "--gnss and --georeference")


def load_companion(bag: Bag, kind: Companion, choice: str | None, voice: Voice) -> Stream | None:
    """Stream of topic `choice` or the only one of its kind; None, with a problem, for several or no usable samples."""
    topics = bag.of_type(*kind.type.split(" or "))
    if choice is not None:
        topics = [_find_topic(bag, topics, choice, kind.flag, f"{kind.type} messages")]
    if len(topics) > 1:
        voice.problems.append(
            f"{kind.name}: {len(topics)} topics have one, none is used until one is chosen:\n{_flags(topics, kind.flag)}"
        )
    if len(topics) != 1:
        return None
    topic, what = topics[0], f"{kind.name}: samples"
    stream = kind.read(bag, topic, voice.problems)
    if not len(stream.stamps_ns):
        voice.problems.append(f"{kind.name}: {topic.name} holds {len(topic)} messages and none that can be used")
        return None
    own = np.flatnonzero(_no_copies(stream.stamps_ns, lambda i: stream.values[i].tobytes(), what, voice))
    order, stamps = put_in_order(stream.stamps_ns[own], stream.recorded_ns[own], what, voice)
    voice.notes.append(f"{kind.name} from {topic.name} ({len(topic)} messages, frame {stream.frame or 'unnamed'})")
    kept = own[order]
    return replace(stream, stamps_ns=stamps, values=stream.values[kept], recorded_ns=stream.recorded_ns[kept])


def why_none(bag: Bag, kind: Companion) -> LslamError:
    """The error for a stream that was needed but not loaded: choose one of several topics, or there is none."""
    topics = bag.of_type(*kind.type.split(" or "))
    if len(topics) > 1:
        flags = _flags(topics, kind.flag)
        return UsageError(f"{bag.path} has {kind.name} on {len(topics)} topics, choose one:\n{flags}")
    fact = f"{topics[0].name} holds none that can be used" if topics else f"no topic is sensor_msgs/{kind.type}"
    return InputError(f"{bag.path} has no {kind.name}: {fact}; {_listing(bag)}; run without {kind.wish}")


def index_scans(bag: Bag, topic: BagTopic, choice: str | None, voice: Voice) -> list[ScanIndex]:
    """Scans of each chosen LiDAR of `topic`, see `choose_lidars`, with increasing stamps.

    Only headers are read, unless stamps repeat. Raises InputError when none can be read, UsageError for a LiDAR that does not
    exist.
    """
    is_livox, is_ros1 = topic.type.endswith("CustomMsg"), topic.encoding == "ros1"

    def beginning(data: bytes) -> tuple[Header, int | None]:
        header = read_header(topic, data)
        return header, livox_id(data, header.end, is_ros1) if is_livox else None

    begun = dict(bag.each(topic, beginning, voice.problems, HEADER))
    if not begun:
        way_out = "; where its index is wrong `rosbag reindex` mends it" if is_ros1 else ""
        raise InputError(f"{bag.path}: none of the {len(topic)} messages of {topic.name} can be read{way_out}")
    messages = np.array(list(begun), np.int64)
    recording_ns = topic.stamps_ns[messages]
    headers = np.array([header.stamp_ns for header, _ in begun.values()], np.int64)
    frames, ids = [header.frame for header, _ in begun.values()], [number for _, number in begun.values()]
    names = name_lidars(frames, ids)
    chosen = choose_lidars(topic, names, choice, voice)
    is_own = _no_copies(headers, lambda i: bag.message(topic, int(messages[i])), f"{topic.name}: scans", voice)
    indices = []
    for name, mine in chosen:
        its = [names[k] for k in np.flatnonzero(mine)]
        halves = find_halves(bag, topic, messages[mine], headers[mine], its, voice)
        own = mine & is_own & ~np.isin(messages, [k for others in halves.values() for k in others])
        what = f"{topic.name}: scans" if len(chosen) == 1 else f"{topic.name}: scans of {name}"
        order, ordered = put_in_order(headers[own], recording_ns[own], what, voice)
        if np.array_equal(ordered, headers[own][order]):
            delay_s = float(np.median(recording_ns[own][order] - ordered)) * 1e-9
            voice.notes.append(
                f"{what} have the stamps of their headers; they were recorded {delay_s:.3f} s after (median)"
            )
        say_jitter(ordered, what, voice)
        frame = next((frames[k] for k in np.flatnonzero(mine) if frames[k]), "")
        indices.append(ScanIndex(topic, name, frame, messages[own][order], ordered, halves))
    return indices


def _no_copies(stamps: Stamps, content: Callable[[int], bytes], what: str, voice: Voice) -> Bools:
    """(N,) whether a message is no duplicate of an earlier one, as in a bag played in a loop. Notes go to `voice`."""
    own = np.ones(len(stamps), bool)
    _, first, again = np.unique(stamps, return_index=True, return_inverse=True)
    repeats = np.flatnonzero(first[again] < np.arange(len(stamps)) - 1)
    if len(first) <= len(stamps) / MESSAGES_PER_STAMP:
        return own  # of a clock that stands still
    for i in repeats.tolist():
        with suppress(InputError):
            own[i] = content(i) != content(int(first[again[i]]))
    if not own.all():
        voice.problems.append(
            f"{what}: {int((~own).sum())} messages, message {int(np.argmin(own))} the first, are copies of earlier ones: left out"
        )
    return own


def put_in_order(stamps: Stamps, recording_ns: Stamps, what: str, voice: Voice) -> tuple[Stamps, Stamps]:
    """Indices of the messages to keep, in order, and their increasing stamps; faults are added to the problems.

    Constant stamps are replaced by the times of recording, which also correct steps of the stamps (`clocks`). Messages that
    are a few positions late are sorted in. Dropped are repeated stamps, and messages that go back further by both clocks or
    repeat a span of time.
    """
    if stands_still(stamps, recording_ns):
        still = f" that stand still at {seconds_text(int(stamps[0]))} s" if stamps.any() else ""
        fact = f"{'' if still else 'no '}stamps in their headers{still}"
        voice.problems.append(f"{what} have {fact}: the times of recording are used, late as they are")
        stamps = recording_ns
    late, again = _lateness(stamps)
    stamps = agree(stamps, np.where(again, 0, late), Clock("the times of recording", recording_ns), what, voice)
    late, again = _lateness(stamps)
    index = np.arange(len(stamps), dtype=np.int64)
    if again.any():
        first = int(np.flatnonzero(again)[0])
        voice.problems.append(
            f"{what} go back in time by {late[again].max() * 1e-9:.3f} s at message {first}: {int(again.sum())} of "
            f"{len(stamps)} are dropped until time goes on"
        )
    index = index[~again]
    jitter = int((late[index] > 0).sum())
    if jitter:
        voice.problems.append(
            f"{what} are out of order in {jitter} places, by up to {late[index].max() * 1e-9:.3f} s: sorted"
        )
    ordered, firsts = np.unique(stamps[index], return_index=True)
    if len(firsts) < len(index):
        voice.problems.append(f"{what} repeat a stamp {len(index) - len(firsts)} times: the first one of each counts")
    return index[firsts], ordered


def _lateness(stamps: Stamps) -> tuple[Stamps, Bools]:
    """(N,) delay of each stamp relative to the latest one before it, ns, and whether it exceeds jitter."""
    late = np.maximum.accumulate(stamps) - stamps if len(stamps) else stamps
    steps = np.diff(stamps)
    if not (late > 0).any() or not (steps > 0).any():
        return late, np.zeros(len(stamps), bool)
    step = float(np.median(steps[steps > 0]))
    return late, (late > max(_LATE_NS, _LATE_STEPS * min(step, _LATE_NS))) | _repeats_span(stamps, late, step)


def _repeats_span(stamps: Stamps, late: Stamps, step: float) -> Bools:
    """(N,) whether late messages repeat a span of time that earlier ones covered, since a clock was set back.

    Their stamps then lie among those of others and fill no gap.
    late : (N,) ns, delay of messages that came out of order, 0 for the others; step : usual time between two, ns
    """
    again = np.zeros(len(stamps), bool)
    ahead = stamps[late == 0]
    for begin, end in runs(late > 0):
        lo, hi = stamps[begin:end].min(), stamps[begin:end].max()
        there = int(np.searchsorted(ahead, hi, "right") - np.searchsorted(ahead, lo))
        own = int(end - begin)
        again[begin:end] = 2 <= own <= 2 * there and own + there >= _CROWDED_RATIO * (float(hi - lo) / step + 1)
    return again


def _find_topic(bag: Bag, topics: list[BagTopic], choice: str, flag: str, what: str) -> BagTopic:
    """The one of `topics` named `choice`; raises UsageError naming the `flag` and the choices if there is none."""
    for own in topics:
        if own.name.strip("/") == choice.strip("/"):
            return own
    other = next((t for t in bag.topics if t.name.strip("/") == choice.strip("/")), None)
    fact = (
        "is not there" if other is None else f"holds {len(other)} messages of type {other.type or 'unknown'}, no {what}"
    )
    way_out = f"choose one:\n{_flags(topics, flag)}" if topics else _listing(bag)
    raise UsageError(f"{flag} {choice}: the topic {fact} in {bag.path}; {way_out}")


def _flags(topics: list[BagTopic], flag: str) -> str:
    """Lines for a message: the option with each topic that could be chosen."""
    width = max(len(t.name) for t in topics)
    return "\n".join(f"  {flag} {t.name:<{width}}  ({len(t)} messages, {t.type})" for t in topics)


def _listing(bag: Bag) -> str:
    """Text for a message: all topics of the bag with their types."""
    topics = [f"{t.name} ({t.type or 'unknown type'}, {len(t)})" for t in bag.topics]
    return f"its topics are {', '.join(topics)}" if topics else "it has no topics at all"
