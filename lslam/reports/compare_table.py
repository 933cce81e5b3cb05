"""A comparison as tables: on the terminal, in Markdown, CSV (one row per run) and LaTeX."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from lslam.core import __version__
from lslam.core.printable import count_of, metres, with_decimals
from lslam.core.types.comparison import Comparison, Metric, RunScore, SummaryRow
from lslam.io.formats.atomic import write_text
from lslam.reports.evaluations import strict
from lslam.reports.text import Grid, csv_table, latex, markdown, text_table

STYLES = ("md", "csv", "tex")
TITLES = {"error": "errors", "time": "mean time per scan", "health": "scans and runs"}
# What people read for each key.
HEALTH = {"bridged": "bridged", "skipped": "skipped", "degenerate": "degenerate", "fallback": "recovered"}
SCHEMA, VERSION = "lslam-compare", 1


@dataclass(frozen=True)
class CompareTable:
    """A titled grid of texts; the first `names` columns are names, `best` holds the (row, column) worth showing in bold."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    names: int
    best: frozenset[tuple[int, int]] = frozenset()

    @property
    def grid(self) -> Grid:
        """Header and rows."""
        return [list(self.header), *(list(row) for row in self.rows)]

    @property
    def header_lines(self) -> tuple[str, ...]:
        """Header split into several lines: units and long lists below."""
        return tuple(name.replace(", ", "\n").replace("/", "/\n") for name in self.header)

    @property
    def width(self) -> int:
        """Width in characters on a terminal, with the folded header and three spaces between columns."""
        heads = [max(len(line) for line in name.split("\n")) for name in self.header_lines]
        cells = [max((len(row[k]) for row in self.rows), default=0) for k in range(len(self.header))]
        return sum(max(pair) + 3 for pair in zip(heads, cells, strict=True))


def tables(comparison: Comparison, width: int | None = None) -> list[CompareTable]:
    """Tables of methods, in as many parts (errors, time, health) as `width` requires; of pairs, differences and failures."""
    splits: list[list[tuple[str, ...]]] = [
        [("error", "time", "health")],
        [("error",), ("time", "health")],
        [("error",), ("time",), ("health",)],
    ]
    for split in splits:
        titles = [TITLES[groups[0]] if len(split) > 1 else "" for groups in split]
        out = [_methods_table(comparison, groups, title) for groups, title in zip(split, titles, strict=True)]
        if width is None or all(table.width <= width for table in out):
            break
    doubts = _runs_table(comparison.degraded, "degraded: part of it is doubted", "sequence", "method", "seed", "reason")
    failures = _runs_table(comparison.failed, "failed", "sequence", "method", "seed", "status", "reason")
    out = [*(CompareTable(t.title, t.header, t.rows, 2) for t in comparison.beside if t.rows), *out]
    return out + [t for t in (_pairs(comparison), _differences(comparison), doubts, failures) if t.rows]


def stage_times(comparison: Comparison) -> tuple[Comparison, CompareTable]:
    """The comparison without the times of single stages, and these as a table of their own."""
    rest = tuple(m for m in comparison.metrics if m.group != "time" or m.key.count(".") < 2)
    return replace(comparison, metrics=rest), _methods_table(comparison, ("time",), TITLES["time"])


def recipes(comparison: Comparison) -> list[str]:
    """Definitions of the numbers, one sentence each."""
    shown = [
        m
        for m in comparison.metrics
        if m.is_main and m.recipe and not m.key.startswith("time.") and m.key not in HEALTH
    ]
    lines = [*(t.recipe for t in comparison.beside), *(f"{m.label}: {m.recipe}" for m in shown)]
    lines.append("ms: mean over scans of each stage, then of all stages together (mean), and its 95th percentile (p95)")
    lines.append(
        f"{'/'.join(HEALTH.values())}: scans of a run, mean over the runs of all seeds that did not fail; recovered: posed by "
        "a recovery policy or a fallback"
    )
    if any(row.runs > 1 for row in comparison.rows):
        lines.append("over seeds: mean ± sample standard deviation (n - 1) of the runs that did not fail")
    if len(comparison.methods) > 1:
        lines.append(
            f"pairs: one per sequence and seed; ratio: geometric mean of ATE (se3, else origin) over that of "
            f"what it stands against; a tie is within {100 * comparison.tie:g} cm; a run that failed where the "
            "other did not is a loss; p: Wilcoxon signed-rank of the log ratios, two-sided"
        )
    return lines


