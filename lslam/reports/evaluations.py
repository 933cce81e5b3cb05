"""Evaluations as `evaluation.json` and as tables.

The document has every value beside its recipe, under a schema with a version. Tables have one column per estimate, for the
terminal, Markdown, CSV and LaTeX.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict
from itertools import zip_longest
from typing import Any

from lslam.core import __version__
from lslam.core.printable import significant
from lslam.core.types.run_record import Crispness, RunRecord
from lslam.evaluation.evaluate import METRICS, shown_metrics
from lslam.evaluation.metric import Evaluation, MetricRow
from lslam.evaluation.timing import StageTime, Timing
from lslam.reports.text import csv_table, latex, markdown, text_table

SCHEMA, VERSION = "lslam-evaluation", 1
Document = dict[str, Any]
STYLES = ("text", "md", "csv", "tex")


def to_document(evaluation: Evaluation, timing: Timing | None = None) -> Document:
    """The evaluation as plain values, ready for `json.dumps`; numbers that are NaN or infinite become None."""
    e = evaluation
    document = {
        "schema": SCHEMA,
        "version": VERSION,
        "lslam": __version__,
        "estimate": e.estimate,
        "ground_truth": e.ground_truth,
        "association": {
            "recipe": e.association,
            "matched": e.matched,
            "possible": e.possible,
            "time_offset_s": e.time_offset,
        },
        "path_length_m": e.path_length,
        "notes": list(e.notes),
        **{metric.key: metric.document(e.scores[metric.key]) for metric in METRICS},
        "timing": None if timing is None else {"recipe": "s per scan, from timing.csv", **asdict(timing)},
    }
    if e.odometry is not None:
        whole = to_document(e.odometry)
        kept = ("association", "path_length_m", *(metric.key for metric in METRICS))
        document["odometry"] = {"recipe": "of the poses before the pose graph"} | {name: whole[name] for name in kept}
    plain = strict(document)
    assert isinstance(plain, dict)
    return plain


def run_document(record: RunRecord, evaluation: Evaluation | None) -> Document | None:
    """Document of a run: its evaluation, and the entropy scores of its map; None when neither is known."""
    if evaluation is None and record.crispness is None:
        return None
    document: Document = {"schema": SCHEMA, "version": VERSION, "lslam": __version__, "estimate": record.method}
    if evaluation is not None:
        document = to_document(evaluation)
    if record.crispness is not None:
        document["map"] = {"file": record.map_file, **crispness_document(record.crispness)}
    return document


def crispness_document(score: Crispness) -> Document:
    """Map entropy scores as plain values."""
    thickness = None if score.plane_variance is None else math.sqrt(score.plane_variance)
    plain = strict({"recipe": score.recipe, **asdict(score), "plane_thickness_m": thickness})
    assert isinstance(plain, dict)
    return plain


def to_json(evaluations: Sequence[Evaluation], timings: Sequence[Timing | None] = ()) -> str:
    """One JSON object: the document of one evaluation, or a list of them under `evaluations`."""
    documents = [to_document(e, t) for e, t in zip_longest(evaluations, timings)]
    whole = documents[0] if len(documents) == 1 else {"schema": SCHEMA, "version": VERSION, "evaluations": documents}
    return json.dumps(whole, indent=2, allow_nan=False)


def strict(value: Any) -> Any:
    """The value with None in place of NaN and infinities, which JSON lacks."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: strict(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [strict(item) for item in value]
    return value


def render(evaluations: Sequence[Evaluation], timings: Sequence[Timing | None] = (), style: str = "text") -> str:
    """Table of evaluations against one ground truth, `style` one of STYLES, without final line break; else ValueError."""
    rows = [row for metric in shown_metrics(evaluations[0]) for row in metric.rows(evaluations)]
    if any(timings):
        rows += _timing_rows([*timings, *[None] * (len(evaluations) - len(timings))])
    names = short_names([e.estimate for e in evaluations])
    if style == "text":
        return "\n".join([*_head(evaluations, names), "", *_text(rows, names), "", *_recipes(evaluations)])
    labels = [f"{row.under}, {row.label}" if row.under else row.label for row in rows]
    body = [[label, row.unit, *row.cells] for label, row in zip(labels, rows, strict=True)]
    grid = [["metric", "unit", *names], *body]
    writers: dict[str, Callable[[list[list[str]], int], str]] = {"md": markdown, "csv": csv_table, "tex": latex}
    if style not in writers:
        raise ValueError(f"table style {style!r}: one of {', '.join(STYLES)}")
    table = writers[style](grid, 2)
    # A CSV is for programs, which have no use for sentences; --json holds values and recipes.
    how = {"md": "- {}", "tex": "% {}"}.get(style)
    return "\n".join([table, "", *(how.format(line.strip()) for line in _recipes(evaluations)[1:])]) if how else table


def _timing_rows(timings: Sequence[Timing | None]) -> list[MetricRow]:
    """Rows of median, 95 % quantile and maximum of each stage, ms, and of scans slower than the sensor."""

    def cell(stage: StageTime | None) -> str:
        return "-" if stage is None else " / ".join(significant(1e3 * v) for v in (stage.median, stage.p95, stage.max))

    stages = list(dict.fromkeys(name for t in timings if t for name in t.stages))
    under = "time per scan"
    rows = [MetricRow(f"{under}: median / p95 / max", "ms", [cell(t.total if t else None) for t in timings])]
    rows += [
        MetricRow(name, "ms", [cell(t.stages.get(name) if t else None) for t in timings], under) for name in stages
    ]
    over = [f"{t.over_limit} of {t.scans} over {1e3 * t.period:.0f} ms" if t and t.period else "-" for t in timings]
    return [*rows, MetricRow("slower than the sensor", "scans", over, under)]


def _head(evaluations: Sequence[Evaluation], names: list[str]) -> list[str]:
    """Lines on ground truth, estimates, matched poses and notes."""
    lines = [f"ground truth  {evaluations[0].ground_truth}"]
    for e, name in zip(evaluations, names, strict=True):
        shift = f", time offset {e.time_offset:.6f} s" if e.time_offset else ""
        lines.append(
            f"estimate      {e.estimate if len(evaluations) == 1 else f'{name}: {e.estimate}'}\n"
            f"  matched {e.matched} of {e.possible} poses, {e.path_length:.1f} m: {e.association}{shift}"
        )
        lines += [f"  note: {note}" for note in e.notes]
    return lines


def _recipes(evaluations: Sequence[Evaluation]) -> list[str]:
    """Definition of each number; facts that differ between estimates (poses, pairs) are in their columns."""
    lines = [line for metric in shown_metrics(evaluations[0]) for line in metric.recipes(evaluations[0])]
    return ["how:", *(f"  {line}" for line in lines)]


def _text(rows: list[MetricRow], names: list[str]) -> list[str]:
    """Lines of a table of metric rows; names : of the estimates."""
    grid = [[f"  {row.label}" if row.under else row.label, row.unit, *row.cells] for row in rows]
    lines = text_table([["", "", *names], *grid], 2).split("\n")
    return lines if len(names) > 1 else lines[1:]


def short_names(names: list[str]) -> list[str]:
    """Shortest path endings that distinguish the estimates; a run is named by its folder."""
    parts = [name.replace("\\", "/").removesuffix("/trajectory.tum").split("/") for name in names]
    for depth in range(1, max(len(p) for p in parts) + 1):
        short = ["/".join(p[-depth:]) for p in parts]
        if len(set(short)) == len(short):
            return short
    return [f"{i + 1}: {p[-1]}" for i, p in enumerate(parts)]
