"""Figures of the HTML report: their series, units and texts."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.types.imu import XYZ
from lslam.core.types.run_record import RunRecord
from lslam.reports import svg
from lslam.reports.facts import RunFacts, stage_matrix
from lslam.reports.svg import By, Track, plane_chart

if TYPE_CHECKING:
    from lslam.evaluation.metric import AbsoluteError, Evaluation


DISTANCE, WAY = "distance along ground truth, m", "distance travelled, m"
RPY = ("roll", "pitch", "yaw")
# What of a scan plane and abscissa are: without, and with ground truth.
_BY_WAY: tuple[By, By] = ("own", "way")
_BY_TRUTH: tuple[By, By] = ("aligned", "truth")
ALIGNMENTS = ("se3", "origin", "posyaw", "sim3", "none")
ALIGNED = {
    "se3": "aligned to ground truth by a rigid transform (se3)",
    "sim3": "aligned to ground truth by a similarity (sim3)",
    "posyaw": "aligned to ground truth by position and yaw",
    "origin": "moved so that the first poses coincide (origin)",
    "none": "not aligned",
}
SHADES = 8  # of the style sheet that are all different
PLAN_HEIGHT = 340  # of one beside a chart
FAILURE_LEGEND = (("failed", "bridged or skipped scan"),)  # legend of the marks of such scans
Legend = tuple[tuple[str, str], ...]
# A limit further away than this many times the usual scan would press the stages flat: an arrow says where it is.
LIMIT_IN_VIEW = 4.0


@dataclass(frozen=True)
class Figure:
    """One chart of the page: SVG text, legend of (style, label) as lines or areas, a caption that says the recipe."""

    title: str
    svg: str
    legend: Legend = ()
    caption: str = ""
    wide: bool = False
    is_area: bool = False


def legend_of(items: Sequence[svg.Line | Track]) -> Legend:
    """Legend of lines or tracks, each under its label."""
    return tuple((one.style, one.label) for one in items)


def line_figure(
    title: str,
    lines: list[svg.Line],
    x_label: str,
    y_label: str,
    caption: str = "",
    *,
    spoken: str = "",
    legend: Legend | None = None,
    more: Legend = (),
    **chart: Any,
) -> Figure:
    """Figure of lines over a common abscissa; its SVG is empty where no value is finite.

    spoken : title for screen readers, where it is another one; chart : as of `svg.line_chart`
    legend : in place of that of the lines; more : entries after it
    """
    drawing = svg.line_chart(lines, x_label, y_label, spoken or title, **chart)
    return Figure(title, drawing, (legend_of(lines) if legend is None else legend) + more, caption)


def trajectory_figures(record: RunRecord, evaluation: Evaluation | None) -> list[Figure]:
    """Top view and height profile, with ground truth when it was evaluated."""
    absolute = first_available(evaluation)
    if evaluation is None or absolute is None:
        positions = record.trajectory.positions
        truth, distance = None, record.trajectory.path_lengths
        caption, x_label, along = "Estimate in its own world.", WAY, _BY_WAY
    else:
        positions, truth, distance = absolute.aligned_positions, evaluation.gt_positions, evaluation.distance
        caption, x_label, along = (
            f"Estimate {ALIGNED.get(absolute.alignment, absolute.alignment)}.",
            DISTANCE,
            _BY_TRUTH,
        )
    tracks = [] if truth is None else [Track("ground truth", truth[:, :2], "gt")]
    tracks.append(Track("estimate", positions[:, :2], "s1", ends=True))
    failed = _failed_positions(record, absolute)
    top = plane_chart(tracks, "trajectory from above", points=failed, tallest=PLAN_HEIGHT, by=along[0])
    lines = [] if truth is None else [svg.Line("ground truth", distance, truth[:, 2], "gt")]
    lines.append(svg.Line("estimate", distance, positions[:, 2], "s1"))
    more = (("start", "start"), ("end", "end"), *((("bad", FAILURE_LEGEND[0][1]),) if len(failed) else ()))
    return [
        Figure("Trajectory from above", top, legend_of(tracks) + more, caption),
        line_figure("Height", lines, x_label, "height z, m", caption, spoken="height profile", zero=False, by=along[1]),
    ]


def error_figures(evaluation: Evaluation) -> list[Figure]:
    """Errors over distance for each alignment, and per axis (origin alignment)."""
    available = [a for a in evaluation.ate.values() if a.available]
    distance = evaluation.distance
    names = [a.alignment for a in available]
    position = numbered_lines(names, distance, [np.linalg.norm(a.errors, axis=1) for a in available])
    recipe = "Distance between matched {}, per alignment."
    if not any(a.rotation_deg for a in available):
        caption = recipe.format("positions")
        return [line_figure("Position error", position, DISTANCE, "position error, m", caption, by="truth")]
    rotation = numbered_lines(names, distance, [a.rotation_errors_deg for a in available])
    shown = [
        ("Position error", position, "position error, m", recipe.format("poses")),
        ("Rotation error", rotation, "rotation error, deg", "Angle between matched poses, per alignment."),
    ]
    axes = evaluation.scores["thesis1"]
    if axes is not None:
        recipe = "Estimate minus ground truth, first poses coincide (origin)."
        xyz, rpy = (numbered_lines(*of) for of in ((XYZ, distance, axes.xyz.T), (RPY, distance, axes.rpy_deg.T)))
        shown += [
            ("Error per axis", xyz, "position error, m", recipe),
            ("Error per angle", rpy, "angle error, deg", recipe),
        ]
    figures = [line_figure(title, lines, DISTANCE, unit, text, by="truth") for title, lines, unit, text in shown]
    return [figure for figure in figures if figure.svg]


def time_figure(record: RunRecord, facts: RunFacts) -> Figure | None:
    """Stage times per scan, stacked, against the real-time limit; None when no stage was timed."""
    names, seconds = stage_matrix(record.results)
    if not names:
        return None
    index = np.array([r.index for r in record.results])
    chart, remark = stage_chart(index, seconds * 1e3, record.real_time_limit * 1e3, "time per scan and stage")
    caption = "Stages stacked; reading and preprocessing may overlap registration, so a scan takes at most this long."
    legend = tuple((f"s{i % SHADES + 1}", name) for i, name in enumerate(names))
    return Figure("Time per scan", chart, legend, f"{caption} {remark}".strip(), is_area=True)


def registration_figures(record: RunRecord) -> list[Figure]:
    """Figures of inliers, overlap, rmse, iterations and the prior's error (Girolimetto, equation 5.1), as far as reported."""
    results = record.results
    index = np.array([r.index for r in results], np.float64)
    failed = np.array([r.index for r in results if r.status != "ok"], np.float64)
    series = [
        ("Inliers", "inliers and source points", ["inliers", "source_points"]),
        ("Overlap", "overlap, share of source points", ["overlap"]),
        ("Residual", "rmse of the residuals, m", ["rmse"]),
        ("Iterations", "iterations", ["iterations"]),
        ("Motion prior", "2-norm of inv(prior) pose - I", ["prior_norm", "imu.steady_norm"]),
    ]
    words = {
        "source_points": "source points",
        "prior_norm": "prior",
        "imu.steady_norm": "constant velocity, for comparison",
    }
    figures = []
    for title, y_label, fields in series:
        # None, where there is nothing to compare with, becomes NaN.
        known = {f: np.array([attrgetter(f)(r) for r in results], np.float64) for f in fields}
        fields = [f for f in fields if np.isfinite(known[f]).any()]
        values = [known[f] for f in fields]
        if not any(np.any(np.isfinite(v) & (v != 0)) for v in values):
            continue
        lines = numbered_lines([words.get(f, f) for f in fields], index, values)
        legend, more = None if len(lines) > 1 else (), FAILURE_LEGEND if len(failed) else ()
        chart: dict[str, Any] = {"spoken": f"{title} per scan", "marks": failed, "whole_x": True, "by": "scan"}
        figures.append(line_figure(title, lines, "scan", y_label, legend=legend, more=more, **chart))
    return figures


