"""The report of a sensitivity study, from its rows alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lslam.config.finding import Finding
from lslam.evaluation.sensitivity import evaluate_study
from lslam.reports.study_html import write_study_files
from lslam.types.sensitivity import StudyResult
from lslam.types.study import StudyRow


def write_study_report(
    folder: Path, rows: Sequence[StudyRow], findings: Sequence[Finding] = (), title: str = ""
) -> list[StudyResult]:
    """Evaluate all rows and write report.html, .md, .tex, .csv and figures/ into `folder`.

    findings : what the study is expected to find, for the verdicts; title : of the page, the names of the studies by default
    Raises OutputError.
    """
    results = evaluate_study(rows, findings)
    write_study_files(folder, results, rows, title or ", ".join(dict.fromkeys(row.study for row in rows)))
    return results
