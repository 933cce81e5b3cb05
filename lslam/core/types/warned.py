"""What a run was warned of: every warning in lslam's log while it goes on stands in its manifest and its report."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from lslam.core.types.state import State

log = logging.getLogger("lslam")

# Sentences from one line of the program, as one per scan that fails; how many more there were is said.
MOST_ALIKE = 6


class Warnings(logging.Filter):
    """The warnings of one run, each once, in the order in which they were first given.

    It lets everything through: a filter of the log hears what handlers of any level would, and is no handler, without which
    Python shows warnings by itself. Of several runs in one process each hears what is logged in its own context, which its
    threads have to share (`contextvars.copy_context`).
    """

    def __init__(self) -> None:
        super().__init__()
        self._places: dict[str, str] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Remember a warning of this run."""
        if record.levelno >= logging.WARNING and _collector.get() is self:
            self._places.setdefault(_text(record), f"{record.module}:{record.lineno}")
        return True

    def beyond(self, messages: Collection[str]) -> list[str]:
        """The warnings that `messages` do not contain yet; of many similar ones only the first few."""
        new = [(text, place) for text, place in list(self._places.items()) if not _repeats(text, messages)]
        alike, seen = Counter(place for _, place in new), Counter[str]()
        said = []
        for text, place in new:
            seen[place] += 1
            if seen[place] <= MOST_ALIKE:
                said.append(text)
            if seen[place] == MOST_ALIKE < alike[place]:
                said.append(f"{alike[place] - MOST_ALIKE} more such warnings stand in the log, after: {text}")
        return said

    def state(self) -> State:
        """The warnings so far, for `take_over` in a resumed run."""
        places = dict(self._places)
        return {"texts": list(places), "places": list(places.values())}

    def take_over(self, state: State) -> None:
        """Add the warnings of an earlier part of the run, from its `state`."""
        for text, place in zip(state["texts"], state["places"], strict=True):
            self._places.setdefault(text, place)


_collector: ContextVar[Warnings | None] = ContextVar("lslam_warnings", default=None)


def warnings_so_far() -> Warnings:
    """The warnings of the run in this context; outside of a run an empty collection that nobody reads."""
    return _collector.get() or Warnings()


@contextmanager
def collect_warnings() -> Iterator[Warnings]:
    """Collect the block's warnings, in addition to those of an enclosing block: a run may begin before `run` is called."""
    heard, outer = Warnings(), _collector.get()
    if outer is not None:
        heard.take_over(outer.state())
    level = log.level
    is_deaf = log.getEffectiveLevel() > logging.WARNING
    if is_deaf:
        log.setLevel(logging.WARNING)
    log.addFilter(heard)
    token = _collector.set(heard)
    try:
        yield heard
    finally:
        _collector.reset(token)
        log.removeFilter(heard)
        if is_deaf:
            log.setLevel(level)


def _repeats(text: str, messages: Collection[str]) -> bool:
    """Whether one of the messages is contained in `text`."""
    return any(sentence and sentence in text for sentence in messages)


def _text(record: logging.LogRecord) -> str:
    """The message of a log record; unformatted if its arguments do not fit."""
    try:
        return record.getMessage()
    except (TypeError, ValueError):  # of a method of somebody else's: no reason to end a run
        return str(record.msg)
