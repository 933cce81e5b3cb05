"""What the commands share that make a run: its arguments, truth, progress and profile, and its result as it is printed."""

from __future__ import annotations

import json
import linecache
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from contextvars import copy_context
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from lslam.cli.console import Stages, log, progress, show, show_json
from lslam.cli.options import command_line
from lslam.core import __version__
from lslam.core.errors import RunFinishedError
from lslam.core.stopping import Stop, handle_signals
from lslam.core.untrusted import parse_json
from lslam.io.formats.atomic import atomic_write

if TYPE_CHECKING:
    from lslam.core.types.sequence import Sequence
    from lslam.core.types.trajectory import Trajectory
    from lslam.pipeline.watch import RunOutcome, Watch

INTERVAL_S = 0.005
MAX_STACKS = 50_000  # changes of stack kept at one interval: a longer run is looked at half as often, again and again
Frame = tuple[str, str, int]


@contextmanager
def arguments_of(
    out: Path, given: dict[str, Any], finish: Callable[[RunOutcome], None] | None = None
) -> Iterator[dict[str, Any]]:
    """Context with the arguments of `lslam.pipeline.run.run`; prints the result of a run that is finished already.

    finish : called with the outcome in place of what prints it
    """
    try:
        with handle_signals() as stop, profile_to(given.get("profile")), ExitStack() as stack:
            watch = watch_of(stack, stop, finish or (lambda outcome: print_result(outcome, out, given["as_json"])))
            arguments = {name: given[name] for name in ("overwrite", "resume")}
            yield {"out": out, "command": command_line(), "watch": watch, **arguments}
    except RunFinishedError as error:
        log.info("%s", error)
        _print_result_of(out, given["as_json"])


def read_truth(path: Path | None, sequence: Sequence) -> Trajectory | None:
    """Ground truth of --gt; the poses of a file without stamps take those of the sequence, one per scan."""
    if path is None:
        return None
    from dataclasses import replace

    from lslam.io.formats.trajectory_files import read_trajectory

    truth = read_trajectory(path.absolute())
    if not truth.has_stamps and len(truth) == len(sequence):
        return replace(truth, stamps_ns=sequence.stamps_ns, has_stamps=True)
    return truth


def watch_of(stack: ExitStack, stop: Stop, finish: Callable[[RunOutcome], None]) -> Watch:
    """Watch with progress bars that stops the run after the current scan on a signal."""
    from lslam.pipeline.watch import watch_run

    stages = Stages(stack)

    def on_end(outcome: RunOutcome) -> None:
        stages.end()
        finish(outcome)

    return watch_run(stop, stages.begin, stages.step, on_end)


@contextmanager
def watch_pass(title: str, scans: int) -> Iterator[Watch]:
    """Watch of a single pass over scans, with its progress bar; a signal ends it after the current scan."""
    from lslam.pipeline.watch import Watch

    with handle_signals() as stop, progress(title, scans) as advance:
        stop.is_gentle = True
        yield Watch(on_step=advance, should_stop=stop)


def _print_result_of(out: Path, as_json: bool) -> None:
    """Print the existing result for --json; the log states that nothing was done."""
    if not as_json:
        return
    files = {name: out / f"{name}.json" for name in ("manifest", "evaluation")}
    parts = {name: parse_json(file.read_text("utf-8")) if file.exists() else None for name, file in files.items()}
    show_json({"folder": str(out), **parts})


def print_result(outcome: RunOutcome, out: Path, as_json: bool, **more: Any) -> None:
    """Print the summary, or with --json the document, in which `more` stands too."""
    if not as_json:
        from lslam.reports.text import summary

        show(summary(outcome.record, outcome.evaluation))
        return
    from lslam.reports.evaluations import run_document

    score = run_document(outcome.record, outcome.evaluation)
    document = {"folder": str(out), "manifest": outcome.record.manifest, "evaluation": score, **more}
    show(json.dumps(document, default=str, allow_nan=False) + "\n")


@contextmanager
def profile_to(path: Path | None) -> Iterator[None]:
    """Write a profile of the block to `path`, also after an error; do nothing when it is None.

    Time in a kernel counts for the line of Python that calls it. Raises OutputError when `path` cannot be written.
    """
    if path is None:
        yield
        return
    profile = StackProfile()
    profile.start()
    try:
        yield
    finally:
        profile.stop()
        with atomic_write(path) as stream:
            stream.write(json.dumps(profile.speedscope(path.stem)).encode())


