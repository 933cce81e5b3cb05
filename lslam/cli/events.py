"""Progress and log as JSON, one object a line on stderr, for scripts: `--progress json`."""

from __future__ import annotations

import json
import logging
import sys
import time
from contextlib import suppress
from typing import Any

log = logging.getLogger("lslam")


class Events(logging.Handler):
    """Handler of lslam's log that writes a JSON object a line, in one call, so that who is killed leaves whole lines.

    A record is an event of its level's name, `info`, `warning` or `error`, unless it brings another in `extra`.
    """

    def __init__(self) -> None:
        super().__init__()
        self._began = time.monotonic()

    def emit(self, record: logging.LogRecord) -> None:
        """Write the event of a record."""
        facts = {"event": record.levelname.lower(), "text": record.getMessage(), **getattr(record, "event", {})}
        self.tell(**facts)

    def tell(self, event: str, **facts: Any) -> None:
        """Write an event; `elapsed_s` counts from the start of the command. A pipe that is closed does not end a run."""
        line = {"event": event, "elapsed_s": round(time.monotonic() - self._began, 3), **facts}
        assert self.lock is not None
        with self.lock, suppress(OSError, ValueError):
            sys.stderr.write(json.dumps(line, default=str) + "\n")
            sys.stderr.flush()


def events() -> Events | None:
    """The handler, where `--progress json` was given."""
    first = log.handlers[0] if log.handlers else None
    return first if isinstance(first, Events) else None


def begin_events() -> None:
    """Write events from now on."""
    log.handlers[:] = [Events()]
