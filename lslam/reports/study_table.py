"""A study as tables: verdicts, landmarks, laws, means, failures; the best points while it runs; the runs of a batch.

Its report.html is one self-contained page, with figures beside it as PNG and SVG, and tables as text.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Sequence, Set
from dataclasses import asdict, dataclass
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from lslam.core.config.config import with_unit
from lslam.core.errors import OutputError, cause
from lslam.core.printable import count_of, metres, with_decimals
from lslam.core.types.study import CurveResult, Interval, Law, StudyResult, StudyRow
from lslam.evaluation import ALIGNMENTS
from lslam.evaluation.curves import normalise
from lslam.io.formats.atomic import atomic_write
from lslam.reports.compare_table import CompareTable, as_text
from lslam.reports.evaluations import strict
from lslam.reports.shell import render
from lslam.reports.study_figures import StudyFigure, study_figures
from lslam.reports.text import Grid, csv_table

UNKNOWN = "-"
LABELS = {"ate_se3": "ATE se3", "ate_origin": "ATE origin", "thesis_rmse": "thesis_rmse"}
TRANSLATION = {
    "ate_se3": f"ATE rmse over poses, {ALIGNMENTS['se3']}",
    "ate_origin": f"ATE rmse over poses, {ALIGNMENTS['origin']}",
    "thesis_rmse": "rmse over the 3N coordinates with the first poses put on each other (Girolimetto, equation 2.14 over the "
    "root of 3)",
}
# Columns of the table for programs, by quantity.
_UNITS = {
    "translation": "m",
    "angular": "deg",
    "time_per_scan": "ms",
    "total_time": "s",
    "fallback": "%",
    "efficiency": "1/(m deg s)",
    "total_efficiency": "1/(m deg s)",
}


def study_tables(result: StudyResult) -> list[CompareTable]:
    """All tables of a study that are not empty."""
    tables = [_verdicts(result), _landmarks(result), _laws(result), _means(result), _beside(result), _failures(result)]
    return [table for table in tables if table.rows]


def means_grid(results: Sequence[StudyResult]) -> Grid:
    """One row per curve and value, numbers in full, empty where unknown: mean, ends of its 95 % interval, median."""
    head = ["study", "sequence", "method", "imu", "parameter", "value", "at", "runs", "lost"]
    head += [f"{name}{end} ({unit})" for name, unit in _UNITS.items() for end in ("", "_low", "_high", "_median")]
    grid = [head]
    for result in results:
        for r in result.results:
            curve = r.curve
            at = "; ".join(f"{key}={value}" for key, value in curve.at)
            for v, value in enumerate(curve.values):
                row = [result.study, result.sequence, curve.method, str(curve.uses_imu).lower(), curve.parameter]
                row += [curve.name_of(value), at, str(int(curve.ran[v].sum())), str(int(curve.losses[v].sum()))]
                for name in _UNITS:
                    m = r.means[name]
                    numbers = (m.mean[v], m.low[v], m.high[v], r.medians[name][v])
                    row += [f"{x:.9g}" if math.isfinite(x) else "" for x in numbers]
                grid.append(row)
    return grid


def study_recipes(result: StudyResult) -> list[str]:
    """Definitions of the numbers, one sentence each."""
    return [
        f"translation: {TRANSLATION[result.metric]}; rotation: equation 2.15 of Girolimetto",
        "registration: all stages of a scan but reading, preparing, standing still and keyframes",
        "E: 1 over translation, rotation and registration time per scan (equation 5.2); E tot: with the total time (5.3); both "
        "over the largest of the curve; median over seeds, a lost run counts as 0",
        "recovered: scans that a recovery policy or a fallback posed",
        f"lost: a run that says so, or whose error is above {result.lost_above:.3g} m: 10 times the best of the study, and not "
        "less than Girolimetto takes for a result (2.2 m)",
        "diverges: the first value, lost in more than half of its runs, from which on more than half of the values are",
        "laws: weighted least squares over means of the runs that were not lost, scatter in proportion to the time, from 6 "
        "values on; ± and bands at 99 %; R2 of those means in s, unweighted",
        "±: half of the 95 % interval over seeds (Student's t), of runs that were not lost",
        "best values, elbows and verdicts go by medians over seeds",
        "verdicts: one value is worse than another by more than 10 % and more than the seeds scatter (one standard deviation of "
        "their log ratios); what the scatter hides is undecided, and so is what one seed says, laws and divergence aside",
    ]


def _verdicts(result: StudyResult) -> CompareTable:
    """Table of the verdicts on expected findings."""
    rows = tuple((v.outcome, v.text, v.numbers, v.source or UNKNOWN) for v in result.verdicts)
    return CompareTable("findings", ("verdict", "finding", "here", "source"), rows, 4)


def _landmarks(result: StudyResult) -> CompareTable:
    """Table of divergence, best values and lost runs of each curve."""
    header = ("method", "diverges from", "last good value", "best E at", "within 10 %", "least error at", "lost/runs")
    rows = []
    for r in result.results:
        curve, found = r.curve, r.divergence
        name = curve.name_of
        least = np.where(curve.loses_most, np.nan, r.medians["translation"])
        cells = ["no result" if not curve.with_score.any() else "nowhere", UNKNOWN]
        if found.first_bad is not None:
            cells = [name(found.first_bad), UNKNOWN if found.last_good is None else name(found.last_good)]
        cells += [UNKNOWN] * 2 if r.optimum is None else [name(r.optimum.value), _range(r)]
        cells.append(name(curve.values[np.nanargmin(least)]) if np.isfinite(least).any() else UNKNOWN)
        rows.append((curve.label, *cells, f"{curve.losses.sum()}/{curve.ran.sum()}"))
    return CompareTable(f"landmarks of {with_unit(result.parameters[0])}", header, tuple(rows), 1)


def _laws(result: StudyResult) -> CompareTable:
    """Table of the laws of total time, or of the reason why there is none."""
    header = ("method", "total time, s", "coefficients at 99 %", "R2", "largest residual", "points")
    rows = [_law_row(series, law) for series, law in result.products.items()]
    for r in result.results:
        if r.law is not None:
            rows.append(_law_row(r.curve.label, r.law))
        elif r.curve.ran.any():
            rows.append((r.curve.label, r.no_law, *[UNKNOWN] * 4))
    return CompareTable("laws of total time", header, tuple(rows), 2)


def _law_row(name: str, law: Law) -> tuple[str, ...]:
    """Cells of a law: formula, coefficients, R2, largest residual, number of points."""
    pairs = zip(law.coefficients, law.margins, strict=True)
    coefficients = ", ".join(f"{value:.4g} ± {margin:.2g}" for value, margin in pairs)
    worst = f"{100 * np.abs(law.residuals).max():.1f} %"
    return name, law.text, coefficients, f"{law.r2:.4f}", worst, str(len(law.times))


def _means(result: StudyResult) -> CompareTable:
    """Table of means over seeds at each value, with normalised efficiencies; 1 is marked as the best."""
    key = result.parameters[0]
    head = (
        "method",
        with_unit(key, key.rpartition(".")[2]),
        "translation, m",
        "rotation, deg",
        "registration, ms",
        "total, s",
        "recovered, %",
        "E",
        "E tot",
        "lost/runs",
    )
    rows: list[tuple[str, ...]] = []
    best = set()
    for r in result.results:
        curve, share = r.curve, [normalise(r.medians[name]) for name in ("efficiency", "total_efficiency")]
        for v, value in enumerate(curve.values):
            cells = [_mean(r.means[name], v, name) for name in _UNITS if not name.endswith("efficiency")]
            cells += [with_decimals(e[v], 2) if math.isfinite(e[v]) else UNKNOWN for e in share]
            best |= {(len(rows), 7 + k) for k, e in enumerate(share) if e[v] == 1}
            rows.append((curve.label, curve.name_of(value), *cells, f"{curve.losses[v].sum()}/{curve.ran[v].sum()}"))
    return CompareTable("means over seeds", head, tuple(rows), 1, frozenset(best))


def _beside(result: StudyResult) -> CompareTable:
    """Table of the reference runs beside the study."""
    rows = tuple((row.series, str(row.seed), *_numbers(row)) for row in result.beside)
    header = ("method", "seed", "translation, m", "rotation, deg", "per scan, ms", "total, s")
    return CompareTable("beside, at its own values", header, rows, 1)


def _failures(result: StudyResult) -> CompareTable:
    """Table of the runs without a result, with outcome and reason."""
    rows = tuple(
        (
            row.series,
            ", ".join(f"{key.rpartition('.')[2]} {value}" for key, value in row.parameters.items()) or "beside",
            str(row.seed),
            row.status,
            row.reason,
        )
        for row in result.failed
    )
    title = f"{count_of(len(rows), 'run')} without a result"
    return CompareTable(title, ("method", "at", "seed", "outcome", "reason"), rows, 5)


def _numbers(row: StudyRow) -> Iterable[str]:
    """Errors and times of a run as texts."""
    yield metres(row.error) if math.isfinite(row.error) else UNKNOWN
    for value, decimals in ((row.angular_rmse_deg, 3), (row.time_per_scan_ms, 1), (row.total_time_s, 2)):
        yield with_decimals(value, decimals) if math.isfinite(value) else UNKNOWN


def _mean(means: Interval, v: int, name: str) -> str:
    """Mean over seeds at value number v in the decimals of the quantity, ± half of the confidence interval."""
    mean = float(means.mean[v])
    if not math.isfinite(mean):
        return UNKNOWN
    text = (
        metres(mean)
        if name == "translation"
        else with_decimals(mean, {"angular": 3, "time_per_scan": 1, "total_time": 2, "fallback": 1}[name])
    )
    half = float(means.high[v] - mean)
    return f"{text} ± {with_decimals(half, len(text.partition('.')[2]))}" if math.isfinite(half) else text


def _range(result: CurveResult) -> str:
    """Range of nearly best values of a curve, as text."""
    assert result.optimum is not None
    low, high = (result.curve.name_of(value) for value in (result.optimum.low, result.optimum.high))
    return low if low == high else f"{low} to {high}"


@dataclass(frozen=True)
class Best:
    """One method on one sequence: how many runs have ended and failed, and the point with the least mean error.

    point : rows of that point, one per seed; empty when no point is without a failed run
    """

    sequence: str
    method: str
    runs: int
    failures: int
    point: tuple[StudyRow, ...]

    def mean(self, name: str) -> float:
        """Mean of a number over the seeds of the best point."""
        return float(sum(getattr(row, name) for row in self.point)) / len(self.point)


def best_points(rows: Sequence[StudyRow]) -> list[Best]:
    """Best point per sequence and method, in the order of the rows; runs with IMU, and runs beside the study, are separate."""
    groups: dict[tuple[str, str], list[StudyRow]] = {}
    for row in rows:
        groups.setdefault((row.sequence, label(row)), []).append(row)
    return [
        Best(sequence, method, len(group), sum(not row.is_usable for row in group), _best(group))
        for (sequence, method), group in groups.items()
    ]


def label(row: StudyRow) -> str:
    """Display name of a row's method.

    >>> label(StudyRow("", "", "open", 0, "icp", uses_imu=True, is_beside=True))
    'icp+imu (beside)'
    """
    return f"{row.method}{'+imu' if row.uses_imu else ''}{' (beside)' if row.is_beside else ''}"


def best_table(rows: Sequence[StudyRow]) -> Grid:
    """Header and a line per method."""
    metric = LABELS[rows[0].metric] if rows else "error"
    header = ["sequence", "method", "runs", "failed", "best at", f"{metric}, m", "angular, deg", "total, s"]
    return [header, *(_line(best) for best in best_points(rows))]


def batch_table(rows: Sequence[StudyRow]) -> Grid:
    """Header and a line per run of a batch: how it ended, its errors, and where it lies or why it failed."""
    header = ["sequence", "method", "status", "scans", "ATE se3, m", "ms per scan", "total, s", "folder or reason"]
    lines = []
    for row in rows:
        numbers = [f"{row.ate_se3:.3f}", f"{row.time_per_scan_ms:.1f}", f"{row.run_s:.1f}"]
        shown = ["-" if number == "nan" else number for number in numbers]
        end = row.folder if row.is_usable else row.reason
        lines.append([row.sequence, label(row), row.status, str(row.scans), *shown, end])
    return [header, *lines]


def rows_document(rows: Sequence[StudyRow]) -> list[dict[str, Any]]:
    """The rows as plain values for JSON, None for a number that is not there."""
    documents = strict([asdict(row) for row in rows])
    assert isinstance(documents, list)
    return documents


def _best(rows: Sequence[StudyRow]) -> tuple[StudyRow, ...]:
    """Rows of the parameters with the smallest mean error, of which no run failed; empty without one."""
    points: dict[str, list[StudyRow]] = {}
    for row in rows:
        points.setdefault(repr(row.parameters), []).append(row)
    best: tuple[StudyRow, ...] = ()
    least = inf
    for point in points.values():
        error = sum(row.error if row.is_usable else inf for row in point) / len(point)
        if error < least:  # never with nan, without ground truth
            best, least = tuple(point), error
    return best


def _line(best: Best) -> list[str]:
    """Cells of the best parameters of a method, with mean errors and time."""
    head = [best.sequence, best.method, str(best.runs), str(best.failures)]
    if not best.point:
        return [*head, "-", "-", "-", "-"]
    at = ", ".join(f"{key.partition('.')[2]} {value}" for key, value in best.point[0].parameters.items())
    errors = [f"{best.mean('error'):.3f}", f"{best.mean('angular_rmse_deg'):.2f}"]
    return [*head, at or "its own values", *errors, f"{best.mean('total_time_s'):.2f}"]


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
            stem = "-".join([*_file_words(result, keys), figure.name])
            _write_bytes(folder / "figures" / f"{stem}.png", figure.png)
            _write_bytes(folder / "figures" / f"{stem}.svg", figure.svg)
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
    _write_bytes(folder / "report.html", page.encode("utf-8", "replace"))
    for style, heading, item in (("md", "## {}", "- {}"), ("tex", "% {}", "% {}")):
        parts = [part for section in sections for part in _section_text(section, style, heading, item)]
        _write_bytes(folder / f"report.{style}", ("\n\n".join(parts) + "\n").encode("utf-8", "backslashreplace"))
    _write_bytes(folder / "report.csv", (csv_table(means_grid(results)) + "\n").encode())


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


def _section_text(section: StudySection, style: str, heading: str, item: str) -> list[str]:
    """Title, tables and recipes of a section in the format `style`; heading, item : their patterns."""
    result = section.result
    title = heading.format(f"{result.study}: {' and '.join(result.parameters)} on {result.sequence}")
    recipes = "\n".join(item.format(line) for line in section.recipes)
    return [title, *as_text(section.tables, style), recipes]


def _file_words(result: StudyResult, keys: Set[str]) -> list[str]:
    """File name parts that distinguish one result from others, safe for any file system.

    keys : of all results; the section is named where two have a key of the same name in it
    """
    key = result.parameters[0]
    last = key.rpartition(".")[2]
    is_clear = sum(other.rpartition(".")[2] == last for other in keys) == 1
    words = (result.study, result.sequence, last if is_clear else key)
    return ["".join(c if c.isalnum() or c in "._" else "_" for c in word) for word in words]


def _write_bytes(path: Path, content: bytes) -> None:
    """Write a file atomically."""
    with atomic_write(path) as stream:
        stream.write(content)
