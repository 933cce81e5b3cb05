"""Data for a page's script: all scans, map points, several trajectories, loop candidates; and the map's image.

Numbers are base64. Of a candidate: where it was, what was decided and why, and what both scans look like.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats, Longs
from lslam.core.geometry import se3, so3
from lslam.core.types.cloud import ArrayCloud
from lslam.core.types.constraint import LoopCandidate, LoopStage
from lslam.core.types.run_record import FeatureView, PairView, RunRecord
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.trajectory import Trajectory
from lslam.maps.colour import CHANNELS
from lslam.reports.back_end import STATES, state_codes
from lslam.reports.plots import Figure, first_available, line_figure, numbered_lines
from lslam.reports.png import VIRIDIS, Crop, coloured_png, crop_images, data_uri, density_png, halve, usual_range
from lslam.reports.svg import MOST_POINTS, By, Track, plane_chart

if TYPE_CHECKING:
    from lslam.evaluation.metric import Evaluation

STATUSES = ("registered", "standing", "bridged", "skipped", "not known")
FLAGS = {"degenerate": 8, "lost": 16}  # beside the status in one byte
MOST_POSES = 5000  # of one of several trajectories on a map
MOST_TRUTH = 5000  # points of ground truth under the map
LONGEST_REASON = 160  # characters
MOST_QUERIES = 2000  # points whose neighbour is looked for
MOST_KINDS = 8  # labels that have a colour of their own
QUANTA = 65535  # of a coordinate over the extent of the cloud


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
        "stamps": pack(trajectory.stamps_ns - trajectory.stamps_ns[0], "<f8"),
        "index": pack(np.array([-1 if r is None else r.index for r in results]), "<i4"),
        "positions": pack(trajectory.positions, "<f4"),
        "angles": pack(_angles_deg(trajectory.poses), "<f4"),
        "way": pack(trajectory.path_lengths, "<f4"),
        "status": pack(np.array([_status(r) for r in results]), "u1"),
        "statuses": STATUSES,
        "flags": FLAGS,
        "posed_by": pack(np.array([names.index(who) if who else len(names) for who in posers]), "u1"),
        "posers": names,
        "reasons": {
            str(k): r.reason[:LONGEST_REASON] for k, r in enumerate(results) if r is not None and r.status != "ok"
        },
        **_against_map(record),
        "loops": [record.keyframe_scans[[c.a, c.b]].tolist() for c in record.loops if c.is_accepted],
    }
    return data if evaluation is None else data | _truth(trajectory, evaluation)


def _against_map(record: RunRecord) -> dict[str, Any]:
    """State of each scan against the map that the run was located in; empty without one."""
    if not record.map_fixes:
        return {}
    return {"fixes": pack(state_codes(record), "u1"), "states": [list(state) for state in STATES.values()]}


def _truth(trajectory: Trajectory, evaluation: Evaluation) -> dict[str, Any]:
    """Errors, m, aligned trajectory and ground truth for the page; empty where no alignment is available."""
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
        "error": pack(error, "<f4"),
        "truth_way": pack(way, "<f4"),
        "aligned": np.column_stack([absolute.scale * T[:3, :3], T[:3, 3]]).tolist(),
        "truth": pack(se3.apply(se3.inverse(T), some) / absolute.scale, "<f4"),
    }


def cloud_data(
    cloud: ArrayCloud | None, trajectory: Trajectory | None = None, sessions: Sequence[Floats] = ()
) -> dict[str, Any] | None:
    """Some points of the map for the script; None if the map is empty.

    points : (M, 3) int16 q, where a coordinate is `low` + `step` (q + 32768), m; nearest : (M,) the nearest pose
    spacing : m from a point to the next, in the median
    height : usual range of heights, m; intensity : (M,) 0 to 255 over the range `values`, when the map has them
    rgb : (M, 3) colours; kind : (M,) index into `kinds`, the labels, most frequent first, when the map has them
    session : (M,) which of the `sessions`, positions (N, 3) of each, m, comes nearest to it
    change : (M,) int8, -1 gone, 0 as it was, 1 not in the map, of a drive in an old one

    Any first part of the points is spread over the whole map, so that a page can draw fewer while the map moves.
    """
    if cloud is None:
        return None
    order = np.random.default_rng(0).permutation(np.flatnonzero(np.isfinite(cloud.points).all(1)))
    points = cloud.points[order]
    if not len(points):
        return None
    data: dict[str, Any] = {
        **pack_points(points),
        "height": usual_range(points[:, 2]),
        "spacing": _spacing(points),
        "colours": VIRIDIS,
    }
    if cloud.intensity is not None and np.ptp(cloud.intensity[order]) > 0:
        values = cloud.intensity[order].astype(np.float64)
        least, most = usual_range(values, 0.1)
        data["intensity"] = pack(np.rint(255 * np.clip((values - least) / (most - least), 0, 1)), "u1")
        data["values"] = [least, most]
    if "red" in cloud.columns:
        data["rgb"] = pack(np.column_stack([cloud.columns[name][order] for name in CHANNELS]), "u1")
    if "class" in cloud.columns:
        data |= _kinds(cloud.columns["class"][order])
    if "change" in cloud.columns and cloud.columns["change"].any():
        data["change"] = pack(cloud.columns["change"][order], "i1")
    if trajectory is not None and len(trajectory):
        data["nearest"] = pack(_nearest(points, trajectory.positions), "<u2" if len(trajectory) <= QUANTA else "<u4")
    if sessions:
        owner = np.repeat(np.arange(len(sessions)), [len(positions) for positions in sessions])
        data["session"] = pack(owner[_nearest(points, np.concatenate(sessions))], "u1")
    return data


def pack_points(points: NDArray[np.floating]) -> dict[str, Any]:
    """Points (N, 3) that are finite, m, as int16 q, where a coordinate is `low` + `step` (q + 32768); N is `count`."""
    points = points[np.isfinite(points).all(1)].astype(np.float64)
    low, high = (points.min(0), points.max(0)) if len(points) else (np.zeros(3), np.zeros(3))
    step = np.maximum((high - low) / QUANTA, 1e-6)
    quanta = np.rint((points - low) / step) - (QUANTA + 1) // 2
    return {"count": len(points), "points": pack(quanta, "<i2"), "low": low.tolist(), "step": step.tolist()}


def _spacing(points: Floats) -> float:
    """Median distance, m, from some of the points (M, 3) to the nearest other one; 0 for one point."""
    from scipy.spatial import cKDTree

    if len(points) < 2:
        return 0.0
    away = np.asarray(cKDTree(points).query(points[:MOST_QUERIES], k=2)[0])
    return float(np.median(away[:, 1]))


def _kinds(labels: NDArray[Any]) -> dict[str, Any]:
    """Labels as indices into their names; those beyond `MOST_KINDS` share the last one."""
    known, which, counts = np.unique(labels, return_inverse=True, return_counts=True)
    rank = np.empty(len(known), np.int64)
    rank[np.argsort(-counts, kind="stable")] = np.arange(len(known))
    names = [str(label) for label in known[np.argsort(rank)]]
    if len(names) > MOST_KINDS:
        names = [*names[: MOST_KINDS - 1], "others"]
    return {"kind": pack(np.minimum(rank, MOST_KINDS - 1)[which], "u1"), "kinds": names}


def ways_data(
    ways: Sequence[tuple[str, str, Floats]],
    numbers: Sequence[Longs] | None = None,
    before: Sequence[Floats] | None = None,
) -> list[dict[str, Any]]:
    """Several trajectories on one map for the script, thinned: of each its name, style and positions (N, 3), m.

    numbers : (N,) of the scans of each, else they are counted; before : (N, 3) of each as it was before, m
    """
    shown = []
    for k, (name, style, positions) in enumerate(ways):
        some = slice(None, None, -(-len(positions) // MOST_POSES) or 1)
        index = np.arange(len(positions)) if numbers is None else numbers[k]
        data = {
            "name": name,
            "style": style,
            "positions": pack(positions[some], "<f4"),
            "index": pack(index[some], "<i4"),
        }
        shown.append(data if before is None else data | {"before": pack(before[k][some], "<f4")})
    return shown


def _nearest(points: Floats, positions: Floats) -> NDArray[np.intp]:
    """(M,) index of the finite position nearest to each point; 0 if none is finite."""
    from scipy.spatial import cKDTree

    known = np.flatnonzero(np.isfinite(positions).all(1))
    if not len(known):
        return np.zeros(len(points), np.intp)
    _, found = cKDTree(positions[known]).query(points)
    return np.asarray(known[found])


def _by_pose(trajectory: Trajectory, results: list[ScanResult]) -> list[ScanResult | None]:
    """Scan result of each pose of the trajectory; None where there is none."""
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
    """Code of a scan's result for the script: its word in `STATUSES` and flags."""
    if result is None:
        return STATUSES.index("not known")
    word = "standing" if result.is_stationary else "registered" if result.status == "ok" else result.status
    degenerate, lost = FLAGS["degenerate"] * bool(len(result.degenerate)), FLAGS["lost"] * result.may_be_elsewhere
    return STATUSES.index(word) + degenerate + lost