def uncertainty_figures(record: RunRecord) -> list[Figure]:
    """One sigma of position and rotation per pose; empty when the method gives no covariance.

    The covariance is read as registration gives it: of t' = t + d[:3], R' = exp(d[3:]) R in world axes, so its diagonal
    holds the variances of the position itself, without a lever arm to the world's origin.
    """
    covariances = _covariances(record)
    if covariances is None:
        return []
    variance = np.diagonal(covariances, axis1=1, axis2=2)
    sigma = np.sqrt(np.where(variance >= 0, variance, np.nan))
    distance = record.trajectory.path_lengths
    recipe = "Square roots of the covariance's diagonal, world axes, one sigma per pose."
    failed = np.zeros(len(sigma), bool)
    if len(record.results) == len(sigma):
        failed = np.array([r.status != "ok" for r in record.results], bool)
    if failed.any():
        # A bridged pose has the covariance of a guess: drawn, it would press the registered ones flat.
        sigma[failed] = np.nan
        recipe += " Bridged and skipped scans are marked and left out of the lines."
    figures = []
    for title, unit, names, values in (
        ("Position uncertainty", "m", XYZ, sigma[:, :3]),
        ("Rotation uncertainty", "deg", ("about x", "about y", "about z"), np.degrees(sigma[:, 3:])),
    ):
        lines, marks, more = (
            numbered_lines(names, distance, values.T),
            distance[failed],
            FAILURE_LEGEND if failed.any() else (),
        )
        figures.append(line_figure(title, lines, WAY, f"sigma, {unit}", recipe, more=more, marks=marks, by="way"))
    return [figure for figure in figures if figure.svg]


