"""What the commands share that make a run: its arguments, ground truth and progress, and its result as it is printed."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lslam.cli.console import Stages, log, show
from lslam.core.errors import RunFinishedError
from lslam.core.stopping import Stop, handle_signals
from lslam.core.untrusted import parse_json

if TYPE_CHECKING:
    from lslam.core.types.sequence import Sequence
    from lslam.core.types.trajectory import Trajectory
    from lslam.pipeline.watch import RunOutcome, Watch


@contextmanager
def arguments_of(
    out: Path, given: dict[str, Any], finish: Callable[[RunOutcome], None] | None = None
) -> Iterator[dict[str, Any]]:
    """Context with the arguments of `lslam.pipeline.run.run`; prints the result of a run that is finished already.

    finish : called with the outcome in place of what prints it
    """
    from lslam.cli.profiling import profiled

    try:
        with handle_signals() as stop, profiled(given.get("profile")), ExitStack() as stack:
            watch = watch_of(stack, stop, finish or (lambda outcome: print_result(outcome, out, given["as_json"])))
            command = shlex.join(["lslam", *sys.argv[1:]])
            yield {
                "out": out,
                "overwrite": given["overwrite"],
                "resume": given["resume"],
                "command": command,
                "watch": watch,
            }
    except RunFinishedError as finished:
        log.info("%s", finished)
        _print_finished(out, given["as_json"])


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
    from lslam.pipeline.watch import BEFORE_SCANS, Watch

    stages = Stages(stack)

    def on_start(stage: str, total: int) -> None:
        stages.begin(stage, total)
        stop.is_gentle = stage not in BEFORE_SCANS

    def on_end(outcome: RunOutcome) -> None:
        stages.end()
        finish(outcome)

    return Watch(on_start, stages.step, on_end, stop)


def _print_finished(out: Path, as_json: bool) -> None:
    """Print the existing result for --json; the log states that nothing was done."""
    if not as_json:
        return
    evaluation = out / "evaluation.json"
    score = parse_json(evaluation.read_text(encoding="utf-8")) if evaluation.exists() else None
    document = {
        "folder": str(out),
        "manifest": parse_json((out / "manifest.json").read_text("utf-8")),
        "evaluation": score,
    }
    show(json.dumps(document, allow_nan=False) + "\n")


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
