"""Evaluations as tables: one column per estimate, for the terminal, Markdown, CSV and LaTeX; every row names its recipe."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

from lslam.evaluation.results import AbsoluteError, Evaluation, RelativeError
from lslam.evaluation.statistics import Statistics
from lslam.evaluation.timing import StageTime, Timing
from lslam.reports.grid_text import comma_separated, latex, markdown
from lslam.reports.metrics import counted

Row = tuple[str, str, list[str]]
STYLES = ("text", "md", "csv", "tex")


def render(evaluations: Sequence[Evaluation], timings: Sequence[Timing | None] = (), style: str = "text") -> str:
    """A table of evaluations against one ground truth; `style` is one of STYLES. Ends without a line break.

    Raises ValueError for an unknown style.
    """
    padded = [*timings, *[None] * (len(evaluations) - len(timings))]
    rows = _rows(evaluations, padded)
    names = short_names([e.estimate for e in evaluations])
    if style == "text":
        return "\n".join([*_head(evaluations, names), "", *_text(rows, names), "", *_recipes(evaluations)])
    grid = [["metric", "unit", *names], *([label, unit, *cells] for label, unit, cells in _in_full(rows))]
    writers: dict[str, Callable[[list[list[str]], int], str]] = {"md": markdown, "csv": comma_separated, "tex": latex}
    if style not in writers:
        raise ValueError(f"table style {style!r}: one of {', '.join(STYLES)}")
    table = writers[style](grid, 2)
    # A CSV is for programs, which have no use for sentences; --json holds values and recipes.
    how = {"md": "- {}", "tex": "% {}"}.get(style)
    return "\n".join([table, "", *(how.format(line.strip()) for line in _recipes(evaluations)[1:])]) if how else table


def _in_full(rows: list[Row]) -> list[Row]:
    """The rows with labels that stand alone: an indented one is led by the number it belongs to."""
    full, above = [], ""
    for label, unit, cells in rows:
        if label.startswith(" "):
            label = f"{above}, {label.strip()}"
        else:
            above = re.sub(r"(:.*| rmse| thesis_rmse| planar ATE)$", "", label)
        full.append((label, unit, cells))
    return full


def _rows(evaluations: Sequence[Evaluation], timings: Sequence[Timing | None]) -> list[Row]:
    """Label, unit and one cell per estimate; recipes are the same for all of them, being one configuration's."""
    rows: list[Row] = []
    first = evaluations[0]
    for name in first.ate:
        rows += _absolute_rows(name, [e.ate[name] for e in evaluations])
    for k, error in enumerate(first.rpe):
        rows += _relative_rows(error.name, [e.rpe[k] for e in evaluations])
    drifts = [e.kitti_drift for e in evaluations]
    rows.append(("KITTI drift", "%", [_number(d.translation_percent) if d.available else "n/a" for d in drifts]))
    rows.append(
        ("  rotation", "deg/100m", [_number(d.rotation_deg_per_100m) if d.available else "n/a" for d in drifts])
    )
    one, two = [e.thesis1 for e in evaluations], [e.thesis2 for e in evaluations]
    rows.append(("thesis1 thesis_rmse", "m", [_number(t.thesis_rmse) for t in one]))
    rows.append(("  x / y / z rmse", "m", [" / ".join(_number(v) for v in t.xyz_rmse) for t in one]))
    rows.append(("  roll / pitch / yaw rmse", "deg", [" / ".join(_number(v) for v in t.rpy_rmse_deg) for t in one]))
    rows.append(
        ("  angular rmse / max", "deg", [f"{_number(t.angular_rmse_deg)} / {_number(t.angular_max_deg)}" for t in one])
    )
    rows.append(("thesis2 planar ATE", "m", [_spread(t.ate_mean, t.ate_std) for t in two]))
    rows.append(("  RPE translation", "m", [_spread(t.rpe_translation_mean, t.rpe_translation_std) for t in two]))
    rows.append(("  RPE rotation, signed", "rad", [_spread(t.rpe_rotation_mean, t.rpe_rotation_std) for t in two]))
    if any(timings):
        rows += _timing_rows(timings)
    return rows


