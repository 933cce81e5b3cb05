"""Results of the pose graph for the summary and the report: loops, fixes, errors before and after, uncertainty.

Of a drive in a map that exists: where the map holds its scans, and where odometry carries them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.geometry import se3
from lslam.core.printable import count_of, metres
from lslam.core.types.cloud import ArrayCloud
from lslam.core.types.comparison import Table
from lslam.core.types.constraint import MapFix
from lslam.core.types.run_record import LoopView, RunRecord
from lslam.reports import svg
from lslam.reports.buildings import drift_tables
from lslam.reports.plots import ALIGNED, DISTANCE, PLAN_HEIGHT, WAY, Figure, first_available, line_figure
from lslam.reports.png import PIXELS, Crop, crop_images, data_uri, density_png
from lslam.reports.svg import MOST_POINTS, WIDTH, By, Track, plane_chart

if TYPE_CHECKING:
    from lslam.evaluation.metric import Evaluation

# How fixes were used.
_WAYS = {"graph": "GNSS in the graph", "fit": "GNSS fitted afterwards"}

# Ellipses on the plan, and their sigmas.
ELLIPSES, SIGMAS = 16, 3.0
# m; the edge of the square leaves so much beside the correction, and is no smaller and no larger than that.
BESIDE, SMALLEST, LARGEST = 40.0, 50.0, 150.0


def back_end_rows(record: RunRecord, evaluation: Evaluation | None) -> list[tuple[str, str]]:
    """Names and values for the summary; empty for a run without a back end."""
    rows = []
    if record.loops or record.manifest.get("graph", {}).get("loops"):
        closed = sum(c.is_accepted for c in record.loops)
        tried = sum(c.stage != "thinned" for c in record.loops)
        text = f"{closed} closed of {tried} tried"
        if evaluation is not None and evaluation.odometry is not None:
            text += f"; {before_and_after(evaluation, evaluation.odometry)}"
        rows.append(("loops", text))
    place = record.georeference
    if place is not None:
        lat, lon, height = (float(v) for v in place.origin)
        way, rmse = _WAYS.get(place.method), metres(place.rmse_horizontal)
        said = f"{way}: {place.used} of {place.fixes} fixes, {rmse} m rms horizontally"
        if record.map_fixes:
            said = "that of the map"
        elif place.method == "osm":
            said = "by the buildings of OpenStreetMap"
        elif place.method == "control":
            said = "by control points"
        rows.append(("georeference", f"origin {lat:.7f}, {lon:.7f}, {height:.1f} m; {said}"))
    control = record.manifest.get("graph", {}).get("control_points")
    if control is not None:
        horizontal, vertical = (metres(control[f"rms_{axes}_m"]) for axes in ("horizontal", "vertical"))
        text = f"{count_of(control['count'], 'point')}, {horizontal} m rms horizontally and {vertical} m vertically, "
        rows.append(("control", f"{text}the worst {control['worst_sigmas']:.1f} sigmas off"))
    if record.osm is not None:
        (east, north), sigma = -record.osm.shift, float(record.osm.shift_sigma.max())
        osm, shift = record.osm, f"{east:+.2f} m east and {north:+.2f} m north of the run (sigma {sigma:.2f} m)"
        text = f"{len(osm.accepted_matches)} of {len(osm.keyframes)} keyframes held by {len(osm.buildings)} buildings"
        rows.append(("OpenStreetMap", f"{text}, which lie {shift}"))
    rows += [_drift_row(table) for table in drift_tables(record)]
    if record.buildings is not None:
        found = record.buildings
        moves = [float(np.linalg.norm(c.displacement[:2])) for c in found.buildings if c.status == "seen"]
        gone = sum(c.status == "absent" for c in found.buildings)
        said = f"{len(moves)} seen" + (f", moved by {np.median(moves):.2f} m (median)" if moves else "")
        new = f"{count_of(len(found.new_walls), 'wall')} without a building"
        rows.append(("buildings", f"{said}; {gone} absent; {new}; {count_of(len(found.overlaps), 'overlap')} left"))
    return rows


def _drift_row(table: Table) -> tuple[str, str]:
    """Corrected drift of the odometry, as one line."""
    told = [
        f"{word} {estimate} ± {sigma}" + "".join(f" (rms {rms})" for rms in rest)
        for word, estimate, sigma, *rest in table.rows
    ]
    return table.title.removesuffix(" of odometry").lower(), "; ".join(told) + ", set right"


def back_end_figures(record: RunRecord, evaluation: Evaluation | None) -> list[Figure]:
    """Figures of plan, error and map at a loop, before and after the pose graph, where it visibly moved poses."""
    odometry = record.odometry
    if odometry is None or odometry is record.trajectory:
        return []
    after = record.trajectory.positions[:, :2]
    tracks, legend = [], []
    absolute = first_available(evaluation)
    if evaluation is not None and absolute is not None and absolute.scale == 1.0:
        truth = se3.apply(se3.inverse(absolute.T_gt_est), evaluation.gt_positions)
        tracks.append(Track("ground truth", truth[:, :2], "gt"))
        legend.append(("gt", "ground truth"))
    captions = ["Estimate in its own world" + ("; ground truth moved to it." if tracks else ".")]
    what = "localisation" if record.map_fixes else "the pose graph"
    moved, pixel = largest_correction(record), _extent(record) / WIDTH
    is_seen = moved > pixel
    if is_seen:
        before = se3.apply(record.T_final_odometry, odometry.positions)[:, :2]
        tracks.append(Track("before", before, "s2"))
        legend.append(("s2", "odometry"))
    captions.append(f"{what[0].upper()}{what[1:]} moved poses by at most {metres(moved)} m.")
    tracks.append(Track("after", after, "s1", ends=True))
    legend.append(("s1", f"after {what}"))
    closed = [c for c in record.loops if c.is_accepted]
    for loop in closed:
        ends = record.keyframe_scans[[loop.a, loop.b]]
        tracks.append(Track("loop", after[ends], "s3"))
    legend += [("s3", f"{count_of(len(closed), 'loop')} closed")] if closed else []
    ellipses, largest = _ellipses(record)
    beside = " beside the map's own shift" if _common(record).any() else ""
    if largest > pixel:
        tracks += [Track("uncertainty", ellipse, "s4") for ellipse in ellipses]
        legend.append(("s4", f"{SIGMAS:g} sigma{beside}, to scale"))
    elif ellipses:
        captions.append(f"{SIGMAS:g} sigma{beside}: at most {metres(largest)} m, too small to be drawn.")
    chart = plane_chart(tracks, f"before and after {what}", tallest=PLAN_HEIGHT, by="own")
    title = f"Before and after {what}" if is_seen else f"After {what}"
    whole = Figure(title, chart, tuple(legend), " ".join(captions))
    return [whole, *_error_figures(evaluation, what), *loop_figures(record.loop_view)]


def largest_correction(record: RunRecord) -> float:
    """Largest displacement of a pose by the back end, m, with both trajectories in the world of the final one."""
    if record.odometry is None or len(record.odometry) != len(record.trajectory):
        return 0.0
    before = se3.apply(record.T_final_odometry, record.odometry.positions)
    moved = np.linalg.norm(record.trajectory.positions - before, axis=1)
    return float(moved[np.isfinite(moved)].max(initial=0.0))


def _extent(record: RunRecord) -> float:
    """Longer side of the trajectory's plan, m."""
    xy = record.trajectory.positions[:, :2]
    xy = xy[np.isfinite(xy).all(1)]
    return float(np.ptp(xy, axis=0).max()) if len(xy) else 0.0


