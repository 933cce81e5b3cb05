"""`lslam sweep`: sensitivity studies."""

from __future__ import annotations

import time
from contextlib import ExitStack
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lslam.cli import options
from lslam.cli.console import log, setup_logging, show, show_json

if TYPE_CHECKING:
    from lslam.core.types.study import StudyRow
    from lslam.studies.study_runs import Sweep


@click.command(
    epilog="\b\nExamples: lslam sweep --list\n"
    "          lslam sweep skip-frames --dry-run --pilot\n"
    "          lslam sweep STUDY.toml --out runs/shares --jobs 2\n"
    "          lslam sweep STUDY.toml --out runs/shares --scheduler tcp://node1:8786 --resume\n"
    "          lslam sweep --report runs/shares"
)
@click.argument("study", required=False)
@options.flag("--list", "show_list", "List the studies that ship with lslam.")
@options.flag("--dry-run", "List and count the runs, estimate their time by finished ones, and stop.")
@options.flag("--pilot", "With --dry-run: estimate the time by a few short runs.")
@options.study_output
@options.path("--report", "DIR", "Write the report of the study in DIR anew from its results.csv, run nothing.")
@options.engine
@options.option("--seeds", "N,N,...", "Seeds instead of the study's.")
@options.data_root
@options.set_in_all_runs
@options.flag("--strict", "Exit 4 when any run failed or diverged.")
@options.as_json
@options.verbosity
def command(study: str | None, **given: Any) -> None:
    """Vary parameters over sequences, methods and seeds; every run is a row of results.csv, and of results.parquet
    with the extra `parquet`; report.html shows the findings.

    STUDY is a file, or a name of --list. Each of its sequences can have its own start, count and skip_frames. A run that fails
    or diverges is a row with its reason. Findings about time are decided when every run had a core of its own: use an idle
    machine, and --jobs 1 where in doubt.
    """
    if given["show_list"]:
        _print_list(given["as_json"])
        return
    setup_logging(given["verbose"], given["quiet"])
    if given["report"] is not None:
        if study is not None:
            raise click.UsageError(f"--report writes the report of a folder and runs nothing: leave out {study}")
        _print_verdicts(_report(given["report"]), given["report"], None, given["as_json"])
        return
    if given["pilot"] and not given["dry_run"]:
        raise click.UsageError("--pilot estimates the time of a --dry-run: give both")
    if study is None:
        raise click.UsageError("STUDY is missing; for example: lslam sweep skip-frames --dry-run")
    options.check_engine(given)
    sweep = _sweep(study, given)
    from lslam.core.errors import GateError
    from lslam.studies.study_runs import run_sweep

    with options.engine_of(given, "studying") as engine, ExitStack() as stack:
        from lslam.cli.console import bars, best_so_far

        if given["dry_run"]:
            _print_plan(sweep, engine.at_once, given["pilot"], stack, given["as_json"])
            return
        on_rows = stack.enter_context(best_so_far())
        rows = run_sweep(sweep, engine, bars(stack), on_rows)
    if not given["as_json"]:
        _print(rows)
    without = [row for row in rows if row.is_usable and isnan(row.error)]
    if without:
        reason = without[0].reason or "its metric is not available"
        log.warning("%d of %d runs have no score, the first one: %s", len(without), len(rows), reason)
    log.info("every run: %s", sweep.output.out / "results.csv")
    _print_verdicts(_report(sweep.output.out), sweep.output.out, rows, given["as_json"])
    failed = [row for row in rows if not row.is_usable]
    if failed and given["strict"]:
        raise GateError(f"--strict: {len(failed)} of {len(rows)} runs failed, the first one: {failed[0].reason}")


def _sweep(word: str, given: dict[str, Any]) -> Sweep:
    """The study that the options describe. They are checked as far as possible before heavy imports."""
    seeds = None if given["seeds"] is None else options.seeds_of(given["seeds"])
    from lslam.core.config.config import check_settings
    from lslam.core.config.study import parse_study
    from lslam.studies.options import STUDY, find_study, require_free

    check_settings(given["settings"])
    study = find_study(word)
    if seeds is not None:
        study = parse_study(study.model_dump(exclude_unset=True) | {"seeds": seeds}, "--seeds", study.name)
    output = options.output_of(given, study.name)
    if not given["dry_run"]:
        require_free(output, STUDY)
    from lslam.studies.study_runs import Sweep

    return Sweep(study, output, given["settings"])


def _print(rows: list[StudyRow]) -> None:
    """Print the table of the best result of each method."""
    from lslam.reports.study_table import best_table
    from lslam.reports.text import text_table

    show(text_table(best_table(rows), 2) + "\n")


def _report(folder: Path) -> list[str]:
    """Write the report. Returns the sentences of its verdicts."""
    options.require_there(folder / "results.csv")
    from lslam.studies.study_runs import report_folder

    verdicts = [verdict.sentence for result in report_folder(folder) for verdict in result.verdicts]
    log.info("report: %s", folder / "report.html")
    return verdicts


def _print_verdicts(verdicts: list[str], folder: Path, rows: list[StudyRow] | None, as_json: bool) -> None:
    """Print the verdicts, as JSON with the folder and the rows if there are some."""
    if not as_json:
        show("".join(f"{verdict}\n" for verdict in verdicts))
        return
    document: dict[str, Any] = {"folder": str(folder), "results": str(folder / "results.csv")}
    if rows is not None:
        from lslam.reports.study_table import rows_document

        document["runs"] = rows_document(rows)
    document["verdicts"] = verdicts
    show_json(document)


def _print_list(as_json: bool) -> None:
    """Print the studies with their summaries."""
    from lslam.studies.options import find_study, study_names

    summaries = {name: find_study(name).summary for name in study_names()}
    if as_json:
        show_json({"studies": summaries})
    else:
        show("".join(f"{name:<22}  {summary}\n" for name, summary in summaries.items()))


def _print_plan(sweep: Sweep, at_once: int, by_pilots: bool, stack: ExitStack, as_json: bool) -> None:
    """Print every run, their number, and the estimated time of those that are not finished."""
    from lslam.cli.console import bars
    from lslam.studies.estimate import estimate, extrapolate
    from lslam.studies.jobs import left_to_do
    from lslam.studies.study_runs import expand_study

    study = expand_study(sweep)
    rest = left_to_do(sweep.output, study.jobs)
    summary = f"{len(study.jobs)} runs, {len(rest)} left to do"
    if not as_json:
        show("".join(f"{job.name}\n" for job in study.jobs))
    if rest and by_pilots:
        guess = estimate(rest, study.variants, at_once, bars(stack), time.process_time())
        summary += f": about {guess.text}, {at_once} at once ({guess.pilots} pilot runs)"
    elif rest:
        earlier = extrapolate(study.jobs, rest, study.variants, at_once)
        if earlier is None:
            summary += "; --pilot estimates their time by a few short runs"
        else:
            summary += f": about {earlier.text}, {at_once} at once (as the finished ones took)"
    if as_json:
        names = {"runs": [job.name for job in study.jobs], "left_to_do": [job.name for job in rest]}
        show_json(names | {"summary": summary})
    else:
        show(f"{summary}\n")
