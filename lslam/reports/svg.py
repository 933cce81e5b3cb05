"""Small charts as inline SVG: no plotting library, colours and fonts left to the page's style sheet.

Each chart is complete without the script. The page's script zooms charts and finds scans in them. For it, axes and data are
separate groups, `data-view` holds the limits and positions of the axes, and `data-by` names the quantity of the abscissa.

Drawn by hand because a report must be quick (importing a plotting library alone takes half a second of a run that
lasts two), readable on a phone and follow the page's light and dark colours. Long series are drawn as minimum and
maximum per bin, so a peak is never lost.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats

# What of a scan an abscissa is: its number, distance along ground truth or travelled, s since the first; or both axes of a
# plane its place in the run's own world or as aligned to ground truth. Empty: nothing of a scan.
By = Literal["", "scan", "truth", "way", "time", "own", "aligned"]

WIDTH = 480
BINS = 360  # about one per pixel and a half of the plot area
MARGIN_LEFT, MARGIN_RIGHT, MARGIN_TOP, MARGIN_BOTTOM = 52, 14, 26, 40
MOST_POINTS = 3000


@dataclass(frozen=True)
class Line:
    """One series: x and y (N,); `style` is a class of the style sheet (`s1`..`s6`, `gt`)."""

    label: str
    x: NDArray[Any]
    y: NDArray[Any]
    style: str


@dataclass(frozen=True)
class Band:
    """An area between two series, `low` and `high` (N,), over `x` (N,), in the style of its line."""

    x: NDArray[Any]
    low: NDArray[Any]
    high: NDArray[Any]
    style: str


class Frame:
    """A plot area with axes: maps data to SVG units and collects elements."""

    def __init__(
        self,
        x_range: tuple[float, float],
        y_range: tuple[float, float],
        width: int = WIDTH,
        height: int = 260,
        by: By = "",
    ) -> None:
        self.width, self.height, self.by, self.kind = width, height, by, "chart"
        self.x0, self.x1 = _widen(*x_range)
        self.y0, self.y1 = _widen(*y_range)
        self.left, self.right = MARGIN_LEFT, width - MARGIN_RIGHT
        self.top, self.bottom = MARGIN_TOP, height - MARGIN_BOTTOM
        self.parts: list[str] = []
        self._grid: list[str] = []
        self._labels: list[str] = []

    def px(self, x: Any) -> Any:
        """SVG abscissa of data x."""
        return self.left + (np.asarray(x, np.float64) - self.x0) / (self.x1 - self.x0) * (self.right - self.left)

    def py(self, y: Any) -> Any:
        """SVG ordinate of data y."""
        return self.bottom - (np.asarray(y, np.float64) - self.y0) / (self.y1 - self.y0) * (self.bottom - self.top)

    def axes(self, x_label: str, y_label: str, x_ticks: int = 6, y_ticks: int = 5, whole_x: bool = False) -> None:
        """Grid, tick labels and axis labels; the y label stands above the axis, where it can be read."""
        for value in ticks(self.x0, self.x1, x_ticks, whole_x):
            x = float(self.px(value))
            self._grid.append(f'<path class="grid" d="M{x:.1f} {self.top}V{self.bottom}"/>')
            self._grid.append(_text(x, self.bottom + 16, number(value, self.x1 - self.x0), "middle", "tick"))
        for value in ticks(self.y0, self.y1, y_ticks):
            y = float(self.py(value))
            self._grid.append(f'<path class="grid" d="M{self.left} {y:.1f}H{self.right}"/>')
            self._grid.append(_text(self.left - 6, y + 4, number(value, self.y1 - self.y0), "end", "tick"))
        self._labels.append(f'<path class="axis" d="M{self.left} {self.top}V{self.bottom}H{self.right}"/>')
        self._labels.append(_text((self.left + self.right) / 2, self.height - 6, x_label, "middle", "label"))
        self._labels.append(_text(6, 14, y_label, "start", "label"))

    def add(self, element: str) -> None:
        """Append an SVG element."""
        self.parts.append(element)

    def text(self, x: float, y: float, text: str, anchor: str = "start", style: str = "tick") -> None:
        """Append text, escaped."""
        self.add(_text(x, y, text, anchor, style))

    def polyline(self, x: NDArray[Any], y: NDArray[Any], style: str) -> None:
        """Add a line of x, y (N,), broken where a value is not finite; a single point becomes a dot."""
        px, py = self.px(x), self.py(y)
        for run in finite_runs(px + py):
            if run.stop - run.start == 1:
                self.dot(float(px[run.start]), float(py[run.start]), style, 3)
            else:
                self.add(f'<path class="line {style}" d="{path(px[run], py[run])}"/>')

    def band(self, band: Band) -> None:
        """Add an area between two series, broken where one of its limits is not finite."""
        x, low, high = (
            np.asarray(v, np.float64)[:: max(len(band.x) // BINS, 1)] for v in (band.x, band.low, band.high)
        )
        px, py_low, py_high = self.px(x), self.py(low), self.py(high)
        for run in finite_runs(px + py_low + py_high):
            around = path(np.append(px[run], px[run][::-1]), np.append(py_low[run], py_high[run][::-1]))
            self.add(f'<path class="band {band.style}" d="{around}Z"/>')

    def dot(self, px: float, py: float, style: str, radius: float = 4) -> None:
        """Add a filled circle about (px, py) with a radius, all in SVG units."""
        self.add(f'<circle class="dot {style}" cx="{px:.1f}" cy="{py:.1f}" r="{radius:g}"/>')

    def marks(self, x: NDArray[Any], style: str) -> None:
        """Add vertical lines over the whole height at the abscissas `x`."""
        places = sorted({round(float(v)) for v in self.px(x)})
        if places:
            self.add(f'<path class="{style}" d="{"".join(f"M{p} {self.top}V{self.bottom}" for p in places)}"/>')

    def svg(self, title: str) -> str:
        """Finished SVG element; `title` is for screen readers. A chart without axes cannot be zoomed."""
        head = f'<svg viewBox="0 0 {self.width} {self.height}" role="img" aria-label="{escape(title)}"'
        content = "".join(self.parts)
        if not self._labels:
            return f"{head}>{content}</svg>"
        view = (self.x0, self.x1, self.y0, self.y1, self.left, self.right, self.top, self.bottom)
        return (
            f'{head} class="{self.kind}" data-view="{" ".join(f"{v:.9g}" for v in view)}" data-by="{self.by}">'
            f'<g class="ticks">{"".join(self._grid)}</g><g class="data">{content}</g>{"".join(self._labels)}</svg>'
        )


def _text(x: float, y: float, text: str, anchor: str, style: str) -> str:
    """SVG text element."""
    return f'<text class="{style}" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def ticks(low: float, high: float, count: int = 5, whole: bool = False) -> list[float]:
    """Round values (1, 2, 2.5 or 5 times a power of ten) inside [low, high], about `count` of them; whole : only integers.

    >>> ticks(0.0, 1.0)
    [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]
    """
    raw = (high - low) / max(count, 1)
    power = 10.0 ** np.floor(np.log10(raw))
    step = float(min((m * power for m in (1, 2, 2.5, 5, 10)), key=lambda s: abs(np.log(s / raw))))
    if whole:
        step = max(1.0, float(round(step)))
    first, last = int(np.ceil(low / step - 1e-9)), int(np.floor(high / step + 1e-9))
    return [float(f"{i * step:.12g}") for i in range(first, last + 1)]


def number(value: float, span: float) -> str:
    """Label of a tick, with decimals that suit the `span` of the axis, and a real minus sign.

    >>> number(-0.25, 1.0)
    '−0.25'
    """
    if value == 0:
        return "0"
    if span < 1e-4 or abs(value) >= 1e6:
        return f"{value:.3g}".replace("-", "−")
    decimals = int(np.clip(2 - np.floor(np.log10(span)), 0, 6))
    text = f"{value:.{decimals}f}"
    return (text.rstrip("0").rstrip(".") if "." in text else text).replace("-", "−")


def thin(x: NDArray[Any], y: NDArray[Any], bins: int = BINS) -> tuple[Floats, Floats]:
    """At most about 2 `bins` points of a long series: minimum and maximum per bin of equally many points, in order."""
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    if len(x) <= 2 * bins:
        return x, y
    edges = np.linspace(0, len(x), bins + 1).astype(int)[:-1]
    size = np.diff([*edges, len(x)])
    bin_of = np.repeat(np.arange(bins), size)
    low = np.lexsort((np.where(np.isfinite(y), y, np.inf), bin_of))[edges]
    high = np.lexsort((np.where(np.isfinite(y), -y, np.inf), bin_of))[edges]
    keep = np.unique(np.concatenate([low, high, [0, len(x) - 1]]))
    return x[keep], y[keep]


def path(px: NDArray[Any], py: NDArray[Any]) -> str:
    """Path data through SVG points, rounded to a tenth; runs of equal points are written once."""
    points = np.round(np.stack([px, py], axis=1), 1)
    fresh = np.ones(len(points), bool)
    fresh[1:] = (points[1:] != points[:-1]).any(1)
    return "M" + "L".join(f"{a:g} {b:g}" for a, b in points[fresh].tolist())


def finite_runs(values: NDArray[Any]) -> list[slice]:
    """Slices of consecutive finite values."""
    good = np.concatenate([[0], np.isfinite(values).astype(np.int8), [0]])
    edges = np.flatnonzero(np.diff(good))
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def span_of(arrays: list[NDArray[Any]], zero: bool = False) -> tuple[float, float] | None:
    """Smallest and largest finite value of all arrays (0 included when `zero`); None when there is none."""
    values = np.concatenate([np.asarray(a, np.float64).ravel() for a in arrays]) if arrays else np.zeros(0)
    values = values[np.isfinite(values)]
    if not len(values):
        return None
    low, high = float(values.min()), float(values.max())
    return (min(low, 0.0), max(high, 0.0)) if zero else (low, high)


def line_chart(
    lines: list[Line],
    x_label: str,
    y_label: str,
    title: str,
    *,
    zero: bool = True,
    marks: NDArray[Any] | None = None,
    whole_x: bool = False,
    bands: Sequence[Band] = (),
    by: By = "",
) -> str:
    """SVG of lines over a common abscissa; empty text when no value is finite.

    marks : abscissas of failed scans
    bands : areas behind the lines; where one is wider than the lines need, as at the start of a filter, it is cut off
    zero : whether the ordinate includes 0; whole_x : ticks of the abscissa at whole numbers only
    by : what of a scan the abscissa is
    """
    x_span, y_span = span_of([line.x for line in lines]), span_of([*(line.y for line in lines), *_tail(bands)], zero)
    if x_span is None or y_span is None:
        return ""
    pad = 0.06 * (y_span[1] - y_span[0])
    low = y_span[0] - (pad if y_span[0] < 0 or not zero else 0)
    frame = Frame(x_span, (low, y_span[1] + pad), by=by)
    frame.axes(x_label, y_label, whole_x=whole_x)
    if marks is not None:
        frame.marks(marks, "failed")
    for band in bands:
        low, high = np.clip(band.low, frame.y0, frame.y1), np.clip(band.high, frame.y0, frame.y1)
        frame.band(Band(band.x, low, high, band.style))
    for line in lines:
        frame.polyline(*thin(line.x, line.y), line.style)
    return frame.svg(title)


def _tail(bands: Sequence[Band]) -> list[NDArray[Any]]:
    """Limits of the bands in their second half, where a filter has converged."""
    return [v[len(v) // 2 :] for band in bands for v in (band.low, band.high)]


def _widen(low: float, high: float) -> tuple[float, float]:
    """Range with a positive width, also for a single value."""
    least = 1e-9 * max(1.0, abs(low), abs(high))
    if high - low > least:
        return low, high
    half = 0.5 * max(1e-3, 0.1 * abs(low)) if low else 0.5
    return (low, high + 2 * half) if low == 0 else (low - half, high + half)


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
    backdrop_style: str = "density",
    points: NDArray[Any] | None = None,
    dots: Sequence[tuple[str, NDArray[Any]]] = (),
    width: int = WIDTH,
    tallest: int = 460,
    by: By = "",
) -> str:
    """SVG of tracks from above, x to the right, y up; empty text when nothing is finite.

    backdrop : an image's address and its extent (x0, x1, y0, y1), m, in the style `backdrop_style`
    points : (K, 2) marked as failures; dots : points (K, 2) in a style each, one group over the other
    by : whose world it is; width, tallest : as for `_fit_frame`
    """
    xs, ys = [t.xy[:, 0] for t in tracks], [t.xy[:, 1] for t in tracks]
    if backdrop is not None:
        xs, ys = [*xs, np.array(backdrop[1][:2])], [*ys, np.array(backdrop[1][2:])]
    x_span, y_span = span_of(xs), span_of(ys)
    if x_span is None or y_span is None:
        return ""
    frame = _fit_frame(x_span, y_span, width, tallest, 0.0 if backdrop else 0.05)
    frame.by, frame.kind = by, "plane"
    frame.axes("x, m", "y, m", x_ticks=min(6, width // 80), y_ticks=max(2, round((frame.bottom - frame.top) / 60)))
    if backdrop is not None:
        x0, x1, y0, y1 = backdrop[1]
        left, right = float(frame.px(x0)), float(frame.px(x1))
        top, bottom = float(frame.py(y1)), float(frame.py(y0))
        frame.add(
            f'<image class="{backdrop_style}" x="{left:.1f}" y="{top:.1f}" width="{right - left:.1f}" '
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


def _fit_frame(x_span: tuple[float, float], y_span: tuple[float, float], width: int, tallest: int, pad: float) -> Frame:
    """Frame with one scale for x and y, its height chosen for the data.

    width, tallest : of the drawing and its greatest height, SVG units; pad : share of the data's size free on each side
    """
    margins_x = MARGIN_LEFT + MARGIN_RIGHT
    margins_y = MARGIN_TOP + MARGIN_BOTTOM
    size = np.array([x_span[1] - x_span[0], y_span[1] - y_span[0]])
    size = np.maximum(size * (1 + 2 * pad), max(float(size.max()) * 1e-3, 1.0))
    plot_width = width - margins_x
    plot_height = float(np.clip(plot_width * size[1] / size[0], 130, tallest - margins_y))
    metres = max(size[0] / plot_width, size[1] / plot_height)
    half = metres * np.array([plot_width, plot_height]) / 2
    centre = np.array([sum(x_span), sum(y_span)]) / 2
    low, high = centre - half, centre + half
    return Frame((low[0], high[0]), (low[1], high[1]), width, round(plot_height) + margins_y)


def _mark_ends(frame: Frame, xy: Floats) -> None:
    """Draw a circle at the start of the path (N, 2) and a square at its end; on a closed loop the circle is on top."""
    finite = xy[np.isfinite(xy).all(1)]
    if not len(finite):
        return
    px, py = frame.px(finite[:, 0]), frame.py(finite[:, 1])
    frame.add(f'<rect class="dot end" x="{px[-1] - 5:.1f}" y="{py[-1] - 5:.1f}" width="10" height="10"/>')
    frame.dot(float(px[0]), float(py[0]), "start", 4)