def before_and_after(after: Evaluation, before: Evaluation, what: str = "the pose graph") -> str:
    """ATE before and after the pose graph, by the first alignment that both have."""
    name = _common_alignment(after, before)
    if name is None:
        return "ATE n/a"
    was, now = (error.translation for error in (before.ate[name], after.ate[name]))
    assert was is not None
    assert now is not None
    return f"ATE {name} {metres(was.rmse)} m before {what}, {metres(now.rmse)} m after"


def _common_alignment(after: Evaluation, before: Evaluation) -> str | None:
    """Name of the first alignment that both evaluations have; None without one."""
    for name, error in after.ate.items():
        other = before.ate.get(name)
        if error.translation is not None and other is not None and other.translation is not None:
            return name
    return None


def _error_figures(evaluation: Evaluation | None, what: str) -> list[Figure]:
    """Position error over path length before and after the pose graph, or after `what`; empty without ground truth."""
    if evaluation is None or evaluation.odometry is None:
        return []
    before = evaluation.odometry
    name = _common_alignment(evaluation, before)
    if name is None:
        return []
    lines = [
        svg.Line(word, part.distance, np.linalg.norm(part.ate[name].errors, axis=1), style)
        for word, part, style in (("odometry", before, "s2"), (f"after {what}", evaluation, "s1"))
    ]
    title = f"Position error before and after {what}"
    caption = f"{before_and_after(evaluation, before, what)}; {ALIGNED.get(name, name)}."
    figure = line_figure(title, lines, DISTANCE, "position error, m", caption, by="truth")
    return [figure] if figure.svg else []


def _common(record: RunRecord) -> Floats:
    """(2, 2) covariance, m2, of the shift of the building map against the run, which is a part of every pose's covariance."""
    if record.osm is None or not np.isfinite(record.osm.shift_sigma).all():
        return np.zeros((2, 2))
    return np.diag(record.osm.shift_sigma**2)