class StackProfile:
    """Stacks of all other threads, with the seconds spent in each."""

    def __init__(self) -> None:
        self._thread = threading.Thread(target=copy_context().run, args=(self._look,), name="profile", daemon=True)
        self._is_over = threading.Event()
        self._began = self._ended = 0.0
        self._interval_s, self._changes = INTERVAL_S, 0
        self._stacks: dict[tuple[Frame, ...], int] = {}
        self._names: dict[int, str] = {}
        # For each thread: its stacks one after the other, as [number, second it began, second it was last changes].
        self._by_thread: dict[int, list[list[Any]]] = {}

    def start(self) -> None:
        """Start sampling."""
        self._began = time.perf_counter()
        self._thread.start()

    def stop(self) -> None:
        """Stop sampling."""
        self._is_over.set()
        self._thread.join()
        self._ended = time.perf_counter()

    def _look(self) -> None:
        """Sample the stacks of all other threads until the end; the interval doubles after `MAX_STACKS` changes."""
        own = threading.get_ident()
        before = self._began
        while not self._is_over.wait(self._interval_s):
            now = time.perf_counter()
            self._names |= {t.ident: t.name for t in threading.enumerate() if t.ident is not None}
            for ident, frame in sys._current_frames().items():
                if ident != own:
                    self._add(ident, stack_of(frame), before, now)
            before = now
            if self._changes > MAX_STACKS:
                self._interval_s, self._changes = 2 * self._interval_s, 0

    def _add(self, ident: int, stack: tuple[Frame, ...], before: float, now: float) -> None:
        """Extend the thread's last interval if its stack is unchanged, else add one; `before`, `now` : s."""
        number = self._stacks.setdefault(stack, len(self._stacks))
        changes = self._by_thread.setdefault(ident, [])
        if changes and changes[-1][0] == number and changes[-1][2] == before:
            changes[-1][2] = now
            return
        self._changes += 1
        changes.append([number, before, now])

    def speedscope(self, name: str) -> dict[str, Any]:
        """Content of a file for https://www.speedscope.app, a profile for each thread, the busiest first."""
        frames: dict[Frame, int] = {}
        stacks = [[frames.setdefault(f, len(frames)) for f in stack] for stack in self._stacks]
        length = self._ended - self._began
        profiles = [
            {
                "type": "sampled",
                "name": self._names.get(ident, str(ident)),
                "unit": "seconds",
                "startValue": 0,
                "endValue": round(length, 6),
                **self._samples(changes, stacks),
            }
            for ident, changes in sorted(
                self._by_thread.items(), key=lambda item: -sum(end - begin for _, begin, end in item[1])
            )
        ]
        return {
            "$schema": "https://www.speedscope.app/file-format-schema.json",
            "exporter": f"lslam {__version__}",
            "name": name,
            "activeProfileIndex": 0,
            "shared": {"frames": [{"name": n, "file": file, "line": line} for n, file, line in frames]},
            "profiles": profiles,
        }

    def _samples(self, changes: list[list[Any]], stacks: list[list[int]]) -> dict[str, Any]:
        """Stacks and weights of a thread; an empty stack while it did not exist."""
        samples: list[list[int]] = []
        weights: list[float] = []
        at = self._began
        for number, begin, end in [*changes, [None, self._ended, self._ended]]:
            if begin > at:
                samples.append([])
                weights.append(round(begin - at, 6))
            if number is not None:
                samples.append(stacks[number])
                weights.append(round(end - begin, 6))
            at = end
        return {"samples": samples, "weights": weights}


def stack_of(frame: FrameType | None) -> tuple[Frame, ...]:
    """(name, file, line) of each frame, the outermost first; last comes the source line of the innermost."""
    stack: list[Frame] = []
    if frame is not None:
        # Between two lines a frame has no number.
        code, line = frame.f_code, frame.f_lineno or frame.f_code.co_firstlineno
        stack.append((linecache.getline(code.co_filename, line).strip() or f"line {line}", code.co_filename, line))
    while frame is not None:
        code = frame.f_code
        stack.append((code.co_qualname, code.co_filename, code.co_firstlineno))
        frame = frame.f_back
    return tuple(reversed(stack))
