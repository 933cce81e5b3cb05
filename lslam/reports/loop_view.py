"""The map at the loop that was corrected most, before and after the pose graph, as two figures of one scale."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.reports.compare_crops import Crop, crop_images
from lslam.reports.plane import Track, plane_chart
from lslam.reports.plots import Figure
from lslam.reports.png import data_uri, density_png
from lslam.types.loop_view import LoopView

# m; the edge of the square leaves so much beside the correction, and is no smaller and no larger than that.
BESIDE, SMALLEST, LARGEST = 40.0, 50.0, 150.0


def loop_figures(view: LoopView | None) -> list[Figure]:
    """Both figures; nothing without a loop."""
    if view is None:
        return []
    size = float(np.clip(2 * view.correction + BESIDE, SMALLEST, LARGEST))
    places = (("before", view.before), ("after", view.after))
    crops = [Crop(float(place.centre[0]), float(place.centre[1]), size) for _, place in places]
    # The same grey in both: what is drawn twice is fainter, not hidden.
    images = [crop_images([place.points], crop) for (_, place), crop in zip(places, crops, strict=True)]
    top = max(top for _, top in images)
    legend = (("s2", f"scan {view.older_scan} and around"), ("s1", f"scan {view.newer_scan} and around"))
    caption = f"Keyframes on both ways past the loop that was corrected most, by {view.correction:.2f} m."
    figures = []
    for (word, place), crop, ((image,), _) in zip(places, crops, images, strict=True):
        assert image is not None
        tracks = [Track("older", _inside(place.older, crop), "s2"), Track("newer", _inside(place.newer, crop), "s1")]
        backdrop = (data_uri(density_png(image, top)), crop.extent)
        chart = plane_chart(tracks, f"map at a loop, {word} the pose graph", backdrop=backdrop)
        figures.append(Figure(f"Map at a loop, {word} the pose graph", chart, legend, caption))
    return figures


def _inside(way: NDArray[np.float64], crop: Crop) -> NDArray[np.float64]:
    """The part of a way (K, 2) that lies in the crop."""
    x0, x1, y0, y1 = crop.extent
    return way[((way >= (x0, y0)) & (way <= (x1, y1))).all(axis=1)]
