"""Data for a page's script: all scans, map points, and the map's image with crops. Numbers are base64."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.geometry import se3, so3
from lslam.core.types.arrays import Floats, Longs
from lslam.core.types.cloud import ArrayCloud
from lslam.core.types.run_record import FeatureView, RunRecord
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.trajectory import Trajectory
from lslam.reports import svg
from lslam.reports.plots import Figure, first_available
from lslam.reports.png import VIRIDIS, coloured_png, data_uri, density_png, halved, usual_range
from lslam.reports.svg import MOST_POINTS, By, Track, plane_chart

if TYPE_CHECKING:
    from lslam.evaluation.metric import Evaluation

STATUSES = ("registered", "standing", "bridged", "skipped", "not known")
FLAGS = {"degenerate": 8, "lost": 16}  # beside the status in one byte
MOST_TRUTH = 5000  # points of ground truth under the map
LONGEST_REASON = 160  # characters
MOST_KINDS = 8  # labels that have a colour of their own
QUANTA = 65535  # of a coordinate over the extent of the cloud
SIZE_M = 20.0
MOST_CROPS = 3
PIXELS = 200
# m; a column whose points reach this high is a wall, a trunk, a car: structure, and not ground.
_RELIEF = 1.0
_CELL = 0.5
_STEP = 5.0


def scan_data(record: RunRecord, evaluation: Evaluation | None) -> dict[str, Any] | None:
    """Every pose of a run with the result of its scan; None for a run without poses.

    index, stamps (ns after `first_stamp_ns`), positions (m), angles (roll, pitch, yaw, deg), status and `way` (m travelled)
    are of each pose. With ground truth also `error` (m, by `alignment`) and `truth_way` (m along it), NaN where none matches;
    `aligned` (3, 4) takes positions to where the page draws them against ground truth, and `truth` is that in the run's world.
    """
    trajectory = record.trajectory
    if not len(trajectory):
        return None
    results = _by_pose(trajectory, record.results)
    posers = [None if r is None else r.poser(record.method) for r in results]
    names = list(dict.fromkeys(who for who in posers if who))
    data: dict[str, Any] = {
        "count": len(trajectory),
        "first_stamp_ns": str(int(trajectory.stamps_ns[0])),
        "stamps": packed(trajectory.stamps_ns - trajectory.stamps_ns[0], "<f8"),
        "index": packed(np.array([-1 if r is None else r.index for r in results]), "<i4"),
        "positions": packed(trajectory.positions, "<f4"),
        "angles": packed(_angles_deg(trajectory.poses), "<f4"),
        "way": packed(trajectory.path_lengths, "<f4"),
        "status": packed(np.array([_status(r) for r in results]), "u1"),
        "statuses": STATUSES,
        "flags": FLAGS,
        "posed_by": packed(np.array([names.index(who) if who else len(names) for who in posers]), "u1"),
        "posers": names,
        "reasons": {
            str(k): r.reason[:LONGEST_REASON] for k, r in enumerate(results) if r is not None and r.status != "ok"
        },
        "loops": [record.keyframe_scans[[c.a, c.b]].tolist() for c in record.loops if c.is_accepted],
    }
    return data if evaluation is None else data | _truth(trajectory, evaluation)


def _truth(trajectory: Trajectory, evaluation: Evaluation) -> dict[str, Any]:
    absolute = first_available(evaluation)
    if absolute is None:
        return {}
    at = _pose_indices(trajectory, evaluation)
    error, way = np.full((2, len(trajectory)), np.nan)
    error[at], way[at] = np.linalg.norm(absolute.errors, axis=1), evaluation.distance
    T = absolute.T_gt_est
    some = evaluation.gt_positions[:: -(-len(evaluation.gt_positions) // MOST_TRUTH)]
    return {
        "alignment": absolute.alignment,
        "error": packed(error, "<f4"),
        "truth_way": packed(way, "<f4"),
        "aligned": np.column_stack([absolute.scale * T[:3, :3], T[:3, 3]]).tolist(),
        "truth": packed(se3.apply(se3.inverse(T), some) / absolute.scale, "<f4"),
    }


def cloud_data(cloud: ArrayCloud | None, trajectory: Trajectory | None = None) -> dict[str, Any] | None:
    """Some points of the map for the script; None if the map is empty.

    points : (M, 3) int16 q, where a coordinate is `low` + `step` (q + 32768), m; nearest : (M,) the nearest pose
    height : usual range of heights, m; intensity : (M,) 0 to 255 over the range `values`, when the map has them
    rgb : (M, 3) colours; kind : (M,) index into `kinds`, the labels, most frequent first, when the map has them

    Any first part of the points is spread over the whole map, so that a page can draw fewer while the map moves.
    """
    if cloud is None:
        return None
    order = np.random.default_rng(0).permutation(np.flatnonzero(np.isfinite(cloud.points).all(1)))
    points = cloud.points[order]
    if not len(points):
        return None
    low = points.min(0)
    step = np.maximum((points.max(0) - low) / QUANTA, 1e-6)
    quanta = np.rint((points - low) / step) - (QUANTA + 1) // 2
    data: dict[str, Any] = {
        "count": len(points),
        "points": packed(quanta, "<i2"),
        "low": low.tolist(),
        "step": step.tolist(),
        "height": usual_range(points[:, 2]),
        "colours": VIRIDIS,
    }
    if cloud.intensity is not None and np.ptp(cloud.intensity[order]) > 0:
        values = cloud.intensity[order].astype(np.float64)
        least, most = usual_range(values, 0.1)
        data["intensity"] = packed(np.rint(255 * np.clip((values - least) / (most - least), 0, 1)), "u1")
        data["values"] = [least, most]
    if "red" in cloud.columns:
        data["rgb"] = packed(np.column_stack([cloud.columns[name][order] for name in ("red", "green", "blue")]), "u1")
    if "class" in cloud.columns:
        data |= _kinds(cloud.columns["class"][order])
    if trajectory is not None and len(trajectory):
        data["nearest"] = packed(_nearest(points, trajectory.positions), "<u2" if len(trajectory) <= QUANTA else "<u4")
    return data


def _kinds(labels: NDArray[Any]) -> dict[str, Any]:
    """Labels as indices into their names; those beyond `MOST_KINDS` share the last one."""
    known, which, counts = np.unique(labels, return_inverse=True, return_counts=True)
    rank = np.empty(len(known), np.int64)
    rank[np.argsort(-counts, kind="stable")] = np.arange(len(known))
    names = [str(label) for label in known[np.argsort(rank)]]
    if len(names) > MOST_KINDS:
        names = [*names[: MOST_KINDS - 1], "others"]
    return {"kind": packed(np.minimum(rank, MOST_KINDS - 1)[which], "u1"), "kinds": names}


def _nearest(points: Floats, positions: Floats) -> NDArray[np.intp]:
    """(M,) index of the finite position nearest to each point; 0 if none is finite."""
    from scipy.spatial import cKDTree

    known = np.flatnonzero(np.isfinite(positions).all(1))
    if not len(known):
        return np.zeros(len(points), np.intp)
    _, found = cKDTree(positions[known]).query(points)
    return np.asarray(known[found])


def _by_pose(trajectory: Trajectory, results: list[ScanResult]) -> list[ScanResult | None]:
    """Scan result of each pose."""
    at = {r.stamp_ns: r for r in results}
    return [at.get(stamp) for stamp in trajectory.stamps_ns.tolist()]


def _pose_indices(trajectory: Trajectory, evaluation: Evaluation) -> NDArray[np.intp]:
    """(N,) for each matched pose of the evaluation, the index of the trajectory's pose."""
    if evaluation.matched == len(trajectory):
        return np.arange(len(trajectory))
    stamps = evaluation.stamps_ns - round(evaluation.time_offset * 1e9)
    after = np.clip(np.searchsorted(trajectory.stamps_ns, stamps), 1, len(trajectory) - 1)
    before = stamps - trajectory.stamps_ns[after - 1] < trajectory.stamps_ns[after] - stamps
    return np.asarray(after - before)