def first_available(evaluation: Evaluation | None) -> AbsoluteError | None:
    """Alignment for drawing the trajectory: se3 where available, else the next one; None without any."""
    if evaluation is None:
        return None
    for name in (*ALIGNMENTS, *evaluation.ate):
        absolute = evaluation.ate.get(name)
        if absolute is not None and absolute.available:
            return absolute
    return None


def share_bar(facts: RunFacts) -> str:
    """Shares of the stages as one horizontal bar."""
    frame = svg.Frame((0, 1), (0, 1), 480, 34)
    x = 0.0
    for i, (stage_name, stage) in enumerate(facts.stages.items()):
        width = 480 * stage.share
        name = escape(f"{stage_name}: {100 * stage.share:.1f} %")
        frame.add(
            f'<rect class="area s{i % SHADES + 1}" x="{x:.1f}" y="2" width="{width:.1f}" height="30"><title>{name}</title></rect>'
        )
        if width > 34:
            frame.text(x + width / 2, 22, f"{100 * stage.share:.0f} %", "middle", "onbar")
        x += width
    return frame.svg("share of each stage")


def numbered_lines(names: Sequence[str], x: NDArray[Any], series: Iterable[Floats]) -> list[svg.Line]:
    """Lines over `x` (N,), one for each (N,) of the series, in the styles `s1`, `s2`, ..."""
    return [svg.Line(name, x, y, f"s{i + 1}") for i, (name, y) in enumerate(zip(names, series, strict=True))]


def _failed_positions(record: RunRecord, absolute: AbsoluteError | None) -> Floats:
    """(K, 2) positions, m, of bridged and skipped scans, transformed like the estimate."""
    places = np.array([r.T_world_lidar[:3, 3] for r in record.results if r.status != "ok"]).reshape(-1, 3)
    if absolute is not None:
        places = absolute.scale * places @ absolute.T_gt_est[:3, :3].T + absolute.T_gt_est[:3, 3]
    return np.asarray(places[:, :2])


def _covariances(record: RunRecord) -> Floats | None:
    """Covariances of the trajectory, else those of the scans; NaN where a scan has none."""
    if record.trajectory.covariances is not None:
        return record.trajectory.covariances
    given = [r.covariance for r in record.results]
    if len(given) != len(record.trajectory) or all(c is None for c in given):
        return None
    return np.array([np.full((6, 6), np.nan) if c is None else c for c in given])