def _angles_deg(poses: Floats) -> Floats:
    """(N, 3) roll, pitch, yaw, deg; NaN for poses that are not finite."""
    angles = np.full((len(poses), 3), np.nan)
    good = np.isfinite(poses).all((1, 2))
    angles[good] = np.degrees(so3.euler_rpy(poses[good, :3, :3]))
    return angles


def pack(values: NDArray[Any], kind: str) -> str:
    """Base64 of an array in one of numpy's little-endian types."""
    return base64.b64encode(np.ascontiguousarray(values).astype(kind).tobytes()).decode("ascii")


WIDTH, HEIGHT = 980, 700
MOST_PICTURE = 1_500_000  # bytes of the map from above, so that the page stays below 6 MB
FROM_ABOVE = "The more voxels of a column are occupied, the stronger it is drawn from above."


@dataclass(frozen=True)
class MapFigure:
    """A map from above: an image, and the heights that its colours stand for, m (None for a grey one)."""

    figure: Figure
    heights: tuple[float, float] | None


def map_figure(
    image: NDArray[Any],
    heights: NDArray[Any] | None,
    extent: tuple[float, float, float, float],
    tracks: list[Track],
    legend: Sequence[tuple[str, str]],
    world: str,
    by: By = "",
    dots: Sequence[tuple[str, NDArray[Any]]] = (),
) -> MapFigure | None:
    """Map from above with trajectories; None if the image has no points.

    image : (H, W) points per pixel, row 0 at the largest y; heights : (H, W) their mean z, m; grey without
    extent : x_min, x_max, y_min, y_max, m; world : a sentence that says whose frame it is; by, dots : as of a plane chart
    """
    if not (image > 0).any():
        return None
    if heights is None:
        span, png, style = None, density_png(image), "density"
    else:
        span, style = usual_range(heights), "coloured"
        png = coloured_png(image, heights, *span)
        while len(png) > MOST_PICTURE:
            image, heights = halve(image, heights)
            png = coloured_png(image, heights, *span)
    chart = plane_chart(
        tracks,
        "merged map from above",
        backdrop=(data_uri(png), extent),
        backdrop_style=style,
        width=WIDTH,
        tallest=HEIGHT,
        by=by,
        dots=dots,
    )
    return MapFigure(Figure("Map", chart, tuple(legend), f"{world} {FROM_ABOVE}"), span)


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
    counts = [view.edge_counts.astype(np.float64), view.plane_counts.astype(np.float64)]
    lines = numbered_lines([name for _, name in LEGEND], view.scans.astype(np.float64), counts)
    per_scan: dict[str, Any] = {"spoken": "features per scan", "whole_x": True, "by": "scan"}
    looked = f"{len(view.scans)} scans, evenly spaced over the run."
    caption = "Sharp and flat features; grey: the less sharp and less flat."
    return [
        Figure(f"Features of scan {view.scan}", scan, LEGEND, caption),
        Figure("Feature map", whole, LEGEND[:1], f"Less sharp edges; grey: less planar points; of {looked}"),
        line_figure("Features per scan", lines, "scan", "features", f"Of {looked}", **per_scan),
    ]


