"""report.html of a sensitivity study: one self-contained page, its figures beside it as PNG and SVG, its tables as text."""

from __future__ import annotations

import base64
from collections.abc import Sequence, Set
from dataclasses import dataclass
from pathlib import Path

from lslam.core.errors import OutputError, cause
from lslam.core.printable import count_of
from lslam.core.types.study import StudyResult, StudyRow
from lslam.io.formats.atomic import atomic_write
from lslam.reports.compare_table import CompareTable, as_text
from lslam.reports.shell import render
from lslam.reports.study_figures import StudyFigure, study_figures
from lslam.reports.study_table import means_grid, study_recipes, study_tables
from lslam.reports.text import comma_separated


@dataclass(frozen=True)
class StudySection:
    """One studied parameter on one sequence: its figures with their data, its tables."""

    result: StudyResult
    figures: list[tuple[StudyFigure, str]]
    tables: list[CompareTable]
    recipes: list[str]


def write_study_files(folder: Path, results: Sequence[StudyResult], rows: Sequence[StudyRow], title: str) -> None:
    """Write report.html, report.md, report.tex, report.csv and figures/*.png and *.svg, each atomically.

    rows : all of the study, for its head. Raises OutputError.
    """
    try:
        (folder / "figures").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"folder {folder / 'figures'} cannot be made: {cause(error)}") from None
    sections = []
    keys = {result.parameters[0] for result in results}
    for result in results:
        figures = list(study_figures(result))
        for figure in figures:
            stem = "-".join([*_words(result, keys), figure.name])
            _write(folder / "figures" / f"{stem}.png", figure.png)
            _write(folder / "figures" / f"{stem}.svg", figure.svg)
        data = [f"data:image/svg+xml;base64,{base64.b64encode(figure.svg).decode('ascii')}" for figure in figures]
        shown = list(zip(figures, data, strict=True))
        sections.append(StudySection(result, shown, study_tables(result), study_recipes(result)))
    page = render(
        "study.html.j2",
        title=title,
        rows=rows,
        failed=sum(not row.is_usable for row in rows),
        notes=timing_notes(rows),
        sections=sections,
    )
    _write(folder / "report.html", page.encode("utf-8", "replace"))
    for style, heading, item in (("md", "## {}", "- {}"), ("tex", "% {}", "% {}")):
        parts = [part for section in sections for part in _as_text(section, style, heading, item)]
        _write(folder / f"report.{style}", ("\n\n".join(parts) + "\n").encode("utf-8", "backslashreplace"))
    _write(folder / "report.csv", (comma_separated(means_grid(results)) + "\n").encode())


def timing_notes(rows: Sequence[StudyRow]) -> list[str]:
    """Reasons why findings about time are undecided, and how to decide them; empty when they are decided."""
    usable = [row for row in rows if row.is_usable]
    shared = sum(not row.is_timing_comparable for row in usable)
    if not shared:
        return []
    were_several = any(row.at_once > 1 for row in usable)
    return [
        f"{shared} of {count_of(len(usable), 'run')} shared a core or ran on a cluster: times of this study cannot be compared, "
        "and findings about time are left undecided. To have them judged, run it on an idle machine into another folder: "
        f"lslam sweep STUDY{' --jobs 1' if were_several else ''} --out DIR"
    ]


def _as_text(section: StudySection, style: str, heading: str, item: str) -> list[str]:
    result = section.result
    title = heading.format(f"{result.study}: {' and '.join(result.parameters)} on {result.sequence}")
    recipes = "\n".join(item.format(line) for line in section.recipes)
    return [title, *as_text(section.tables, style), recipes]


def _words(result: StudyResult, keys: Set[str]) -> list[str]:
    """File name parts that distinguish one result from others, safe for any file system.

    keys : of all results; the section is named where two have a key of the same name in it
    """
    key = result.parameters[0]
    last = key.rpartition(".")[2]
    is_clear = sum(other.rpartition(".")[2] == last for other in keys) == 1
    words = (result.study, result.sequence, last if is_clear else key)
    return ["".join(c if c.isalnum() or c in "._" else "_" for c in word) for word in words]


def _write(path: Path, content: bytes) -> None:
    with atomic_write(path) as stream:
        stream.write(content)