def _ellipses(record: RunRecord) -> tuple[list[Floats], float]:
    """Outlines (33, 2), m, of the horizontal uncertainty of some poses, to scale, and the largest half axis, m.

    The common part of all covariances is not drawn: it shifts the run as a whole and does not bend it.
    """
    covariances, positions = record.trajectory.covariances, record.trajectory.positions
    if covariances is None or len(positions) < 2:
        return [], 0.0
    some = np.unique(np.linspace(0, len(positions) - 1, ELLIPSES).round().astype(int))
    circle = np.linspace(0, 2 * np.pi, 33)
    ring = np.column_stack([np.cos(circle), np.sin(circle)])
    values, vectors = np.linalg.eigh(covariances[some, :2, :2] - _common(record))
    axes = SIGMAS * np.sqrt(np.maximum(values, 0.0))
    largest = float(axes.max(initial=0.0))
    if not (np.isfinite(largest) and largest > 0):
        return [], 0.0
    return [positions[i, :2] + (ring * a) @ v.T for i, a, v in zip(some, axes, vectors, strict=True)], largest


def loop_figures(view: LoopView | None) -> list[Figure]:
    """Both figures of a loop; empty without a loop, or where the correction is below one pixel."""
    if view is None:
        return []
    size = float(np.clip(2 * view.correction + BESIDE, SMALLEST, LARGEST))
    if view.correction < size / PIXELS:
        return []
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
        tracks = [Track("older", crop.inside(place.older), "s2"), Track("newer", crop.inside(place.newer), "s1")]
        backdrop = (data_uri(density_png(image, top)), crop.extent)
        by: By = "own" if word == "after" else ""
        chart = plane_chart(tracks, f"map at a loop, {word} the pose graph", backdrop=backdrop, by=by)
        figures.append(Figure(f"Map at a loop, {word} the pose graph", chart, legend, caption))
    return figures


# What became of a scan, for people, in the order of the codes that the page's script gets; the style of its line.
STATES = {
    "held": ("held by the map", "s2"),
    "doubted": ("held, the map has changed there", "s4"),
    "changed": ("carried by odometry: the map has changed", "carried"),
    "beyond": ("carried by odometry: beyond the map", "carried"),
    "unread": ("carried by odometry: without points", "carried"),
}
WORDS = {"gone": "gone", "appeared": "not in the map"}


def state_of(fix: MapFix) -> str:
    """State of a scan against the map: one of the keys of `STATES`."""
    return "doubted" if fix.is_binding and fix.is_doubtful else fix.status


def state_codes(record: RunRecord) -> NDArray[np.uint8]:
    """(N,) index in `STATES` of each scan's state against the map."""
    names = list(STATES)
    return np.array([names.index(state_of(fix)) for fix in record.map_fixes], np.uint8)


def localization_tracks(record: RunRecord) -> tuple[list[Track], list[tuple[str, str]]]:
    """Parts of the trajectory by state of localisation, with their legend; each reaches to the next scan."""
    xy, codes = record.trajectory.positions[:, :2], state_codes(record)
    styles = np.array([style for _, style in STATES.values()])[codes]
    words = {"s2": "held by the map", "s4": "held, the map has changed there", "carried": "carried by odometry"}
    tracks, legend = [], []
    for style, word in words.items():
        own = styles == style
        if own.any():
            reach = own | np.append(False, own[:-1])
            tracks.append(Track(word, np.where(reach[:, None], xy, np.nan), style))
            legend.append((style, f"{word}, {count_of(int(own.sum()), 'scan')}"))
    return tracks, legend


def changed_dots(sample: ArrayCloud | None) -> list[tuple[str, NDArray[Any]]]:
    """Positions (K, 2), m, of objects gone and not in the map, by style, some of each; empty if unknown."""
    if sample is None or "change" not in sample.columns:
        return []
    dots = []
    for style, code in (("gone", -1), ("appeared", 1)):
        own = sample.points[sample.columns["change"] == code, :2]
        if len(own):
            dots.append((style, own[:: -(-len(own) // MOST_POINTS)]))
    return dots


def localization_figures(record: RunRecord) -> list[Figure]:
    """Agreement with the map and correction by it over the distance travelled; scans that odometry carries are marked."""
    fixes = record.map_fixes
    if not fixes:
        return []
    way, is_binding = record.trajectory.path_lengths, np.array([fix.is_binding for fix in fixes])
    carried = way[~is_binding]
    share = np.array([fix.inlier_share for fix in fixes])
    moved = np.array([fix.innovation[0] for fix in fixes])
    legend = (("failed", f"carried by odometry, {count_of(len(carried), 'scan')}"),) if len(carried) else ()

    def figure(title: str, label: str, values: NDArray[Any], caption: str) -> Figure:
        line = svg.Line("held by the map", way, np.where(is_binding, values, np.nan), "s1")
        chart: dict[str, Any] = {"spoken": title.lower(), "marks": carried, "by": "way"}
        return line_figure(title, [line], WAY, label, caption, more=legend, **chart)

    return [
        figure(
            "Agreement with the map", "share of points", share, "Points within the kernel, of those that find the map."
        ),
        figure("Correction by the map", "m", moved, "How far the map moved each scan from where odometry carried it."),
    ]
