"""The figures of a sensitivity study, those of Girolimetto's section 5.3: errors, times, stages, laws, efficiency."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.config.config import unit_of, with_unit
from lslam.core.types.study import CurveResult, Law, StudyResult, StudyRow
from lslam.evaluation.curves import FLAT_SHARE, NOT_REGISTRATION, band, normalise, registration_ms
from lslam.reports.picture import COLOURS, house_style, label, pictures

POINTS = ("o", ".", "x")  # markers; lines without say nothing
LOST_MARKER = "x"


class PicturePoint(NamedTuple):
    """Drawn point: `x`, `y` as fractions of the picture from its upper left corner, and its description."""

    x: float
    y: float
    text: str


def picture_points(figure: Any, cross: str) -> list[PicturePoint]:
    """Points of all plots of a matplotlib figure after layout: curve, abscissa, ordinate with half its interval.

    cross : text of a cross, in place of an ordinate
    """
    size = np.array(figure.bbox.size)
    found = []
    for plot in figure.axes:
        title = plot.get_title().partition(": ")[0]
        # Plots that share an axis have one label.
        abscissa = next(filter(None, (p.get_xlabel() for p in plot.get_shared_x_axes().get_siblings(plot))), "")
        ordinate = next(filter(None, (p.get_ylabel() for p in plot.get_shared_y_axes().get_siblings(plot))), "")
        for line, name, halves in _lines(plot):
            data = np.column_stack([np.asarray(v, np.float64) for v in line.get_data()])
            places = line.get_transform().transform(data) / size
            for (x, y), (left, up), half in zip(data, places, halves, strict=True):
                if not (np.isfinite([left, up]).all() and 0 <= up <= 1):
                    continue
                value = cross if line.get_marker() == LOST_MARKER else _value_text(ordinate, _number(y) + half)
                words = (title, name, _value_text(abscissa, _tick(plot, x)), value)
                text = ", ".join(word for word in words if word)
                found.append(PicturePoint(round(float(left), 4), round(float(1 - up), 4), text))
    return found


def _lines(plot: Any) -> Iterator[tuple[Any, str, list[str]]]:
    """Lines with markers, the name of the curve, and half the interval at each point, as text.

    A name that begins with an underscore is not in the legend.
    """
    named = {}
    for container in plot.containers:
        line, _, bars = container.lines
        # A point that is not finite has a bar without ends.
        tops = [segment[-1][1] if len(segment) else np.nan for segment in bars[0].get_segments()]
        halves = [top - middle for middle, top in zip(line.get_ydata(), tops, strict=True)]
        named[line] = container.get_label(), [f" ± {_number(h)}" if np.isfinite(h) else "" for h in halves]
    for line in plot.lines:
        if line.get_marker() in POINTS:
            name = "" if line.get_label().startswith("_child") else line.get_label().removeprefix("_")
            yield line, *named.get(line, (name, [""] * len(line.get_xdata())))


def _value_text(label: str, value: str) -> str:
    """Value as text with the name and the unit of its axis."""
    name, comma, unit = label.rpartition(", ")
    return f"{name} {value} {unit}" if comma else f"{label} {value}"


def _tick(plot: Any, x: float) -> str:
    """Tick label at an abscissa, on an axis of words."""
    from matplotlib.ticker import FuncFormatter

    formatter = plot.xaxis.get_major_formatter()
    return (formatter(x) if isinstance(formatter, FuncFormatter) else "") or f"{x:g}"


def _number(value: float) -> str:
    """Number with three significant digits."""
    return f"{value:.3g}"


# Of section 5.3, by studied parameter and figure.
THESIS = {
    "input.skip_frames": {
        "errors": "5.16 and 5.21",
        "zoom": "5.17",
        "times": "5.18 and 5.22",
        "stages": "5.22",
        "law": "5.19 and 5.28",
        "efficiency": "5.20",
    },
    "imu.inlier_distance": {"errors": "5.23a", "times": "5.23b"},
    "registration.inlier_ratio": {"errors": "5.24", "times": "5.24"},
    "preprocess.random_share": {"errors": "5.25", "times": "5.26", "law": "5.27a and 5.28", "efficiency": "5.27b"},
    "loam.grid_step": {"errors": "5.29", "times": "5.30b", "stages": "5.30a", "efficiency": "5.31"},
    "loam.feature_map_voxel": {"times": "5.32b", "stages": "5.32a", "efficiency": "5.33"},
    "loam.max_planar_points": {"errors": "5.35", "times": "5.34b", "stages": "5.34a", "efficiency": "5.35"},
}
_STAGE_PANELS = 6
SAMPLES = 200  # of a drawn law
_SEEDS = (
    "Mean over the seeds whose run was not lost, bars: 95 % interval (Student's t). Crosses above: more than half of the "
    "runs were lost there."
)
_STAGES = f"Mean over seeds and scans; {_STAGE_PANELS} curves at most."
_LAW = (
    f"Lines: weighted least squares, shaded: 99 % confidence; below: residuals in % of the law. {len(COLOURS)} laws at most, "
    "the table has all."
)
_EFFICIENCY = (
    "Median over seeds, each curve over its own largest; a lost run counts as 0; squares: within 10 % of the largest."
)
_LOST_LABEL = "more than half of the runs lost"
_LEGEND_WIDTH = 130  # characters of a line, with six for each handle
_LOG_RATIO = 30.0  # of the largest to the smallest error, above which the axis is logarithmic


@dataclass(frozen=True)
class StudyFigure:
    """One figure as files: `name` is that of the files; `caption` says how it is made and which of Girolimetto's it repeats;
    `points` say what is drawn where."""

    name: str
    title: str
    caption: str
    png: bytes
    svg: bytes
    points: list[PicturePoint]


def study_figures(result: StudyResult) -> Iterator[StudyFigure]:
    """All figures for which the study has numbers."""
    from matplotlib.figure import Figure

    known = [r for r in result.results if r.curve.ran.any()]
    for name, title, caption, draw in _FIGURES:
        with house_style():
            figure = Figure(figsize=(10, 4.2))
            if not known or not draw(figure, result, known):
                continue
            of_thesis = THESIS.get(result.parameters[0], {}).get(name, "")
            more = f" Girolimetto, figure {of_thesis}." if of_thesis else ""
            png, svg = pictures(figure, ("png", "svg"))
            yield StudyFigure(name, title, caption + more, png, svg, picture_points(figure, _LOST_LABEL))


def _errors(figure: Any, result: StudyResult, curves: Sequence[CurveResult]) -> bool:
    """Draw translation and rotation errors over the parameter. Returns False without any."""
    left, right = figure.subplots(1, 2)
    _quantity(left, result, curves, "translation", "rmse of translation, m", lambda row: row.error)
    _quantity(right, result, curves, "angular", "rmse of rotation, deg", lambda row: row.angular_rmse_deg)
    _legend(figure, left)
    return any(r.means["translation"].n.any() for r in curves)


def _zoom(figure: Any, result: StudyResult, curves: Sequence[CurveResult]) -> bool:
    """Figure without the lost points; only where some curves diverge and others do not."""
    steady = [r for r in curves if not r.curve.loses_most.any()]
    return len(steady) < len(curves) and bool(steady) and _errors(figure, result, steady)


def _times(figure: Any, result: StudyResult, curves: Sequence[CurveResult]) -> bool:
    """Draw time per scan and total time over the parameter. Returns False without any."""
    left, right = figure.subplots(1, 2)
    _quantity(left, result, curves, "time_per_scan", "registration per scan, ms", registration_ms)
    _quantity(right, result, curves, "total_time", "total time, s", lambda row: row.total_time_s)
    _legend(figure, left)
    return any(r.means["total_time"].n.any() for r in curves)


def _stages(figure: Any, result: StudyResult, curves: Sequence[CurveResult]) -> bool:
    """Draw a panel per curve with a line per stage of registration. Returns False if registration has a single stage."""
    own = [[name for name, m in r.stage_means.items() if name not in NOT_REGISTRATION and m.n.any()] for r in curves]
    if max(len(names) for names in own) < 2:
        return False
    panels = list(zip(curves, own, strict=True))[:_STAGE_PANELS]
    names = list(dict.fromkeys(name for _, stages in panels for name in stages))
    plots = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for plot, (r, stages) in zip(plots, panels, strict=True):
        for name in stages:
            means = r.stage_means[name]
            plot.plot(r.curve.values, means.mean, ".-", color=COLOURS[names.index(name) % len(COLOURS)], label=name)
        plot.set_title(r.curve.label, fontsize=9)
        _abscissa(plot, r)
        label(plot, with_unit(result.parameters[0]), "time per scan, ms" if plot is plots[0] else "")
    plots[0].set_ylim(bottom=0)  # shared; before the last panel is drawn it would fix the top as well
    _legend(figure, *plots)
    return True


def _efficiency(figure: Any, result: StudyResult, curves: Sequence[CurveResult]) -> bool:
    """Draw the efficiency of each curve relative to its largest value, with a bar where it is within a tenth of that.

    Returns False without any.
    """
    names = ("efficiency", "total_efficiency")
    for plot, name in zip(figure.subplots(1, 2), names, strict=True):
        for k, (r, look) in enumerate(_with_looks(result, curves)):
            values = normalise(r.medians[name])
            plot.plot(r.curve.values, values, label=r.curve.label, **look)
            flat = np.flatnonzero(values >= 1 - FLAT_SHARE)
            if len(curves) <= len(COLOURS):
                plot.plot(r.curve.values[flat], np.full(len(flat), -0.04 * (k + 1)), "s", ms=3.5, color=look["color"])
        plot.set_yticks(np.linspace(0, 1, 6))
        _abscissa(plot, curves[0])
        title = "E, per scan (equation 5.2)" if name == "efficiency" else "E tot, in all (equation 5.3)"
        label(plot, with_unit(result.parameters[0]), f"{title}, over the largest")
    _legend(figure, figure.axes[0])
    return any(r.optimum is not None for r in curves)


def _quantity(
    plot: Any,
    result: StudyResult,
    curves: Sequence[CurveResult],
    name: str,
    words: str,
    of_row: Callable[[StudyRow], float],
) -> None:
    """Plot means with their intervals; crosses at the top where a curve is lost; reference runs as dotted lines.

    name : of the quantity in the curves; words : label of the ordinate; of_row : its value in a reference run
    """
    tops = []
    rows_of_crosses = 0
    for r, look in _with_looks(result, curves):
        means, values = r.means[name], r.curve.values
        if r.curve.loses_most.any():
            lost, height = values[r.curve.loses_most], 1.0 + 0.03 * rows_of_crosses
            rows_of_crosses += 1
            above = {"transform": plot.get_xaxis_transform(), "clip_on": False}
            plot.plot(
                lost, np.full(len(lost), height), "x", ms=4, color=look["color"], label=f"_{r.curve.label}", **above
            )
        half = means.high - means.mean
        # Below zero there is nothing, and a logarithmic axis could not draw it.
        below = np.minimum(half, 0.999 * means.mean)
        plot.errorbar(values, means.mean, [below, half], label=r.curve.label, elinewidth=0.7, capsize=1.5, **look)
        tops.append(means.mean)
    for row, colour in _beside(result, of_row):
        plot.axhline(of_row(row), color=colour, ls=":", lw=1.2, label=f"{row.series}, beside")
        tops.append(np.array([of_row(row)]))
    drawn = np.concatenate(tops)
    drawn = drawn[np.isfinite(drawn) & (drawn > 0)]
    # Limits are those of the means: three seeds make intervals that would press them flat.
    if name in ("translation", "angular") and len(drawn) and drawn.max() > _LOG_RATIO * drawn.min():
        plot.set_yscale("log")
        plot.set_ylim(0.7 * drawn.min(), 1.5 * drawn.max())
    else:
        plot.set_ylim(0, 1.15 * drawn.max() if len(drawn) else 1.0)
    _abscissa(plot, curves[0])
    label(plot, with_unit(result.parameters[0]), words)


def _beside(result: StudyResult, of_row: Callable[[StudyRow], float]) -> Iterator[tuple[StudyRow, str]]:
    """Reference runs beside the study that have the number: the first seed of each method, with its grey."""
    seen: dict[str, StudyRow] = {}
    for row in result.beside:
        if np.isfinite(of_row(row)):
            seen.setdefault(row.series, row)
    for k, row in enumerate(seen.values()):
        yield row, ("0.25", "0.5", "0.7")[k % 3]


def _with_looks(result: StudyResult, among: Sequence[CurveResult]) -> Iterator[tuple[CurveResult, dict[str, Any]]]:
    """Curves with their line styles, the same in all figures of a study.

    Colour by curve while there are few; where there are many, by second parameter in order, with a dash per series.
    """
    curves = [r.curve for r in result.results]
    if len(curves) <= len(COLOURS):
        looks = [{"color": colour, "marker": "o", "ms": 3, "lw": 1.2} for colour in COLOURS]
    else:
        from matplotlib import colormaps

        others = list(dict.fromkeys(curve.at for curve in curves))
        with suppress(TypeError):  # words beside numbers have no order but that of the study
            others.sort()
        series = list(dict.fromkeys(curve.series for curve in curves))
        shades, dashes = colormaps["viridis"](np.linspace(0.0, 0.88, len(others))), ("-", "--", ":", "-.")
        looks = [
            {
                "color": tuple(shades[others.index(curve.at)]),
                "ls": dashes[series.index(curve.series) % 4],
                "marker": "o",
                "ms": 2.5,
                "lw": 1.1,
            }
            for curve in curves
        ]
    by_label = {curve.label: look for curve, look in zip(curves, looks, strict=False)}
    return ((r, by_label[r.curve.label]) for r in among)


def _abscissa(plot: Any, result: CurveResult) -> None:
    """Set up the abscissa: logarithmic where most values crowd at the low end; words where values are words."""
    values: Floats = result.curve.values
    if result.curve.words:
        plot.set_xticks(values, result.curve.words)
    elif len(values) > 4 and values[0] > 0 and np.median(values) - values[0] < 0.25 * (values[-1] - values[0]):
        plot.set_xscale("log")
        marks = [
            v for k, v in enumerate(values) if k in (0, len(values) - 1) or f"{v:g}".strip("0.") in ("1", "2", "5")
        ]
        plot.set_xticks(marks, [f"{v:g}" for v in marks])
        plot.minorticks_off()
    elif (values == values.round()).all():
        plot.xaxis.get_major_locator().set_params(integer=True)


def _legend(figure: Any, *plots: Any) -> None:
    """Draw a legend below all plots, each name once."""
    found = {name: handle for plot in plots for handle, name in zip(*plot.get_legend_handles_labels(), strict=True)}
    columns = max(1, _LEGEND_WIDTH // (max((len(name) for name in found), default=0) + 6))
    figure.legend(found.values(), found.keys(), loc="outside lower center", ncols=columns, frameon=False)


def draw_laws(figure: Any, result: StudyResult, curves: Sequence[CurveResult]) -> bool:
    """Draw the law of each curve, or of each series over both parameters. Returns False if there is none."""
    colours = {r.curve.label: colour for r, colour in zip(result.results, COLOURS, strict=False)}
    singles = [(r.curve.label, r.law) for r in curves if r.law is not None and r.curve.label in colours]
    laws = list(result.products.items()) or singles
    if not laws:
        return False
    columns = len(laws) if result.products else 1
    grid = figure.add_gridspec(2, columns, height_ratios=[3, 1])
    for k, (name, law) in enumerate(laws):
        if k < columns:
            upper = figure.add_subplot(grid[0, k])
            lower = figure.add_subplot(grid[1, k], sharex=upper)
        if law.kind == "product":
            _product(upper, lower, law, name)
        else:
            _single(upper, lower, law, name, colours[name])
        lower.axhline(0, color="0.5", lw=0.8)
        label(upper, "", "total time, s")
        label(lower, with_unit(law.names[0]), "residual, %")
        upper.legend(frameon=False, fontsize=8)
        upper.tick_params(labelbottom=False)
    for upper in figure.axes[::2]:
        upper.set_ylim(bottom=0)
    return True


def _single(upper: Any, lower: Any, law: Law, curve: str, colour: str) -> None:
    """Draw a law with its band and points into `upper`, relative residuals, %, into `lower`."""
    x = law.points[:, 0]
    line = np.linspace(x.min(), x.max(), SAMPLES)
    fitted, half = band(law, line)
    upper.plot(x, law.times, "o", ms=3.5, color=colour, label=f"_{curve}")
    upper.plot(line, fitted, color=colour, lw=1.2, label=f"{curve}: {law.text} s, R2 {law.r2:.3f}")
    upper.fill_between(line, fitted - half, fitted + half, color=colour, alpha=0.2, lw=0)
    lower.plot(x, 100 * law.residuals, "o", ms=3, color=colour, label=f"_{curve}")


def _product(upper: Any, lower: Any, law: Law, name: str) -> None:
    """Draw one law of both parameters, as a line per value of the second one."""
    from matplotlib import colormaps

    seconds = np.unique(law.points[:, 1])
    key, unit = law.names[1].rpartition(".")[2], unit_of(law.names[1])
    for second, colour in zip(seconds, colormaps["viridis"](np.linspace(0.0, 0.88, len(seconds))), strict=True):
        own = law.points[:, 1] == second
        x = law.points[own, 0]
        line = np.linspace(x.min(), x.max(), SAMPLES)
        fitted, half = band(law, np.stack([line, np.full(SAMPLES, second)], 1))
        curve = f"{key} {second:g} {unit}".rstrip()
        upper.plot(x, law.times[own], "o", ms=3, color=colour, label=f"_{curve}")
        upper.plot(line, fitted, lw=1.1, color=colour, label=curve)
        upper.fill_between(line, fitted - half, fitted + half, color=colour, alpha=0.2, lw=0)
        lower.plot(x, 100 * law.residuals[own], "o", ms=2.5, color=colour, label=f"_{curve}")
    upper.set_title(f"{name}: {law.text} s, R2 {law.r2:.3f}", fontsize=9)


_FIGURES: tuple[tuple[str, str, str, Callable[[Any, StudyResult, Sequence[CurveResult]], bool]], ...] = (
    ("errors", "Errors", _SEEDS, _errors),
    ("zoom", "Errors of what is nowhere lost", _SEEDS, _zoom),
    ("times", "Computing time", _SEEDS, _times),
    ("stages", "Stages of registration", _STAGES, _stages),
    ("law", "Laws of total time", _LAW, draw_laws),
    ("efficiency", "Efficiency", _EFFICIENCY, _efficiency),
)
