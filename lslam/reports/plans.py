"""Plans with a scale bar and a north arrow: of a survey, on one page of A4 with what one signs beneath it, and of a scene.

The plan of a simulated scene is a top view with a labelled grid, and a legend of scale, north and colours.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.io.formats.atomic import atomic_write
from lslam.reports.picture import COLOURS, house_style, picture
from lslam.simulation.plan import COARSE, FINE, PATH, ScenePlan
from lslam.simulation.plan import COLOURS as SURFACE_COLOURS

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
    """Position on the page as fractions of its width and height, from mm."""
    return x_mm / _PAGE[0], y_mm / _PAGE[1]


def _draw_map(figure: Any, sheet: SurveySheet) -> None:
    """Draw the map to scale with trajectories, scans without registration, and points."""
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
    """Draw paragraphs below their headings in a column at `x_mm`; the last line counts those that do not fit."""
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


Pixels = NDArray[np.uint8]

_DPI = 100
# Pixels of a letter: legible where a large plan is shown smaller.
_SMALLEST, _LARGEST, _PER_LETTER = 13, 24, 70
_BAR_SHARE = 0.35  # of the width that the scale bar takes, at most
_HALO = {"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 1.5}


def write_plan(path: Path, plan: ScenePlan) -> None:
    """Write the view in its own pixels with the legend below it, as a PNG. Raises OutputError."""
    from matplotlib.figure import Figure
    from matplotlib.image import imsave

    height, width, _ = plan.image.shape
    letter = min(max(width / _PER_LETTER, _SMALLEST), _LARGEST)
    with house_style(font=letter * 72 / _DPI):
        figure = Figure(figsize=(width / _DPI, 1), dpi=_DPI)
        names = [(surface.name.lower(), SURFACE_COLOURS[surface] / 255, "s") for surface in plan.surfaces]
        if plan.has_path:
            colour = [c / 255 for c in PATH]
            names += [("path", colour, "-"), ("its start", colour, "s")]
        rows = _legend_rows(figure, names, width, letter)
        below = round((3.9 + 1.6 * len(rows)) * letter)
        figure.set_size_inches(width / _DPI, (height + below) / _DPI)
        _label_grid(figure, plan, below)
        _draw_scale(figure, plan, below, letter)
        for k, row in enumerate(rows):
            _draw_legend(figure, row, below - (4.9 + 1.6 * k) * letter, letter)
        whole = _laid_on(plan.image, figure)
    with atomic_write(path) as stream:
        imsave(stream, whole, format="png")


def _laid_on(image: Pixels, figure: Any) -> Pixels:
    """Image with the figure, which is as wide and higher, blended over it. matplotlib would resample the image."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure.patch.set_alpha(0)
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    drawn = np.asarray(canvas.buffer_rgba())
    under = np.full((*drawn.shape[:2], 3), 255, np.uint8)
    under[: len(image)] = image
    opacity = drawn[..., 3:] / np.float32(255)
    return np.rint(under * (1 - opacity) + drawn[..., :3] * opacity).astype(np.uint8)


def bar_length(width: float) -> int:
    """Length of the scale bar, m, of a plan `width` m wide: 1, 2 or 5 times a power of ten.

    >>> [bar_length(width) for width in (60.0, 180.0, 950.0)]
    [20, 50, 200]
    """
    decade = 10 ** math.floor(math.log10(_BAR_SHARE * width))
    return int(max(n * decade for n in (1, 2, 5) if n * decade <= _BAR_SHARE * width))


def _text(figure: Any, x: float, y: float, text: str, **style: Any) -> Any:
    """Draw text at a pixel from the lower left corner."""
    return figure.text(x, y, text, transform=None, **style)


def _shape(figure: Any, kind: str, *given: Any, **style: Any) -> None:
    """Add a patch of matplotlib to the figure, in pixels; kind : its class."""
    from matplotlib import patches

    figure.add_artist(getattr(patches, kind)(*given, transform=None, **style))


def _label_grid(figure: Any, plan: ScenePlan, below: int) -> None:
    """Draw metres at the lower end of every darker column and the left end of every darker row."""
    for metre, column in plan.marks(0):
        _text(figure, column + 4, below + 4, str(metre), va="bottom", bbox=_HALO)
    for metre, row in plan.marks(1):
        _text(figure, 4, below + row + 4, str(metre), va="bottom", bbox=_HALO)


def _draw_scale(figure: Any, plan: ScenePlan, below: int, letter: float) -> None:
    """Draw the north arrow, a scale bar of two halves with metres above it, and the grid spacing."""
    top = below - 0.5 * letter
    left = 0.9 * letter
    corners = ((0.0, 1.0), (-0.5, 2.4), (0.0, 2.0), (0.5, 2.4))
    arrow = [(left + x * letter, top - y * letter) for x, y in corners]
    _shape(figure, "Polygon", arrow, facecolor="black")
    _text(figure, left, top, "N", ha="center", va="top", weight="bold")
    length = bar_length(float(plan.high[0] - plan.low[0]))
    start, pixels, y = 3 * letter, length / plan.pixel, top - 2.2 * letter
    for half, colour in enumerate(("black", "white")):
        box = (start + half * pixels / 2, y), pixels / 2, 0.5 * letter
        _shape(figure, "Rectangle", *box, facecolor=colour, edgecolor="black", linewidth=1)
    for share, said in ((0, "0"), (0.5, f"{length / 2:g}"), (1, f"{length} m")):
        _text(figure, start + share * pixels, top, said, ha="center", va="top")
    said = f"a line every {FINE} m, numbers every {COARSE} m;\nx to the east, y to the north"
    _text(figure, start + pixels + 3 * letter, top, said, va="top", linespacing=1.3)


def _legend_rows(figure: Any, names: list[Any], width: int, letter: float) -> list[list[Any]]:
    """Legend entries (name, colour, kind of mark, position) in rows no wider than `width` pixels; letter : px, of a letter."""
    rows: list[list[Any]] = [[]]
    x = 0.5 * letter
    for name, colour, kind in names:
        words = _text(figure, 0, 0, name)
        wide = 1.6 * letter + words.get_window_extent().width + 1.2 * letter
        words.remove()
        if rows[-1] and x + wide > width:
            rows.append([])
            x = 0.5 * letter
        rows[-1].append((name, colour, kind, x))
        x += wide
    return rows


def _draw_legend(figure: Any, row: list[Any], y: float, letter: float) -> None:
    """Draw one row of the legend at height `y`; letter : size of a letter, pixels."""
    for name, colour, kind, x in row:
        tall = letter if kind == "s" else 0.35 * letter
        _shape(figure, "Rectangle", (x, y + (letter - tall) / 2), letter, tall, facecolor=colour, edgecolor="none")
        _text(figure, x + 1.5 * letter, y + letter / 2, name, va="center_baseline")
