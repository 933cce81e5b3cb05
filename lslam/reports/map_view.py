"""The map of a page and crops of it: its drawing from above, coloured by height, under which the script lays the points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.types.arrays import Floats, Longs
from lslam.core.types.run_record import FeatureView
from lslam.reports import svg
from lslam.reports.plots import Figure
from lslam.reports.png import coloured_png, data_uri, density_png, halved, usual_range
from lslam.reports.svg import MOST_POINTS, By, Track, plane_chart

SIZE_M = 20.0
MOST_CROPS = 3
PIXELS = 200
# m; a column whose points reach this high is a wall, a trunk, a car: structure, and not ground.
_RELIEF = 1.0
_CELL = 0.5
_STEP = 5.0


@dataclass(frozen=True)
class Crop:
    """A square seen from above: its centre and edge, m, in the world of the drawing."""

    x: float
    y: float
    size: float

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """x_min, x_max, y_min, y_max."""
        half = self.size / 2
        return (self.x - half, self.x + half, self.y - half, self.y + half)

    def inside(self, points: Floats) -> Floats:
        """Those of the points (K, 2) or (K, 3) that lie in it."""
        x0, x1, y0, y1 = self.extent
        return points[((points[:, :2] >= (x0, y0)) & (points[:, :2] <= (x1, y1))).all(axis=1)]


def choose_crops(points: NDArray[Any], size: float = SIZE_M, most: int = MOST_CROPS) -> list[Crop]:
    """At most `most` squares of `size` m that do not overlap, those with most structure first.

    Structure is counted in columns of 0.5 m whose points span more than 1 m of height; a square with less than a third of the
    best one's is not worth showing. Empty without any.

    Parameters
    ----------
    points : (M, 3) m; rows that are not finite are ignored
    """
    counts, low = _structure(points)
    window, step = round(size / _CELL), round(_STEP / _CELL)
    sums = _window_sums(counts, window, step)
    crops: list[Crop] = []
    best = sums.max(initial=0)
    while len(crops) < most:
        row, column = np.unravel_index(int(np.argmax(sums)), sums.shape)
        if sums[row, column] <= best / 3 or sums[row, column] == 0:
            break
        x, y = low + _CELL * (step * np.array([row, column]) + window / 2)
        crops.append(Crop(float(x), float(y), size))
        reach = -(-window // step)
        sums[max(row - reach + 1, 0) : row + reach, max(column - reach + 1, 0) : column + reach] = 0
    return crops


def crop_images(clouds: Sequence[NDArray[Any] | None], crop: Crop) -> tuple[list[NDArray[np.float32] | None], float]:
    """Points per pixel of each cloud (M, 3) in the square, row 0 at the largest y, and the count that is black in all.

    None stays None; the count is the largest of the images' 99.5th percentiles of occupied pixels, at least 1.
    """
    images = [None if cloud is None else _image(cloud, crop) for cloud in clouds]
    tops = [float(np.percentile(image[image > 0], 99.5)) for image in images if image is not None and image.any()]
    return images, max([1.0, *tops])


def _structure(points: NDArray[Any]) -> tuple[Longs, Floats]:
    """Columns with relief on a grid (x, y), 0 or 1, and the grid's lower corner."""
    xyz = np.asarray(points, np.float64)
    xyz = xyz[np.isfinite(xyz).all(1)]
    if not len(xyz):
        return np.zeros((1, 1), np.int64), np.zeros(2)
    low, high = np.percentile(xyz[:, :2], [0.1, 99.9], axis=0)
    low = np.floor(low / _STEP) * _STEP
    shape = np.maximum(np.ceil((high - low) / _CELL).astype(int), round(SIZE_M / _CELL))
    cell = np.floor((xyz[:, :2] - low) / _CELL).astype(int)
    inside = ((cell >= 0) & (cell < shape)).all(1)
    index = np.ravel_multi_index(tuple(cell[inside].T), tuple(shape))
    bottom, top = np.full(shape.prod(), np.inf), np.full(shape.prod(), -np.inf)
    np.minimum.at(bottom, index, xyz[inside, 2])
    np.maximum.at(top, index, xyz[inside, 2])
    return (top - bottom > _RELIEF).astype(np.int64).reshape(shape), low


def _window_sums(counts: Longs, window: int, step: int) -> Longs:
    """Sums over squares of `window` cells whose corners are `step` cells apart."""
    padded = np.pad(counts, ((0, max(window - counts.shape[0], 0)), (0, max(window - counts.shape[1], 0))))
    table = np.zeros((padded.shape[0] + 1, padded.shape[1] + 1), np.int64)
    table[1:, 1:] = padded.cumsum(0).cumsum(1)
    sums = table[window:, window:] - table[:-window, window:] - table[window:, :-window] + table[:-window, :-window]
    return sums[::step, ::step].copy()


def _image(cloud: NDArray[Any], crop: Crop) -> NDArray[np.float32]:
    x0, x1, y0, y1 = crop.extent
    counts, _, _ = np.histogram2d(cloud[:, 1], cloud[:, 0], bins=PIXELS, range=((y0, y1), (x0, x1)))
    image: NDArray[np.float32] = counts[::-1].astype(np.float32)
    return image


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


# m about the sensor that are drawn of one scan: beyond, sixteen beams leave points that no eye puts together.
REACH = 40.0
LEGEND = (("s1", "edges"), ("s2", "planar points"))


def feature_figures(view: FeatureView | None) -> list[Figure]:
    """What was seen on one scan, what the map is made of, and how many features each scan had; nothing without features."""
    if view is None:
        return []
    crop = Crop(0.0, 0.0, 2 * REACH)
    scan = plane_chart(
        [], f"features of scan {view.scan}", backdrop=_backdrop(view.around, crop),
        dots=[("s2", crop.inside(view.planes)), ("s1", crop.inside(view.edges))],
    )  # fmt: skip
    low, high = view.map_planes[:, :2].min(axis=0, initial=np.inf), view.map_planes[:, :2].max(axis=0, initial=-np.inf)
    if not np.isfinite([low, high]).all():
        low, high = np.full(2, -REACH), np.full(2, REACH)
    centre = (low + high) / 2
    around = Crop(float(centre[0]), float(centre[1]), float((high - low).max()) + 1.0)
    edges = view.map_edges[:: max(1, -(-len(view.map_edges) // MOST_POINTS)), :2]
    whole = plane_chart(
        [], "feature map", backdrop=_backdrop(view.map_planes, around), dots=[("s1", around.inside(edges))]
    )
    lines = [
        svg.Line("edges", view.scans.astype(np.float64), view.edge_counts.astype(np.float64), "s1"),
        svg.Line("planar points", view.scans.astype(np.float64), view.plane_counts.astype(np.float64), "s2"),
    ]
    counts = svg.line_chart(lines, "scan", "features", "features per scan", whole_x=True, by="scan")
    looked = f"{len(view.scans)} scans, evenly spaced over the run."
    return [
        Figure(
            f"Features of scan {view.scan}",
            scan,
            LEGEND,
            "Sharp and flat features; grey: the less sharp and less flat.",
        ),
        Figure("Feature map", whole, LEGEND[:1], f"Less sharp edges; grey: less planar points; of {looked}"),
        Figure("Features per scan", counts, LEGEND, f"Of {looked}"),
    ]


def _backdrop(points: Floats, crop: Crop) -> tuple[str, tuple[float, float, float, float]]:
    (image,), top = crop_images([points], crop)
    assert image is not None
    return data_uri(density_png(image, top)), crop.extent
