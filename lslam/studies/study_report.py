"""The report of a sensitivity study, from its rows alone."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from lslam.config.finding import FindingConfig
from lslam.config.study import read_study
from lslam.errors import InputError
from lslam.evaluation.sensitivity import evaluate_study
from lslam.formats.study_csv import read_study_csv
from lslam.reports.study_html import timing_notes, write_study_files
from lslam.studies.results import RESULTS
from lslam.studies.sweep import MARK
from lslam.types.sensitivity import StudyResult
from lslam.types.study import StudyRow

log = logging.getLogger("lslam")


def write_study_report(
    folder: Path, rows: Sequence[StudyRow], findings: Sequence[FindingConfig] = (), title: str = ""
) -> list[StudyResult]:
    """Evaluate all rows and write report.html, .md, .tex, .csv and figures/ into `folder`.

    findings : what the study is expected to find, for the verdicts; title : of the page, the names of the studies by default
    Raises OutputError.
    """
    results = evaluate_study(rows, findings)
    write_study_files(folder, results, rows, title or ", ".join(dict.fromkeys(row.study for row in rows)))
    return results


def report_folder(folder: Path) -> list[StudyResult]:
    """The report of a study from its results.csv, with the findings of its study.toml when that is there.

    Says so in the log when its times cannot be compared.

    Raises InputError for a folder without runs and what cannot be read, ConfigError for findings that make no sense, OutputError.
    """
    rows = read_study_csv(folder / RESULTS)
    if not rows:
        raise InputError(f"study {folder} has no finished run yet: lslam sweep with --out {folder} --resume makes them")
    for note in timing_notes(rows):
        log.warning("%s", note)
    if not (folder / MARK).is_file():
        return write_study_report(folder, rows)
    study = read_study(folder / MARK)
    return write_study_report(folder, rows, study.finding, study.summary or study.name)
