"""One page of A4 about a survey: its map with scale bar and north arrow, and what one signs beneath it."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from lslam.core.types.arrays import Floats
from lslam.reports.picture import COLOURS, house_style, picture

if TYPE_CHECKING:
    from numpy.typing import NDArray

_MM = 1 / 25.4  # inch
_PAGE, _MARGIN = (210.0, 297.0), 15.0  # mm
_MAP_MM, _MAP_LOW_MM = (_PAGE[0] - 2 * _MARGIN - 4, 142.0), 130.0
_TEXT_LOW_MM, _LINE_MM, _COLUMN_CHARACTERS, _TITLE_CHARACTERS = 25.0, 3.0, 68, 62
_SCALES = (1, 1.25, 1.5, 2, 2.5, 3, 4, 5, 7.5)
_MARKS = {"used": ("^", "control points, used"), "kept out": ("o", "check points, kept out")}
_STATUS = {"ok": COLOURS[0], "bridged": COLOURS[1], "skipped": "0.5"}


@dataclass(frozen=True)
class SurveySheet:
    """What stands on the page; places in the delivered coordinates, m.

    image : (H, W) grey map from above, None without one; extent : its x_min, x_max, y_min, y_max
    drives : positions (N, 2) and the status of each scan; points : (N, 2) by `used` and `kept out`
    axes : names of both; has_north : whether the second points to grid north
    warning : one clause that stands out, or none; left, right : paragraphs by heading; foot : last line
    """

    title: str
    subtitle: str
    warning: str
    image: NDArray[np.uint8] | None
    extent: tuple[float, float, float, float]
    drives: Sequence[tuple[Floats, Sequence[str]]]
    points: Mapping[str, Floats]
    axes: tuple[str, str]
    has_north: bool
    left: Mapping[str, Sequence[str]]
    right: Mapping[str, Sequence[str]]
    foot: str


def nice(value: float, steps: Sequence[float] = (1, 2, 5)) -> float:
    """The smallest of `steps` times a power of ten that is not below `value`.

    >>> nice(0.7), nice(230.0), nice(2.0), nice(230.0, (1, 2, 2.5, 5))
    (1.0, 500.0, 2.0, 250.0)
    """
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step * power for step in (*steps, 10) if step * power >= value * (1 - 1e-9)))


def survey_pdf(sheet: SurveySheet) -> bytes:
    """PDF of the page."""
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    with house_style(7.5):
        figure = Figure(figsize=(_PAGE[0] * _MM, _PAGE[1] * _MM))
        title = textwrap.shorten(sheet.title, _TITLE_CHARACTERS, placeholder=" ...")
        figure.text(*_at(_MARGIN, 284), title, size=14, weight="bold", va="center", parse_math=False)
        figure.text(*_at(_MARGIN, 277.5), sheet.subtitle, size=8.5, va="center", parse_math=False)
        figure.text(*_at(_MARGIN, 290.5), sheet.warning, size=9, weight="bold", color=COLOURS[1], va="center")
        _draw_map(figure, sheet)
        _draw_column(figure, sheet.left, _MARGIN)
        _draw_column(figure, sheet.right, _PAGE[0] / 2 + 2)
        for x, what in ((_MARGIN, "checked by"), (_PAGE[0] / 2 + 2, "place, date, signature")):
            figure.add_artist(Line2D([x / _PAGE[0], (x + 84) / _PAGE[0]], [20 / _PAGE[1]] * 2, color="black", lw=0.6))
            figure.text(*_at(x, 17), what, size=6.5, color="0.35", va="center")
        figure.text(*_at(_MARGIN, 10), sheet.foot, size=6.5, color="0.35", va="center", parse_math=False)
        return picture(figure, "pdf", dpi=250)


def _at(x_mm: float, y_mm: float) -> tuple[float, float]:
    return x_mm / _PAGE[0], y_mm / _PAGE[1]


def _draw_map(figure: Any, sheet: SurveySheet) -> None:
    plot = figure.add_axes((*_at(_MARGIN + 4, _MAP_LOW_MM), *_at(*_MAP_MM)))
    low, high = np.array(sheet.extent[::2]), np.array(sheet.extent[1::2])
    size_m = 1e-3 * np.array(_MAP_MM)
    scale = nice(float(((high - low) / size_m).max()), _SCALES)
    middle, half = (low + high) / 2, scale * size_m / 2
    if sheet.image is not None:
        plot.imshow(sheet.image, cmap="gray", vmin=0, vmax=255, extent=sheet.extent, interpolation="antialiased")
    for positions, statuses in sheet.drives:
        plot.plot(*positions.T, color=_STATUS["ok"], lw=1.0)
        for status in ("bridged", "skipped"):
            there = positions[np.array(statuses) == status]
            plot.plot(*there.T, ".", color=_STATUS[status], ms=4, label=f"scans {status}" if len(there) else "_")
        plot.plot(*positions[0], "s", color=_STATUS["ok"], ms=4)
    plot.plot([], [], "s-", color=_STATUS["ok"], ms=4, lw=1.0, label="trajectory, from its start")
    for kind, places in sheet.points.items():
        mark, name = _MARKS[kind]
        edge = COLOURS[1] if kind == "used" else COLOURS[3]
        plot.plot(*places.T, mark, ms=6, mfc="white", mec=edge, mew=1.3, label=name)
    plot.set(xlim=(middle[0] - half[0], middle[0] + half[0]), ylim=(middle[1] - half[1], middle[1] + half[1]))
    plot.set_aspect("equal", adjustable="box")
    plot.ticklabel_format(useOffset=False, style="plain")
    plot.tick_params(labelsize=6, direction="in", top=True, right=True)
    plot.tick_params(axis="y", labelrotation=90)
    plot.set_xlabel(sheet.axes[0], fontsize=6.5)
    plot.set_ylabel(sheet.axes[1], fontsize=6.5)
    plot.grid(alpha=0.25, lw=0.4)
    plot.legend(loc="upper left", fontsize=6.5, framealpha=0.85, edgecolor="0.7")
    _draw_scale_bar(figure, scale)
    if sheet.has_north:
        paper = {"boxstyle": "square,pad=0.3", "fc": "white", "ec": "none", "alpha": 0.85}
        arrow = {"arrowstyle": "-|>", "lw": 1.2, "color": "black"}
        plot.annotate("", (0.955, 0.97), (0.955, 0.89), xycoords="axes fraction", arrowprops=arrow)
        plot.text(0.955, 0.875, "N", ha="center", va="top", size=9, weight="bold", transform=plot.transAxes, bbox=paper)


def _draw_scale_bar(figure: Any, scale: float) -> None:
    """A bar of some 40 mm, half black, and the scale of the print."""
    length = nice(0.03 * scale)
    x, y, mm = _MARGIN + 10, _MAP_LOW_MM + 7, 1e3 / scale
    back = figure.add_axes((*_at(x - 3, y - 4.5), *_at(length * mm + 26, 11)), facecolor="white")
    back.set(xlim=(-3, length * mm + 23), ylim=(-4.5, 6.5), xticks=[], yticks=[])
    back.patch.set_alpha(0.85)
    back.spines[:].set_visible(False)
    half = length * mm / 2
    back.barh([0.0, 0.0], [half, half], 1.6, [0.0, half], color=["black", "white"], ec="black", lw=0.6)
    for tick in (0.0, length / 2, length):
        back.text(tick * mm, 1.6, f"{tick:g}", size=6, ha="center")
    back.text(length * mm + 3, -0.8, "m", size=6)
    back.text(0, -3.8, f"1 : {scale:g} on A4", size=6)


def _draw_column(figure: Any, paragraphs: Mapping[str, Sequence[str]], x_mm: float) -> None:
    """Paragraphs below their headings, down to the signatures; what does not fit is counted."""
    y = _MAP_LOW_MM - 14
    for heading, texts in paragraphs.items():
        figure.text(*_at(x_mm, y), heading, weight="bold", va="center")
        y -= _LINE_MM + 0.6
        for k, text in enumerate(texts):
            wrapped = textwrap.wrap(text, _COLUMN_CHARACTERS, break_on_hyphens=False)
            if y - (len(wrapped) + 1) * _LINE_MM < _TEXT_LOW_MM:
                figure.text(*_at(x_mm, y), f"and {len(texts) - k} more: see README.txt", va="center", style="italic")
                return
            for line in wrapped:
                figure.text(*_at(x_mm, y), line, size=6.8, va="center", parse_math=False)
                y -= _LINE_MM
            y -= 0.8
        y -= 1.6