def _backdrop(points: Floats, crop: Crop) -> tuple[str, tuple[float, float, float, float]]:
    """Image of points from above as a data URI, and its extent, m."""
    (image,), top = crop_images([points], crop)
    assert image is not None
    return data_uri(density_png(image, top)), crop.extent


MOST_CANDIDATES = 1000


def candidate_data(record: RunRecord) -> dict[str, Any] | None:
    """The candidates that were registered, the most doubtful first; None for a run that has no pose graph.

    poses : of both keyframes, positions in the trajectory; views : some of the candidates' clouds, by the candidate's position
    """
    if not len(record.trajectory) or record.map_fixes:
        return None
    tried = [c for c in record.loops if c.stage != LoopStage.THINNED]
    tried = sorted(tried, key=lambda c: (-c.doubt, c.a, c.b))[:MOST_CANDIDATES]
    views = {id(view.candidate): pair_data(view) for view in record.pair_views}
    epsg = None if record.georeference is None else record.georeference.epsg
    return {
        "candidates": [
            {"poses": record.keyframe_scans[[c.a, c.b]].tolist(), "doubt": round(c.doubt, 3), **judgement(c)}
            for c in tried
        ],
        "views": {str(k): views[id(c)] for k, c in enumerate(tried) if id(c) in views},
        "crs": "" if epsg is None else f"EPSG:{epsg}",
    }


def judgement(candidate: LoopCandidate) -> dict[str, Any]:
    """Verdict on a loop candidate as plain values; unknown numbers are None."""
    known = {"rmse": candidate.rmse, "overlap": candidate.overlap, "away": candidate.distance}
    return {
        "verdict": str(candidate.verdict),
        "stage": str(candidate.stage),
        "reason": candidate.reason,
        **{name: round(value, 4) if np.isfinite(value) else None for name, value in known.items()},
    }


def pair_data(view: PairView) -> dict[str, Any]:
    """Both clouds as `pack_points` has them, and the rows (3, 4) of `before` and `after`."""
    return {
        "a": pack_points(view.a),
        "b": pack_points(view.b),
        "before": view.before[:3].round(5).tolist(),
        "after": None if view.after is None else view.after[:3].round(5).tolist(),
    }