def render(comparison: Comparison, style: str = "text") -> str:
    """All tables as text; `style` is `text` or one of STYLES. Ends without a line break. Raises ValueError otherwise."""
    if style == "csv":
        return csv_table(_runs_grid(comparison))
    parts = as_text(tables(comparison), style)
    prefix = {"text": "  ", "md": "- ", "tex": "% "}[style]
    parts += ["\n".join(prefix + note for note in comparison.notes)] if comparison.notes else []
    parts.append("\n".join(prefix + line for line in recipes(comparison)))
    return "\n\n".join(parts)


def as_text(contents: Sequence[CompareTable], style: str) -> list[str]:
    """One text per table under its title; `style` is `text`, `md` or `tex`. Raises ValueError otherwise."""
    writers: dict[str, Callable[[Grid, int], str]] = {"text": text_table, "md": markdown, "tex": latex}
    if style not in writers:
        raise ValueError(f"table style {style!r}: text or one of {', '.join(STYLES)}")
    title = {"text": "{}", "md": "### {}\n", "tex": "% {}"}[style]
    parts = []
    for table in contents:
        text = writers[style](table.grid, table.names)
        parts.append(f"{title.format(table.title)}\n{text}" if table.title else text)
    return parts


def write_files(out: Path, comparison: Comparison) -> None:
    """Write compare.csv and compare.tex, and for a ready comparison beside.csv and beside.md, atomically; raises OutputError."""
    for style in ("csv", "tex"):
        write_text(out / f"compare.{style}", render(comparison, style) + "\n")
    if comparison.beside:
        shown = [CompareTable(t.title, t.header, t.rows, 2) for t in comparison.beside]
        write_text(out / "beside.md", "\n\n".join(as_text(shown, "md")) + "\n")
        write_text(out / "beside.csv", "\n\n".join(csv_table(table.grid) for table in shown) + "\n")


def _methods_table(comparison: Comparison, groups: Sequence[str], title: str) -> CompareTable:
    """Table of the main metrics in `groups`, one row per sequence and method, with the best values marked."""
    metrics = [m for m in comparison.metrics if m.is_main and m.group in groups and m.key not in HEALTH]
    header = ["sequence", "method", *(f"{m.label}, {m.unit}" if m.unit != "x" else f"x {m.label}" for m in metrics)]
    header += ["/".join(HEALTH.values()), "runs"] if "health" in groups else []
    rows, best = [], set()
    for i, row in enumerate(comparison.rows):
        cells = [_cell(metric, row) for metric in metrics]
        if "error" in groups and row.note and row.failed != row.runs:
            cells[0] = row.note if len(row.note) <= 20 else "not scored"
        if row.failed == row.runs:
            cells = ["failed"] * bool(cells) + ["-"] * (len(cells) - 1)
        rival = [other for other in comparison.rows if other.sequence == row.sequence]
        best |= {(i, 2 + k) for k, metric in enumerate(metrics) if _is_best(metric, row, rival)}
        health = [_health(row), _usable(row)] if "health" in groups else []
        rows.append((row.sequence, row.method, *cells, *health))
    return CompareTable(title, tuple(header), tuple(rows), 2, frozenset(best))


def _cell(metric: Metric, row: SummaryRow) -> str:
    """Mean over seeds, with the standard deviation of an error; `~` before a time of runs that shared the machine."""
    value = row.values.get(metric.key)
    if value is None:
        return "-"
    if metric.group == "error":
        text = metres(value.mean) if metric.unit == "m" else with_decimals(value.mean, 3)
        # The standard deviation over seeds, with equal decimals.
        text += "" if value.n < 2 else f" ± {with_decimals(value.std, len(text.partition('.')[2]))}"
    else:
        text = f"{value.mean:.1f}"
    return text if metric.group != "time" or row.is_timed_alone else f"~{text}"


def _health(row: SummaryRow) -> str:
    """Text of the mean counts per run, separated by slashes, `-` where unknown: a row without a usable run has none."""
    values = [row.values.get(key) for key in HEALTH]
    return "/".join("-" if v is None else f"{v.mean:.3g}" for v in values)


def _usable(row: SummaryRow) -> str:
    """Text of how many runs are usable."""
    doubted = f", {row.degraded} degraded" if row.degraded else ""
    return f"{row.runs - row.failed}/{row.runs}{doubted}"


