"""`lslam graph` as a child of the server: one at a time, into a new folder beside the run."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import threading
from collections import deque
from contextvars import copy_context
from pathlib import Path
from typing import Any

from lslam.core.errors import OutputError, OutputExistsError, cause

SAID = 30  # lines of the child that are kept
PATIENCE_S = 20.0  # for a child that was asked to stop


class GraphJob:
    """The child. `words` are those of `lslam graph` after the run; `out` is its new folder."""

    def __init__(self, run: Path, words: list[str]) -> None:
        self.out = next_folder(run)
        command = [sys.executable, "-m", "lslam", "graph", str(run), *words, "--out", str(self.out)]
        self._is_asked = False
        self._said: deque[str] = deque(maxlen=SAID)
        try:
            self._child = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                errors="replace",
                start_new_session=True,  # what the terminal sends comes from the server alone
            )
        except OSError as error:
            raise OutputError(f"lslam graph cannot be started: {cause(error)}") from None
        self._reader = threading.Thread(target=copy_context().run, args=(self._read,), name="lslam-graph", daemon=True)
        self._reader.start()

    @property
    def is_running(self) -> bool:
        """Whether it is not over."""
        return self._child.poll() is None

    def state(self) -> dict[str, Any]:
        """`running`, `done`, `stopped` or `failed`, and what it said."""
        code = self._child.poll()
        if code is not None:
            self._reader.join(PATIENCE_S)
        # Asked before it heeds signals, it dies of one.
        word = "running" if code is None else "done" if code == 0 else "stopped" if self._is_asked else "failed"
        return {"state": word, "out": self.out.name, "said": list(self._said)}

    def stop(self) -> None:
        """Ask it to stop as Ctrl-C does, and end it where it does not."""
        if self.is_running:
            self._is_asked = True
            self._child.terminate()
            try:
                self._child.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                self._child.kill()
                self._child.wait()

    def _read(self) -> None:
        assert self._child.stderr is not None
        with contextlib.suppress(ValueError):
            for line in self._child.stderr:
                self._said.append(line.rstrip().removeprefix("INFO: "))


def next_folder(run: Path) -> Path:
    """RUN-graph beside the run, or the first of RUN-graph-2, ... that is free. Raises OutputExistsError when none is."""
    named = run.resolve()
    for number in range(1, 1000):
        folder = named.with_name(f"{named.name}-graph" + (f"-{number}" if number > 1 else ""))
        if not folder.exists():
            return folder
    raise OutputExistsError(f"{named}-graph to {named}-graph-999 exist: remove some of them")
