"""What the points of a drawn figure stand for, so that a page can say it where the pointer is."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

POINTS = ("o", ".", "x")  # markers; lines without say nothing
LOST = "x"


class PicturePoint(NamedTuple):
    """A drawn point: `x`, `y` as shares of the picture from its upper left corner, and what it stands for."""

    x: float
    y: float
    text: str


def picture_points(figure: Any, cross: str) -> list[PicturePoint]:
    """The points of all plots of a matplotlib figure that is laid out: curve, abscissa, ordinate with half its interval.

    cross : what a cross says instead of an ordinate
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
                value = cross if line.get_marker() == LOST else _quantity(ordinate, _number(y) + half)
                words = (title, name, _quantity(abscissa, _tick(plot, x)), value)
                found.append(
                    PicturePoint(
                        round(float(left), 4), round(float(1 - up), 4), ", ".join(word for word in words if word)
                    )
                )
    return found


def _lines(plot: Any) -> Iterator[tuple[Any, str, list[str]]]:
    """Lines with markers, the name of the curve, and half the interval about each point, in words.

    A name that begins with an underscore stands in no legend.
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


def _quantity(label: str, value: str) -> str:
    """A value with the name and the unit of its axis."""
    name, comma, unit = label.rpartition(", ")
    return f"{name} {value} {unit}" if comma else f"{label} {value}"


def _tick(plot: Any, x: float) -> str:
    """The word at an abscissa where words stand there."""
    from matplotlib.ticker import FuncFormatter

    formatter = plot.xaxis.get_major_formatter()
    return (formatter(x) if isinstance(formatter, FuncFormatter) else "") or f"{x:g}"


def _number(value: float) -> str:
    return f"{value:.3g}"