def stage_chart(index: NDArray[Any], ms: Floats, limit: float, title: str) -> tuple[str, str]:
    """Stacked areas, one step per scan or per bin of scans; ms (N, S) in milliseconds, limit in milliseconds or 0.

    Returns the SVG and a sentence about what the scale hides: bins, peaks cut off, a limit out of view.
    """
    x, layers, highest, remark = _bins(np.asarray(index, np.float64), ms)
    totals = ms.sum(1)
    usual = float(np.percentile(totals, 95))
    top = _scale(totals, usual)
    limit_inside = 0 < limit <= LIMIT_IN_VIEW * top
    if limit_inside:
        top = max(top, 1.08 * limit)
    frame = svg.Frame((x[0], x[-1]), (0.0, top), by="scan")
    frame.axes("scan", "time, ms", whole_x=True)
    stacked = np.cumsum(np.minimum(layers, 1e9), axis=1)
    below = np.zeros(len(stacked))
    for layer in range(ms.shape[1]):
        above = stacked[:, layer]
        frame.add(f'<path class="area s{layer % SHADES + 1}" d="{_steps(frame, x, below, above, top)}"/>')
        below = above
    if highest is not None:
        frame.polyline(np.repeat(x, 2)[1:-1], np.minimum(np.repeat(highest, 2), top), "peak")
    remarks = [remark] if remark else []
    beyond = int((totals > top).sum())
    if beyond:
        worst = int(np.argmax(totals))
        text = f"{totals[worst]:.0f} ms at scan {int(index[worst])}"
        remarks.append(
            f"One scan is cut off: {text}." if beyond == 1 else f"{beyond} scans are cut off, the longest {text}."
        )
    if limit_inside:
        y = float(frame.py(limit))
        frame.add(f'<path class="limit" d="M{frame.left} {y:.1f}H{frame.right}"/>')
        frame.text(frame.right - 4, y - 5, f"real-time limit {limit:.0f} ms", "end", "limit-text")
    elif limit > 0:
        frame.text(frame.right - 4, frame.top - 10, f"real-time limit {limit:.0f} ms lies above ↑", "end", "limit-text")
    return frame.svg(title), " ".join(remarks)


def _scale(totals: Floats, usual: float) -> float:
    """Upper end of the axis: the maximum, unless a few peaks (the first scan of a run, say) would compress the rest."""
    highest = float(totals.max())
    top = highest if highest <= 2.5 * usual else 1.4 * usual
    return 1.08 * top if top > 0 else 1.0


def _bins(index: Floats, ms: Floats) -> tuple[Floats, Floats, Floats | None, str]:
    """Bin edges (B+1,), means per stage (B, S), largest totals or None if bins are single scans, and a remark on that."""
    if len(ms) <= svg.BINS:
        step = float(np.median(np.diff(index))) if len(index) > 1 else 1.0
        return np.append(index, index[-1] + max(step, 1e-9)), ms, None, ""
    starts = np.linspace(0, len(ms), svg.BINS + 1).astype(int)[:-1]
    size = np.diff(np.append(starts, len(ms)))
    means = np.add.reduceat(ms, starts, axis=0) / size[:, None]
    highest = np.maximum.reduceat(ms.sum(1), starts)
    remark = f"Areas are means of about {round(len(ms) / svg.BINS)} scans, the thin line is the longest of them."
    return np.append(index[starts], index[-1]), means, highest, remark


def _steps(frame: svg.Frame, x: Floats, below: Floats, above: Floats, top: float) -> str:
    """Outline of one layer, a step per bin: along the top from left to right, back along the bottom."""
    edges = np.repeat(x, 2)[1:-1]
    px = frame.px(np.concatenate([edges, edges[::-1]]))
    py = frame.py(np.minimum(np.concatenate([np.repeat(above, 2), np.repeat(below, 2)[::-1]]), top))
    return svg.path(px, py) + "Z"
