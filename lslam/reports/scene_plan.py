"""Plan of a simulated scene as a picture: top view with labelled grid, and a legend of scale, north and colours."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lslam.io.formats.atomic import atomic_write
from lslam.reports.picture import house_style
from lslam.simulation.plan import COARSE, COLOURS, FINE, PATH

if TYPE_CHECKING:
    from lslam.simulation.plan import ScenePlan

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
        names = [(surface.name.lower(), COLOURS[surface] / 255, "s") for surface in plan.surfaces]
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
    _shape(
        figure,
        "Polygon",
        [
            (left, top - letter),
            (left - 0.5 * letter, top - 2.4 * letter),
            (left, top - 2 * letter),
            (left + 0.5 * letter, top - 2.4 * letter),
        ],
        facecolor="black",
    )
    _text(figure, left, top, "N", ha="center", va="top", weight="bold")
    length = bar_length(float(plan.high[0] - plan.low[0]))
    start, pixels, y = 3 * letter, length / plan.pixel, top - 2.2 * letter
    for half, colour in enumerate(("black", "white")):
        _shape(
            figure,
            "Rectangle",
            (start + half * pixels / 2, y),
            pixels / 2,
            0.5 * letter,
            facecolor=colour,
            edgecolor="black",
            linewidth=1,
        )
    for share, said in ((0, "0"), (0.5, f"{length / 2:g}"), (1, f"{length} m")):
        _text(figure, start + share * pixels, top, said, ha="center", va="top")
    said = f"a line every {FINE} m, numbers every {COARSE} m;\nx to the east, y to the north"
    _text(figure, start + pixels + 3 * letter, top, said, va="top", linespacing=1.3)


def _legend_rows(figure: Any, names: list[Any], width: int, letter: float) -> list[list[Any]]:
    """Legend entries (name, colour, kind of mark, position) in rows no wider than the plan."""
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
    for name, colour, kind, x in row:
        tall = letter if kind == "s" else 0.35 * letter
        _shape(figure, "Rectangle", (x, y + (letter - tall) / 2), letter, tall, facecolor=colour, edgecolor="none")
        _text(figure, x + 1.5 * letter, y + letter / 2, name, va="center_baseline")
