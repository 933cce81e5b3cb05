"""Runs of a sensitivity study, at every point of its parameters, and its report."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from lslam.core.config.study import ExpectedFinding, StudyConfig, read_study
from lslam.core.errors import InputError, RunFailedError
from lslam.core.printable import toml_text
from lslam.core.types.study import StudyResult, StudyRow
from lslam.studies.grid import cells_of, expand
from lslam.studies.jobs import Engine, ExpandedStudy, check_same, make_runs
from lslam.studies.options import STUDY, OutputOptions
from lslam.studies.results import RESULTS
from lslam.studies.results_csv import read_study_csv
from lslam.studies.runner import StudyProgress
from lslam.studies.variants import study_variants

log = logging.getLogger("lslam")


@dataclass(frozen=True)
class Sweep:
    """Study, sequences and options of a sweep; settings : "a.b=v", overriding those of the study."""

    study: StudyConfig
    output: OutputOptions
    settings: tuple[str, ...] = ()


def expand_study(sweep: Sweep) -> ExpandedStudy:
    """All runs, checked before any begins; nothing is simulated or written.

    Raises ConfigError, UsageError or InputError for parameters, methods, recordings and scenarios that make no sense;
    OutputExistsError when it is to go on in the folder of another study.
    """
    study, output = sweep.study, sweep.output
    text = toml_text(study.model_dump(mode="json", exclude_none=True, exclude_defaults=True))
    check_same(output, STUDY, text, lambda tree: [str(tree.get("name"))])
    variants = study_variants(study, sweep.settings)
    cells = cells_of(study.sequences, study.seeds, variants, output, sweep.settings)
    jobs = expand(cells, variants, study.seeds, output.out, output.command)
    return ExpandedStudy(study.name, STUDY, text, jobs, {v.name: v for v in variants}, study.metric)


def run_sweep(
    sweep: Sweep,
    engine: Engine,
    progress: StudyProgress | None = None,
    on_rows: Callable[[Sequence[StudyRow]], None] = lambda rows: None,
) -> list[StudyRow]:
    """Make all runs of a study. Raises as `expand_study` and `make_runs`, RunFailedError when all runs failed."""
    rows = make_runs(expand_study(sweep), sweep.output, engine, progress, on_rows)
    if rows and not any(row.is_usable for row in rows):
        raise RunFailedError(f"all {len(rows)} runs failed, the first one: {rows[0].reason}")
    return rows


def write_study_report(
    folder: Path, rows: Sequence[StudyRow], findings: Sequence[ExpectedFinding] = (), title: str = ""
) -> list[StudyResult]:
    """Evaluate all rows and write report.html, .md, .tex, .csv and figures/ into `folder`.

    findings : what the study is expected to find, for the verdicts; title : of the page, the names of the studies by default
    Raises OutputError.
    """
    from lslam.evaluation.sensitivity import evaluate_study
    from lslam.reports.study_table import write_study_files

    results = evaluate_study(rows, findings)
    write_study_files(folder, results, rows, title or ", ".join(dict.fromkeys(row.study for row in rows)))
    return results


def report_folder(folder: Path) -> list[StudyResult]:
    """The report of a study from its results.csv, with the findings of its study.toml when that is there.

    Says so in the log when its times cannot be compared.

    Raises InputError for a folder without runs and what cannot be read, ConfigError for findings that make no sense, OutputError.
    """
    from lslam.reports.study_table import timing_notes

    rows = read_study_csv(folder / RESULTS)
    if not rows:
        raise InputError(f"study {folder} has no finished run yet: lslam sweep with --out {folder} --resume makes them")
    for note in timing_notes(rows):
        log.warning("%s", note)
    if not (folder / STUDY).is_file():
        return write_study_report(folder, rows)
    study = read_study(folder / STUDY)
    return write_study_report(folder, rows, study.finding, study.summary or study.name)
