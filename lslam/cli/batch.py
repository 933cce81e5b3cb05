"""`lslam batch`: many runs, one table, one exit code."""

from __future__ import annotations

import shlex
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lslam.cli import options
from lslam.cli.console import log, setup_logging, show, show_json
from lslam.core.errors import GateError, InputError, LslamError, RunFailedError, UsageError
from lslam.io.remote import RemotePath, as_path
from lslam.studies.options import BATCH, require_free

if TYPE_CHECKING:
    from lslam.core.types.study import StudyRow
    from lslam.studies.batch_runs import RunLine
    from lslam.studies.jobs import ExpandedStudy
    from lslam.studies.options import OutputOptions

# Options of `lslam run` that belong to the whole batch.
_OF_THE_BATCH = ("resume", "overwrite", "dry_run", "as_json")


@click.command(
    epilog="\b\nExamples: lslam batch JOBS.toml --out runs/tonight --resume\n"
    "          lslam batch - --out runs/tonight < lines.txt"
)
@click.argument("jobs_file", metavar="JOBS.toml|-", type=click.Path(path_type=Path))
@options.flag("--dry-run", "List the runs, write nothing.")
@options.study_output
@options.engine
@options.data_root
@options.set_in_all_runs
@options.flag("--strict", "Exit 4 when a run was degraded.")
@options.as_json
@options.verbosity
def command(jobs_file: Path, **given: Any) -> None:
    """Make many runs, each with its map and report, and a row of results.csv and results.parquet for each.

    JOBS.toml lists sequences, methods and settings; - reads lines of `lslam run` from stdin. Exit 0: all are done; 1: some
    failed or diverged.
    """
    setup_logging(given["verbose"], given["quiet"])
    options.check_engine(given)
    output = options.output_of(given, "batch")
    if not given["dry_run"]:
        require_free(output, BATCH)
    study = _expand(jobs_file, output, given)
    if given["dry_run"]:
        _print_plan(study, given["as_json"])
        return
    from lslam.cli.console import bars
    from lslam.studies.jobs import make_runs

    with options.engine_of(given, "runs", is_persistent=False) as engine, ExitStack() as stack:
        rows = make_runs(study, output, engine, bars(stack))
    _print(rows, output.out, given["as_json"])
    log.info("every run: %s", output.out / "results.csv")
    _judge(rows, given["strict"])


def _expand(path: Path, output: OutputOptions, given: dict[str, Any]) -> ExpandedStudy:
    """Jobs of a batch file, or of the lines `lslam run ...` on stdin if `path` is `-`. Raises UsageError without a line."""
    if path != Path("-"):
        from lslam.core.config.config import check_settings
        from lslam.core.config.study import read_batch

        check_settings(given["settings"])
        batch = read_batch(path)
        from lslam.studies.batch_runs import expand_batch

        return expand_batch(batch, output, given["settings"])
    from lslam.studies.batch_runs import expand_lines, run_words

    lines = [_line(number, words, given) for number, words in run_words(sys.stdin.read())]
    if not lines:
        raise UsageError("there is no line on stdin: write `lslam run SEQUENCE ...` on each")
    return expand_lines(lines, output)


def _line(number: int, words: list[str], given: dict[str, Any]) -> RunLine:
    """The run of one line, parsed as by `lslam run`; raises the errors of that command with the number of the line."""
    from lslam.cli.one_run import read_truth
    from lslam.cli.run import command as run_command
    from lslam.cli.run import open_with, resolve
    from lslam.io.readers import find_folder
    from lslam.studies.batch_runs import listed_line, opened_line, refused_line

    try:
        run = run_command.make_context("run", list(words)).params
        if run["sequence"] is None or run["again"] is not None:
            raise UsageError("a line names its SEQUENCE, and has no --again")
        if wrong := [name for name in _OF_THE_BATCH if run[name]]:
            raise UsageError(
                f"--{wrong[0].removeprefix('as_').replace('_', '-')} is no option of a line: give it to lslam batch"
            )
        run["settings"] = (*run["settings"], *given["settings"])
        run["data_root"] = run["data_root"] or given["data_root"]
        text, folder, reading = shlex.join(words), run["out"], options.reading_of(run)
        place = as_path(run["sequence"])
        if run["gt"] is None and isinstance(place, RemotePath):
            return listed_line(text, find_folder(place), resolve(run), folder, **reading)
        try:
            sequence, config = open_with(run)
            return opened_line(text, sequence, config, read_truth(run["gt"], sequence), folder, **reading)
        except InputError as error:
            # One recording of hundreds that cannot be read is a failed run, not the end of all.
            return refused_line(text, place.expanduser().absolute(), resolve(run), folder, f"line {number}: {error}")
    except LslamError as error:
        raise type(error)(f"line {number}: {error}") from None
    except click.UsageError as error:
        raise UsageError(f"line {number}: {error.format_message()}") from None
    except click.exceptions.Exit:  # of --help, which has printed it
        raise UsageError(f"line {number}: --help is no run, give it to lslam run") from None


def _print_plan(study: ExpandedStudy, as_json: bool) -> None:
    """Print the jobs with their folders and refusals."""
    if as_json:
        runs = [
            {
                **{name: getattr(job, name) for name in ("sequence", "method", "seed")},
                "path": str(job.path),
                "folder": str(job.folder),
                "refusal": job.refusal or None,
            }
            for job in study.jobs
        ]
        show_json({"runs": runs})
        return
    show("".join(f"{job.name}  {job.folder}{f'  ({job.refusal})' if job.refusal else ''}\n" for job in study.jobs))


def _print(rows: list[StudyRow], out: Path, as_json: bool) -> None:
    """Print the results as a table or JSON."""
    from lslam.reports.study_table import batch_table, rows_document
    from lslam.reports.text import text_table

    if as_json:
        show_json({"folder": str(out), "results": str(out / "results.csv"), "runs": rows_document(rows)})
    else:
        show(text_table(batch_table(rows), 3) + "\n")


def _judge(rows: list[StudyRow], is_strict: bool) -> None:
    """Raise RunFailedError when a run failed, and GateError with --strict when one was degraded."""
    failed = [row for row in rows if not row.is_usable]
    if failed:
        raise RunFailedError(
            f"{len(failed)} of {len(rows)} runs failed, the first one, {failed[0].run}: {failed[0].reason}"
        )
    degraded = [row for row in rows if row.status == "degraded"]
    if degraded and is_strict:
        raise GateError(
            f"--strict: {len(degraded)} of {len(rows)} runs are degraded, the first one: {degraded[0].reason}"
        )
