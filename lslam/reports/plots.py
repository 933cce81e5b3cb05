"""Figures of the HTML report: their series, units and texts."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.types.arrays import Floats
from lslam.core.types.run_record import RunRecord
from lslam.reports import svg
from lslam.reports.facts import RunFacts, stage_matrix
from lslam.reports.svg import By, Track, plane_chart

if TYPE_CHECKING:
    from lslam.evaluation.metric import AbsoluteError, Evaluation


DISTANCE = "distance along ground truth, m"
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
# A limit further away than this many times the usual scan would press the stages flat: an arrow says where it is.
LIMIT_IN_VIEW = 4.0


@dataclass(frozen=True)
class Figure:
    """One chart of the page: SVG text, legend of (style, label) as lines or areas, a caption that says the recipe."""

    title: str
    svg: str
    legend: tuple[tuple[str, str], ...] = ()
    caption: str = ""
    wide: bool = False
    is_area: bool = False


def trajectory_figures(record: RunRecord, evaluation: Evaluation | None) -> list[Figure]:
    """Top view and height profile, with ground truth when it was evaluated."""
    absolute = first_available(evaluation)
    if evaluation is None or absolute is None:
        positions = record.trajectory.positions
        truth, distance = None, record.trajectory.path_lengths
        caption, x_label, along = "Estimate in its own world.", "distance travelled, m", _BY_WAY
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
    height = svg.line_chart(lines, x_label, "height z, m", "height profile", zero=False, by=along[1])
    legend = tuple((t.style, t.label) for t in tracks)
    start_end = (("start", "start"), ("end", "end"))
    extra = (("bad", "bridged or skipped scan"),) if len(failed) else ()
    return [
        Figure("Trajectory from above", top, legend + start_end + extra, caption),
        Figure("Height", height, legend, caption),
    ]


def error_figures(evaluation: Evaluation) -> list[Figure]:
    """Errors over distance for each alignment, and per axis (origin alignment)."""
    available = [a for a in evaluation.ate.values() if a.available]
    distance = evaluation.distance
    position = [
        svg.Line(a.alignment, distance, np.linalg.norm(a.errors, axis=1), f"s{i + 1}") for i, a in enumerate(available)
    ]
    if not any(a.rotation_deg for a in available):
        caption = "Distance between matched positions, per alignment."
        return [_lines("Position error", position, DISTANCE, "position error, m", caption)]
    rotation = [svg.Line(a.alignment, distance, a.rotation_errors_deg, f"s{i + 1}") for i, a in enumerate(available)]
    axes = evaluation.scores["thesis1"]
    figures = [
        _lines(
            "Position error", position, DISTANCE, "position error, m", "Distance between matched poses, per alignment."
        ),
        _lines(
            "Rotation error", rotation, DISTANCE, "rotation error, deg", "Angle between matched poses, per alignment."
        ),
    ]
    if axes is not None:
        recipe = "Estimate minus ground truth, first poses coincide (origin)."
        figures += [
            _lines(
                "Error per axis", _three(("x", "y", "z"), distance, axes.xyz), DISTANCE, "position error, m", recipe
            ),
            _lines(
                "Error per angle",
                _three(("roll", "pitch", "yaw"), distance, axes.rpy_deg),
                DISTANCE,
                "angle error, deg",
                recipe,
            ),
        ]
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
        ("Inliers", "inliers", "inliers and source points", ["inliers", "source_points"]),
        ("Overlap", "overlap", "overlap, share of source points", ["overlap"]),
        ("Residual", "rmse", "rmse of the residuals, m", ["rmse"]),
        ("Iterations", "iterations", "iterations", ["iterations"]),
        ("Motion prior", "prior_norm", "2-norm of inv(prior) pose - I", ["prior_norm", "imu.steady_norm"]),
    ]
    words = {
        "source_points": "source points",
        "prior_norm": "prior",
        "imu.steady_norm": "constant velocity, for comparison",
    }
    figures = []
    for title, _, y_label, fields in series:
        # None, where there is nothing to compare with, becomes NaN.
        known = {f: np.array([attrgetter(f)(r) for r in results], np.float64) for f in fields}
        fields = [f for f in fields if np.isfinite(known[f]).any()]
        values = [known[f] for f in fields]
        if not any(np.any(np.isfinite(v) & (v != 0)) for v in values):
            continue
        lines = [
            svg.Line(words.get(f, f), index, v, f"s{i + 1}")
            for i, (f, v) in enumerate(zip(fields, values, strict=True))
        ]
        chart = svg.line_chart(lines, "scan", y_label, f"{title} per scan", marks=failed, whole_x=True, by="scan")
        legend = tuple((line.style, line.label) for line in lines) if len(lines) > 1 else ()
        if len(failed):
            legend += (("failed", "bridged or skipped scan"),)
        figures.append(Figure(title, chart, legend))
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
        ("Position uncertainty", "m", ("x", "y", "z"), sigma[:, :3]),
        ("Rotation uncertainty", "deg", ("about x", "about y", "about z"), np.degrees(sigma[:, 3:])),
    ):
        lines = _three(names, distance, values)
        chart = svg.line_chart(
            lines, "distance travelled, m", f"sigma, {unit}", title, marks=distance[failed], by="way"
        )
        legend = tuple((line.style, line.label) for line in lines)
        legend += (("failed", "bridged or skipped scan"),) if failed.any() else ()
        figures.append(Figure(title, chart, legend, recipe))
    return [figure for figure in figures if figure.svg]


def first_available(evaluation: Evaluation | None) -> AbsoluteError | None:
    """Alignment for drawing the trajectory: se3 when there is one."""
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


def _lines(title: str, lines: list[svg.Line], x_label: str, y_label: str, caption: str) -> Figure:
    chart = svg.line_chart(lines, x_label, y_label, title, by="truth")
    return Figure(title, chart, tuple((line.style, line.label) for line in lines), caption)


def _three(names: tuple[str, str, str], x: NDArray[Any], values: Floats) -> list[svg.Line]:
    return [svg.Line(name, x, values[:, i], f"s{i + 1}") for i, name in enumerate(names)]


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
    """Edges (B+1,), mean per stage (B, S) and, when a bin holds several scans, the longest total of each bin."""
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
