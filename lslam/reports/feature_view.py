"""Features of a scan, of the map and over time, as three figures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.reports import svg
from lslam.reports.crops import Crop, crop_images
from lslam.reports.plots import Figure
from lslam.reports.png import data_uri, density_png
from lslam.reports.svg import MOST_POINTS, plane_chart
from lslam.types.run_record import FeatureView

Floats = NDArray[np.float64]

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
