"""The map of a page: its drawing from above, coloured by height, under which the script lays the points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from lslam.reports.colours import usual_range
from lslam.reports.plots import Figure
from lslam.reports.png import coloured_png, data_uri, density_png, halved
from lslam.reports.svg import By, Track, plane_chart

WIDTH, HEIGHT = 980, 700
MOST_PICTURE = 1_500_000  # bytes of the map from above, so that the page stays below 6 MB
FROM_ABOVE = "The more voxels of a column are occupied, the stronger it is drawn from above."


@dataclass(frozen=True)
class MapFigure:
    """A map from above: its drawing, the range of heights, m, that colours stand for, None of one that is grey, and its
    pixel, m."""

    figure: Figure
    heights: tuple[float, float] | None
    pixel: float


def map_figure(
    image: NDArray[Any],
    heights: NDArray[Any] | None,
    extent: tuple[float, float, float, float],
    tracks: list[Track],
    legend: Sequence[tuple[str, str]],
    world: str,
    by: By = "",
) -> MapFigure | None:
    """The map from above with trajectories on it; None where no point lies in it.

    image : (H, W) points per pixel, row 0 at the largest y; heights : (H, W) their mean z, m; grey without
    extent : x_min, x_max, y_min, y_max, m; world : a sentence that says whose frame it is; by : as of a plane chart
    """
    if not (image > 0).any():
        return None
    pixel = (extent[1] - extent[0]) / image.shape[1]
    if heights is None:
        span, png, style = None, density_png(image), "density"
    else:
        span, style = usual_range(heights), "coloured"
        png = coloured_png(image, heights, *span)
        while len(png) > MOST_PICTURE:
            image, heights = halved(image, heights)
            png = coloured_png(image, heights, *span)
    chart = plane_chart(
        tracks, "merged map from above", backdrop=(data_uri(png), extent), backdrop_style=style, width=WIDTH,
        tallest=HEIGHT, by=by,
    )  # fmt: skip
    return MapFigure(Figure("Map", chart, tuple(legend), f"{world} {FROM_ABOVE}"), span, pixel)
