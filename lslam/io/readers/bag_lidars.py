"""Which LiDARs share a topic of a bag: they are told apart by the frame of their messages, and by Livox's `lidar_id`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lslam.core.errors import UsageError
from lslam.io.formats.bag_files import BagTopic
from lslam.io.readers.bag_halves import Halves
from lslam.io.readers.ground_truth import Voice

ALL = "all"
UNNAMED = "unnamed"


@dataclass(frozen=True)
class ScanIndex:
    """The scans of one LiDAR: its name and frame, which messages of `topic` they are, (N,), and their header stamps, (N,) ns.

    halves : further messages of a scan
    """

    topic: BagTopic
    name: str
    frame: str
    messages: NDArray[np.int64]
    stamps_ns: NDArray[np.int64]
    halves: Halves

    def __str__(self) -> str:
        return f"{self.name} of {self.topic.name}"


def name_lidars(frames: Sequence[str], ids: Sequence[int | None]) -> list[str]:
    """A name for the sensor of each message: its frame, with Livox's `lidar_id` where one frame has several, `livox:1`."""
    several = {frame for frame, count in Counter(f for f, _ in set(zip(frames, ids, strict=True))).items() if count > 1}
    return [
        f"{frame or UNNAMED}:{number}" if frame in several else frame or UNNAMED
        for frame, number in zip(frames, ids, strict=True)
    ]


def choose_lidars(
    topic: BagTopic, names: Sequence[str], wanted: str | None, voice: Voice
) -> list[tuple[str, NDArray[np.bool_]]]:
    """The LiDARs of a topic that are read, the first one leads: their names, and which of the N messages are theirs, (N,) bool.

    names : (N,) of the sensor of each message; wanted : names with commas between them, `all`, or None

    Without a wish it is the LiDAR with the most messages, and the others go to the problems. A name that takes the place of
    another in the middle of the recording is no other LiDAR. Raises UsageError for names that the topic does not have.
    """
    counts = Counter(names)
    changes = [k for k, (a, b) in enumerate(pairwise(names), 1) if a != b]
    first, *others = (name for name, _ in counts.most_common())
    if wanted not in (None, ALL):
        chosen = _wished(topic, counts, str(wanted))
    elif len(changes) < len(counts):
        if changes:
            voice.problems.append(
                f"{topic.name}: the frame of the scans changes from {names[0]} to {names[changes[0]]} at message {changes[0]}: "
                "taken for one LiDAR that was renamed; --lidar-frame takes the scans of one name"
            )
        return [(names[0], np.ones(len(names), np.bool_))]
    elif wanted == ALL:
        chosen = [first, *others]
    else:
        chosen = [first]
        left_out = ", ".join(f"{name} ({counts[name]})" for name in others)
        voice.problems.append(
            f"{topic.name} holds the scans of {len(counts)} LiDARs in turns: those of {first} ({counts[first]} messages) are "
            f"read, those of {left_out} are not; --lidar-frame {others[0]} takes another one, --lidar-frame {ALL} merges them"
        )
    return [(name, np.array(names) == name) for name in chosen]


def _wished(topic: BagTopic, counts: Counter[str], wanted: str) -> list[str]:
    chosen = [name.strip().lstrip("/") for name in wanted.split(",")]
    strange = [name for name in chosen if name not in counts]
    if strange:
        flags = "\n".join(f"  --lidar-frame {name}  ({count} messages)" for name, count in counts.items())
        raise UsageError(
            f"--lidar-frame {wanted}: no message of {topic.name} is of {strange[0]!r}; choose among:\n{flags}"
        )
    return list(dict.fromkeys(chosen))