def _status(result: ScanResult | None) -> int:
    if result is None:
        return STATUSES.index("not known")
    word = "standing" if result.is_stationary else "registered" if result.status == "ok" else result.status
    degenerate, lost = FLAGS["degenerate"] * bool(len(result.degenerate)), FLAGS["lost"] * result.is_lost
    return STATUSES.index(word) + degenerate + lost


def _angles_deg(poses: Floats) -> Floats:
    """(N, 3) roll, pitch, yaw, deg; NaN for poses that are not finite."""
    angles = np.full((len(poses), 3), np.nan)
    good = np.isfinite(poses).all((1, 2))
    angles[good] = np.degrees(so3.euler_rpy(poses[good, :3, :3]))
    return angles


def packed(values: NDArray[Any], kind: str) -> str:
    """Base64 of an array in one of numpy's little-endian types."""
    return base64.b64encode(np.ascontiguousarray(values).astype(kind).tobytes()).decode("ascii")


@dataclass(frozen=True)
class Crop:
    """A square seen from above: its centre and edge, m, in the world of the drawing."""

    x: float
    y: float
    size: float

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Limits x_min, x_max, y_min, y_max, m."""
        half = self.size / 2
        return (self.x - half, self.x + half, self.y - half, self.y + half)

    def inside(self, points: Floats) -> Floats:
        """Points among (K, 2) or (K, 3), m, that lie in the square."""
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
    """Images of the square, points per pixel of each cloud (M, 3), row 0 at the largest y; and the common count drawn black.

    None stays None; the count is the largest of the images' 99.5th percentiles of occupied pixels, at least 1.
    """
    images = [None if cloud is None else _image(cloud, crop) for cloud in clouds]
    tops = [float(np.percentile(image[image > 0], 99.5)) for image in images if image is not None and image.any()]
    return images, max([1.0, *tops])


def _structure(points: NDArray[Any]) -> tuple[Longs, Floats]:
    """Grid (x, y) of columns with relief, 0 or 1, and the grid's lower corner, m."""
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
    """Sums over windows of `window` x `window` cells, placed every `step` cells."""
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
    """A map from above.

    It has an image, the range of heights that colours stand for, m (None for a grey one), and the pixel size, m.
    """

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
    """Map from above with trajectories; None if the image has no points.

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
        tracks,
        "merged map from above",
        backdrop=(data_uri(png), extent),
        backdrop_style=style,
        width=WIDTH,
        tallest=HEIGHT,
        by=by,
    )
    return MapFigure(Figure("Map", chart, tuple(legend), f"{world} {FROM_ABOVE}"), span, pixel)


# m about the sensor that are drawn of one scan: beyond, sixteen beams leave points that no eye puts together.
DRAWN_REACH_M = 40.0
LEGEND = (("s1", "edges"), ("s2", "planar points"))


def feature_figures(view: FeatureView | None) -> list[Figure]:
    """Figures of the features of one scan, the feature map, and the number of features per scan; empty without features."""
    if view is None:
        return []
    crop = Crop(0.0, 0.0, 2 * DRAWN_REACH_M)
    scan = plane_chart(
        [],
        f"features of scan {view.scan}",
        backdrop=_backdrop(view.around, crop),
        dots=[("s2", crop.inside(view.planes)), ("s1", crop.inside(view.edges))],
    )
    low, high = view.map_planes[:, :2].min(axis=0, initial=np.inf), view.map_planes[:, :2].max(axis=0, initial=-np.inf)
    if not np.isfinite([low, high]).all():
        low, high = np.full(2, -DRAWN_REACH_M), np.full(2, DRAWN_REACH_M)
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