def _absolute_rows(name: str, errors: list[AbsoluteError]) -> list[Row]:
    def cells(pick: Callable[[AbsoluteError], str]) -> list[str]:
        return [pick(e) if e.available else e.note for e in errors]

    rows = [
        (f"ATE {name} rmse", "m", cells(lambda e: _rmse(e.translation))),
        ("  mean / median", "m", cells(lambda e: _two(e.translation, "mean", "median"))),
        ("  std / max", "m", cells(lambda e: _two(e.translation, "std", "max"))),
        ("  horizontal / vertical rmse", "m", cells(_split)),
        ("  rotation rmse / max", "deg", cells(lambda e: _two(e.rotation_deg, "rmse", "max"))),
        ("  rmse of path length", "%", cells(lambda e: _number(e.percent_of_length))),
    ]
    if name == "sim3":
        rows.append(("  scale", "", cells(lambda e: f"{e.scale:.6f}")))
    return rows if any(e.available for e in errors) else rows[:1]


def _relative_rows(name: str, errors: list[RelativeError]) -> list[Row]:
    def cells(pick: Callable[[RelativeError], str]) -> list[str]:
        return [pick(e) if e.n_pairs else e.note for e in errors]

    rows = [
        (f"RPE {name}: rmse / mean", "m", cells(lambda e: _two(e.translation, "rmse", "mean"))),
        ("  rotation rmse / mean", "deg", cells(lambda e: _two(e.rotation_deg, "rmse", "mean"))),
        ("  pairs", "", [str(e.n_pairs) for e in errors]),
    ]
    return rows if any(e.n_pairs for e in errors) else rows[:1]


def _timing_rows(timings: Sequence[Timing | None]) -> list[Row]:
    def cell(stage: StageTime | None) -> str:
        return "-" if stage is None else " / ".join(_number(1e3 * v) for v in (stage.median, stage.p95, stage.max))

    stages = list(dict.fromkeys(name for t in timings if t for name in t.stages))
    rows = [("time per scan: median / p95 / max", "ms", [cell(t.total if t else None) for t in timings])]
    rows += [(f"  {name}", "ms", [cell(t.stages.get(name) if t else None) for t in timings]) for name in stages]
    over = [f"{t.over_limit} of {t.scans} over {1e3 * t.period:.0f} ms" if t and t.period else "-" for t in timings]
    return [*rows, ("  slower than the sensor", "scans", over)]


def _head(evaluations: Sequence[Evaluation], names: list[str]) -> list[str]:
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
    """How each number was made; what differs between estimates (poses, pairs) stands in their columns."""
    e = evaluations[0]
    lines = [f"ATE {error.recipe if error.available else f'{name}: {error.note}'}" for name, error in e.ate.items()]
    lines += [f"RPE {error.name}: {error.rule}, no alignment" for error in e.rpe]
    drift = e.kitti_drift
    lines.append(f"drift: {drift.recipe}; {counted(drift.segments, 'segment') if drift.available else drift.note}")
    lines += [f"thesis1: {e.thesis1.recipe}", f"thesis2: {e.thesis2.recipe}; mean spacing {e.thesis2.spacing:.2f} m"]
    return ["how:", *(f"  {line}" for line in lines)]


def _text(rows: list[Row], names: list[str]) -> list[str]:
    label = max(len(row[0]) for row in rows)
    unit = max(len(row[1]) for row in rows)
    widths = [max(len(name), *(len(row[2][k]) for row in rows)) for k, name in enumerate(names)]

    def line(a: str, b: str, cells: list[str]) -> str:
        return (
            f"{a:<{label}}  {b:<{unit}}  {'  '.join(f'{c:>{w}}' for c, w in zip(cells, widths, strict=True))}".rstrip()
        )

    head = [line("", "", names)] if len(names) > 1 else []
    return [*head, *(line(*row) for row in rows)]


def short_names(names: list[str]) -> list[str]:
    """The shortest path endings that tell the estimates apart; a run is called by its folder."""
    parts = [name.replace("\\", "/").removesuffix("/trajectory.tum").split("/") for name in names]
    for depth in range(1, max(len(p) for p in parts) + 1):
        short = ["/".join(p[-depth:]) for p in parts]
        if len(set(short)) == len(short):
            return short
    return [f"{i + 1}: {p[-1]}" for i, p in enumerate(parts)]


def _number(value: float | None) -> str:
    """Four significant digits; an exponent only below 0.0001."""
    if value is None or value != value:
        return "n/a"
    return f"{value:.4g}" if abs(value) < 1000 else f"{value:.1f}"


def _rmse(values: Statistics | None) -> str:
    return "n/a" if values is None else _number(values.rmse)


def _two(values: object, a: str, b: str) -> str:
    return "n/a" if values is None else f"{_number(getattr(values, a))} / {_number(getattr(values, b))}"


def _split(error: AbsoluteError) -> str:
    return f"{_rmse(error.horizontal)} / {_rmse(error.vertical)}"


def _spread(mean: float, std: float) -> str:
    return f"{_number(mean)} ± {_number(std)}"