def _is_best(metric: Metric, row: SummaryRow, rivals: Sequence[SummaryRow]) -> bool:
    """Whether a method is the best on the sequence; times are compared only among runs alone on the machine."""
    known = [r.values[metric.key].mean for r in rivals if metric.key in r.values]
    if not metric.best or metric.key not in row.values or len(known) < 2:
        return False
    if metric.group == "time" and not all(r.is_timed_alone for r in rivals):
        return False
    return row.values[metric.key].mean == (min(known) if metric.best == "low" else max(known))


def _pairs(comparison: Comparison) -> CompareTable:
    """Table of the paired comparisons with the reference."""
    header = ("method", "against", "pairs", "ratio of ATE", "wins/ties/losses", "p")
    rows = []
    for pair in comparison.pairs:
        p = pair.note if math.isnan(pair.p) else f"{pair.p:.3g}"
        ratio = with_decimals(pair.ratio, 3) if pair.n else "-"
        score = f"{pair.wins}/{pair.ties}/{pair.losses}"
        rows.append((pair.method, pair.reference, str(pair.n), ratio, score, p))
    return CompareTable("pairs", header, tuple(rows), 2)


def _differences(comparison: Comparison) -> CompareTable:
    """Table of the distances between trajectories, without ground truth."""
    rows = []
    for d in comparison.differences:
        rows.append((d.sequence, d.method, d.reference, str(d.seed), metres(d.origin), metres(d.se3)))
    header = ("sequence", "method", "against", "seed", "rmse from the same start, m", "rmse after se3, m")
    return CompareTable("distance between trajectories, without ground truth", header, tuple(rows), 3)


def _runs_table(runs: Sequence[RunScore], what: str, *names: str) -> CompareTable:
    """Table of the runs, with these fields (`names`) of each; what : its title."""
    rows = tuple(tuple(str(getattr(run, name)) for name in names) for run in runs)
    header = tuple("outcome" if name == "status" else name for name in names)
    return CompareTable(f"{count_of(len(rows), 'run')} {what}", header, rows, len(names))


def _runs_grid(comparison: Comparison) -> Grid:
    """One row per run, numbers in full, empty where unknown."""
    head = ["sequence", "method", "seed", "status", "reason", "jobs"]
    head += [f"{m.key} ({m.unit})" for m in comparison.metrics]
    grid = [head]
    for run in comparison.runs:
        known = [run.values.get(m.key) for m in comparison.metrics]
        numbers = ["" if v is None or not math.isfinite(v) else f"{v:.9g}" for v in known]
        grid.append(
            [run.sequence, run.method, str(run.seed), run.status, run.reason or run.note, str(run.jobs), *numbers]
        )
    return grid


def to_document(comparison: Comparison) -> dict[str, Any]:
    """The comparison as plain values, ready for `json.dumps`; what is not finite becomes None."""
    c = comparison
    document = _head(c.command, "done") | {
        "methods": list(c.methods),
        "sequences": list(c.sequences),
        "notes": list(c.notes),
        "recipes": recipes(c),
        "tie_m": c.tie,
        "timing_is_comparable": c.is_timing_comparable,
        "configs": c.configs,
        "metrics": [asdict(metric) for metric in c.metrics],
        "runs": [_run(run) for run in c.runs],
        "rows": [asdict(row) for row in c.rows],
        "paired": [asdict(pair) for pair in c.pairs],
        "differences": [asdict(difference) for difference in c.differences],
        "beside": [asdict(table) for table in c.beside],
    }
    plain = strict(document)
    assert isinstance(plain, dict)
    return plain


def write_running(path: Path, command: str) -> None:
    """Mark the folder of a comparison before its first run; raises OutputError."""
    _write(path, _head(command, "running"))


def write_result(path: Path, comparison: Comparison) -> None:
    """Write compare.json atomically; raises OutputError."""
    _write(path, to_document(comparison))


def _head(command: str, status: str) -> dict[str, Any]:
    """Entries with which compare.json begins."""
    return {"schema": SCHEMA, "version": VERSION, "lslam": __version__, "status": status, "command": command}


def _run(run: RunScore) -> dict[str, Any]:
    """JSON document of one run."""
    values = asdict(run)
    values["folder"] = str(values["folder"])
    values["stages_s"] = values.pop("stages")
    values["real_time_limit_s"] = values.pop("limit")
    values["reused"] = values.pop("is_reused")
    return values


def _write(path: Path, document: dict[str, Any]) -> None:
    """Write a document as JSON, atomically."""
    text = json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False)
    write_text(path, text + "\n")
