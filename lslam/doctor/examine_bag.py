"""The topics of a bag with type, rate and number of messages, as its index tells them: no message is read."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from lslam.doctor.findings import Facts
from lslam.errors import LslamError
from lslam.formats.bag_files import Bag, BagTopic, open_bag
from lslam.formats.stamp_texts import utc_of
from lslam.readers import bag as bag_reader
from lslam.readers.lookup import find_folder


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
