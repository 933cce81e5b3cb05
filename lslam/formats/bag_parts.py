"""Files of a folder that are parts of one recording, and those that are copies of others."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from lslam.formats.bag_chunks import Topic


class _File(Protocol):
    @property
    def path(self) -> Path: ...

    @property
    def topics(self) -> list[Topic]: ...


F = TypeVar("F", bound=_File)


def apart(files: list[F]) -> tuple[list[F], list[tuple[F, F]]]:
    """Files that hold something no other does, in their order, and the others, each with the file that holds all of it.

    A copy is made by converting, compressing, indexing or filtering: it keeps names of topics and times of recording. Of equal
    ones the first stays.
    """
    kept: list[F] = []
    copies: list[tuple[F, F]] = []
    for file in sorted(files, key=lambda f: -_count(f)):
        fuller = next((other for other in kept if _is_within(file, other)), None)
        if fuller is None:
            kept.append(file)
        else:
            copies.append((file, fuller))
    return [f for f in files if any(f is k for k in kept)], copies


def _count(file: _File) -> int:
    return sum(len(topic) for topic in file.topics)


def _is_within(file: _File, other: _File) -> bool:
    """Whether `other` has every message of `file`, by topic and time; one without messages is a part of its own."""
    return _count(file) > 0 and all(
        any(t.name == topic.name and _has_all(t.stamps_ns, topic.stamps_ns) for t in other.topics)
        for topic in file.topics
        if len(topic)
    )


def _has_all(stamps: NDArray[np.int64], of: NDArray[np.int64]) -> bool:
    """Whether `of` are among `stamps`, both in order; where one begins or ends outside, no more is compared."""
    return len(stamps) > 0 and stamps[0] <= of[0] and of[-1] <= stamps[-1] and bool(np.isin(of, stamps).all())
