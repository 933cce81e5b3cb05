"""Charts of the ground plane: equal scale on both axes, optionally over an image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.reports import svg

MOST_POINTS = 3000


@dataclass(frozen=True)
class Track:
    """A path (N, 2), m; `ends` marks its start and end."""

    label: str
    xy: NDArray[Any]
    style: str
    ends: bool = False


def plane_chart(
    tracks: list[Track],
    title: str,
    *,
    backdrop: tuple[str, tuple[float, float, float, float]] | None = None,
    points: NDArray[Any] | None = None,
    dots: Sequence[tuple[str, NDArray[Any]]] = (),
    width: int = svg.WIDTH,
    tallest: int = 460,
) -> str:
    """Tracks from above, x to the right, y up; `backdrop` is an image's address and its extent (x0, x1, y0, y1).

    `points` (K, 2) are marked as failures; `dots` are points (K, 2) in a style each, one group over
    the other. Empty text when nothing is finite.
    """
    xs, ys = [t.xy[:, 0] for t in tracks], [t.xy[:, 1] for t in tracks]
    if backdrop is not None:
        xs, ys = [*xs, np.array(backdrop[1][:2])], [*ys, np.array(backdrop[1][2:])]
    x_span, y_span = svg.span_of(xs), svg.span_of(ys)
    if x_span is None or y_span is None:
        return ""
    frame = _fitted(x_span, y_span, width, tallest, 0.0 if backdrop else 0.05)
    frame.axes("x, m", "y, m", x_ticks=min(6, width // 80), y_ticks=max(2, round((frame.bottom - frame.top) / 60)))
    if backdrop is not None:
        x0, x1, y0, y1 = backdrop[1]
        left, right = float(frame.px(x0)), float(frame.px(x1))
        top, bottom = float(frame.py(y1)), float(frame.py(y0))
        frame.add(
            f'<image class="density" x="{left:.1f}" y="{top:.1f}" width="{right - left:.1f}" '
            f'height="{bottom - top:.1f}" preserveAspectRatio="none" href="{backdrop[0]}"/>'
        )
    for style, group in dots:
        px, py = frame.px(group[:, 0]), frame.py(group[:, 1])
        path = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in zip(px.tolist(), py.tolist(), strict=True))
        frame.add(f'<path class="points {style}" d="{path}"/>')
    for track in tracks:
        xy = np.asarray(track.xy, np.float64)
        xy = xy[:: max(1, -(-len(xy) // MOST_POINTS))]
        frame.polyline(xy[:, 0], xy[:, 1], track.style)
    for track in tracks:
        if track.ends:
            _mark_ends(frame, np.asarray(track.xy, np.float64))
    for x, y in np.zeros((0, 2)) if points is None else points[np.isfinite(points).all(1)]:
        px, py = float(frame.px(x)), float(frame.py(y))
        frame.add(f'<path class="cross" d="M{px - 4:.1f} {py - 4:.1f}l8 8m0 -8l-8 8"/>')
    return frame.svg(title)


def _fitted(
    x_span: tuple[float, float], y_span: tuple[float, float], width: int, tallest: int, pad: float
) -> svg.Frame:
    """A frame with one scale for x and y, its height following the shape of the data."""
    margins_x = svg.MARGIN_LEFT + svg.MARGIN_RIGHT
    margins_y = svg.MARGIN_TOP + svg.MARGIN_BOTTOM
    size = np.array([x_span[1] - x_span[0], y_span[1] - y_span[0]])
    size = np.maximum(size * (1 + 2 * pad), max(float(size.max()) * 1e-3, 1.0))
    plot_width = width - margins_x
    plot_height = float(np.clip(plot_width * size[1] / size[0], 130, tallest - margins_y))
    metres = max(size[0] / plot_width, size[1] / plot_height)
    half = metres * np.array([plot_width, plot_height]) / 2
    centre = np.array([sum(x_span), sum(y_span)]) / 2
    low, high = centre - half, centre + half
    return svg.Frame((low[0], high[0]), (low[1], high[1]), width, round(plot_height) + margins_y)


def _mark_ends(frame: svg.Frame, xy: NDArray[np.float64]) -> None:
    """A circle where the path starts and a square where it ends; the circle lies on top of a closed loop's square."""
    finite = xy[np.isfinite(xy).all(1)]
    if not len(finite):
        return
    px, py = frame.px(finite[:, 0]), frame.py(finite[:, 1])
    frame.add(f'<rect class="dot end" x="{px[-1] - 5:.1f}" y="{py[-1] - 5:.1f}" width="10" height="10"/>')
    frame.dot(float(px[0]), float(py[0]), "start", 4)
