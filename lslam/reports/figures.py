"""Figures of a run for papers, drawn with matplotlib: one quantity each, as wide as a column or a page.

A rerun recording (.rrd) shows the run in three dimensions. This is the only file that imports rerun.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.errors import InputError, OutputError, UsageError, cause, nearest
from lslam.core.extras import importing, install_hint
from lslam.core.geometry import geodesy, se3, so3
from lslam.core.types.building import CorrectedMap
from lslam.core.types.cloud import ArrayCloud
from lslam.core.types.gnss import Georeference
from lslam.core.types.imu import ImuStream
from lslam.core.types.run_record import FeatureView
from lslam.core.types.trajectory import Trajectory
from lslam.reports.picture import COLOURS, label, shown_figure
from lslam.reports.plots import first_available

if TYPE_CHECKING:
    from lslam.evaluation.metric import Evaluation

# mm: a column and the text of two in IEEE's journals.
WIDTHS = {"column": 88.9, "page": 181.9}
INCH = 25.4
# Figures with the map beneath.
ON_THE_MAP = ("map", "buildings")
# Points of a map that are drawn at most: more are not seen at the resolution of a page.
MOST = 400_000


@dataclass(frozen=True)
class PlottedRun:
    """Data for the figures and the recording of a run, in the run's world; None for missing parts."""

    name: str
    trajectory: Trajectory
    odometry: Trajectory | None = None
    evaluation: Evaluation | None = None
    cloud: ArrayCloud | None = None
    imu: ImuStream | None = None
    features: FeatureView | None = None
    buildings: CorrectedMap | None = None
    georeference: Georeference | None = None


def require_figure(what: str) -> None:
    """Raise UsageError with the nearest name when there is no such figure."""
    if what not in FIGURES:
        raise UsageError(f"no figure {what!r}; {nearest(what, FIGURES)}")


def draw_figure(run: PlottedRun, what: str, width: float = WIDTHS["column"]) -> Any:
    """matplotlib figure, `width` mm wide. Raises UsageError as `require_figure`, InputError for missing data of the run."""
    require_figure(what)
    draw, height = FIGURES[what]
    figure = shown_figure()(figsize=(width / INCH, height * width / INCH), layout="constrained")
    draw(figure, run)
    return figure


def _map(figure: Any, run: PlottedRun) -> None:
    """Draw the map by height with the trajectory."""
    plot = figure.add_subplot()
    seen = _points(plot, run)
    figure.colorbar(seen, ax=plot, label="height, m", shrink=0.7)
    _line(plot, run.trajectory.positions, "black", run.name)
    _from_above(plot)


def _trajectory(figure: Any, run: PlottedRun) -> None:
    """Draw trajectory, odometry and ground truth from above and in 3D."""
    from matplotlib.ticker import MaxNLocator

    above, deep = figure.add_subplot(2, 1, 1), figure.add_subplot(2, 1, 2, projection="3d")
    # One over the other, the wider below: where they coincide, all are seen.
    lines = [("estimate", run.trajectory.positions, COLOURS[0], 0.7)]
    if run.odometry is not None:
        lines.insert(0, ("odometry", run.odometry.positions, COLOURS[1], 1.6))
    absolute = first_available(run.evaluation)
    if run.evaluation is not None and absolute is not None:
        truth = se3.apply(se3.inverse(absolute.T_gt_est), run.evaluation.gt_positions) / absolute.scale
        lines.insert(0, ("ground truth", truth, "0.7", 3.0))
    for name, positions, colour, width in lines:
        above.plot(*positions[:, :2].T, color=colour, lw=width, label=name)
        deep.plot(*positions.T, color=colour, lw=width)
    above.plot(*run.trajectory.positions[0, :2], "o", color="black", ms=3)
    _legend(figure, above)
    _from_above(above)
    size = np.ptp(run.trajectory.positions, axis=0)
    deep.set_box_aspect(np.maximum(size, 0.3 * size.max()) + 1e-9, zoom=0.95)
    deep.set(xlabel="x, m", ylabel="y, m", zlabel="z, m")
    for axis, ticks in ((deep.xaxis, 4), (deep.yaxis, 4), (deep.zaxis, 3)):
        axis.set_major_locator(MaxNLocator(ticks))
        axis.set_tick_params(pad=0)
        axis.labelpad = -4 if axis is deep.zaxis else 0  # outside the figure else


def _errors(figure: Any, run: PlottedRun) -> None:
    """Draw position errors in the LiDAR's axes, and rotation errors, over path length. Raises InputError without ground truth."""
    absolute = first_available(run.evaluation)
    if run.evaluation is None or absolute is None:
        raise InputError(f"{run.name} has no ground truth: say where it is with --gt")
    planar, turn = figure.subplots(2, 1, sharex=True)
    stamps = run.trajectory.stamps_ns
    nearest_pose = np.searchsorted(stamps, run.evaluation.stamps_ns).clip(0, len(stamps) - 1)
    R = absolute.T_gt_est[:3, :3] @ run.trajectory.poses[nearest_pose, :3, :3]
    own = np.einsum("nji,nj->ni", R, absolute.errors)
    distance = run.evaluation.distance
    for axis, (name, colour) in enumerate((("ahead", COLOURS[0]), ("left", COLOURS[1]), ("up", COLOURS[2]))):
        planar.plot(distance, own[:, axis], color=colour, lw=0.8, label=name)
    planar.plot(distance, np.linalg.norm(own[:, :2], axis=1), color="black", lw=0.8, label="planar")
    _legend(figure, planar)
    turn.plot(distance, absolute.rotation_errors_deg, color=COLOURS[0], lw=0.8)
    label(planar, "", f"error ({absolute.alignment}), m")
    label(turn, "distance, m", "rotation error, deg")
    labels = [planar.yaxis.label, turn.yaxis.label]
    figure.draw_without_rendering()
    above, below = (text.get_window_extent() for text in labels)
    if below.y1 > above.y0:  # on a narrow figure they are longer than their plots are high
        share = 0.9 * (above.y0 + above.y1 - below.y0 - below.y1) / (above.height + below.height)
        for text in labels:
            text.set_size(share * text.get_size())


def _imu(figure: Any, run: PlottedRun) -> None:
    """Draw the IMU's force and rates, and the trajectory's speed and yaw rate, over time; InputError without IMU."""
    if run.imu is None:
        raise InputError(f"{run.name} has no IMU: what it was run without is not plotted")
    force, rates, speed, yaw = figure.subplots(4, 1, sharex=True)
    begin = run.trajectory.stamps_ns[0]
    inside = (run.imu.stamps_ns >= begin) & (run.imu.stamps_ns <= run.trajectory.stamps_ns[-1])
    seconds = 1e-9 * (run.imu.stamps_ns[inside] - begin)
    for axis, (name, colour) in enumerate(zip("xyz", COLOURS, strict=False)):
        force.plot(seconds, run.imu.accel[inside, axis], color=colour, lw=0.4, label=name)
        rates.plot(seconds, np.rad2deg(run.imu.gyro[inside, axis]), color=colour, lw=0.4)
    step = np.maximum(1e-9 * np.diff(run.trajectory.stamps_ns), 1e-9)
    middle = 1e-9 * (run.trajectory.stamps_ns[:-1] - begin) + 0.5 * step
    moved = se3.relative(run.trajectory.poses[:-1], run.trajectory.poses[1:])
    speed.plot(middle, np.linalg.norm(moved[:, :3, 3], axis=1) / step, color="black", lw=0.6)
    yaw.plot(middle, np.rad2deg(so3.log(moved[:, :3, :3])[:, 2]) / step, color="black", lw=0.6)
    _legend(figure, force)
    for plot, unit in ((force, "force, m/s²"), (rates, "rate, deg/s"), (speed, "speed, m/s"), (yaw, "yaw rate, deg/s")):
        label(plot, "time, s" if plot is yaw else "", unit)


def _features(figure: Any, run: PlottedRun) -> None:
    """Draw features of one scan and of the map from above; raises InputError for a run without features."""
    view = run.features
    if view is None:
        raise InputError(f"{run.name} has no features: a method of the LOAM family has some")
    scan, whole = figure.subplots(1, 2)
    scan.plot(*view.around[:, :2].T, ",", color="#999999")
    scan.plot(*view.planes.T, ".", ms=1.5, color=COLOURS[0], label="planar")
    scan.plot(*view.edges.T, ".", ms=1.5, color=COLOURS[1], label="edge")
    scan.set_title(f"scan {view.scan}", fontsize="medium")
    planes, edges = _some(view.map_planes)[:, :2], _some(view.map_edges)[:, :2]
    whole.plot(*planes.T, ",", color=COLOURS[0])
    whole.plot(*edges.T, ",", color=COLOURS[1])
    whole.set_title("feature map", fontsize="medium")
    _legend(figure, scan, markerscale=4)
    for plot, shown in ((scan, np.concatenate([view.planes, view.edges])), (whole, np.concatenate([planes, edges]))):
        _from_above(plot)
        _about(plot, shown)


def _buildings(figure: Any, run: PlottedRun) -> None:
    """Draw mapped and corrected buildings with the trajectory, ENU; raises InputError for a run without buildings."""
    if run.buildings is None or run.georeference is None:
        raise InputError(f"{run.name} has no buildings: run it with --osm")
    plot = figure.add_subplot()
    T = geodesy.frame_change(run.georeference.origin, run.buildings.origin) @ run.georeference.T_enu_world
    _points(plot, run, T)
    for k, one in enumerate(run.buildings.buildings):
        for building, colour, name in (
            (one.building, COLOURS[4], "on the map"),
            (one.real_building, COLOURS[0], "corrected"),
        ):
            for footprint in building.footprints:
                ring = footprint.outer
                _line(plot, np.concatenate([ring, ring[:1]]), colour, name if k == 0 else "_")
    _line(plot, se3.apply(T, run.trajectory.positions), "black", "trajectory")
    _legend(figure, plot)
    _from_above(plot, "east, m", "north, m")


def _points(plot: Any, run: PlottedRun, T: Floats | None = None) -> Any:
    """Draw the map, moved by T (4, 4), below other data, coloured by height, dark is low; InputError without a map."""
    if run.cloud is None or not len(run.cloud):
        raise InputError(f"{run.name} has no map: build one with lslam map")
    points = _some(run.cloud.points)
    points = points if T is None else se3.apply(T, points)
    points = points[np.argsort(points[:, 2], kind="stable")]
    low, high = np.percentile(points[:, 2], [2, 98])
    return plot.scatter(
        points[:, 0],
        points[:, 1],
        c=points[:, 2],
        s=0.15,
        cmap="cividis",
        vmin=low,
        vmax=high,
        linewidths=0,
        rasterized=True,
    )


def _legend(figure: Any, plot: Any, markerscale: float = 1.0) -> None:
    """Draw the legend above all plots, where it hides no line."""
    lines, names = plot.get_legend_handles_labels()
    figure.legend(
        lines,
        names,
        loc="outside upper center",
        ncol=4,
        frameon=False,
        handlelength=1.2,
        columnspacing=1.0,
        markerscale=markerscale,
    )


def _about(plot: Any, points: Floats) -> None:
    """Set the limits to a square around the points (N, 2), without the outermost 2 % in each direction."""
    if not len(points):
        return
    low, high = np.percentile(points, [2, 98], axis=0)
    middle, half = (low + high) / 2, 0.6 * max(*(high - low), 1.0)
    plot.set_aspect("equal", adjustable="box")
    plot.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half))


def _some(points: NDArray[Any]) -> NDArray[Any]:
    """Every n-th point, so that a figure has no more than `MOST`."""
    return points[:: max(1, -(-len(points) // MOST))]


def _line(plot: Any, positions: NDArray[Any], colour: str, name: str) -> None:
    """Draw positions (N, 3) from above as a line."""
    plot.plot(positions[:, 0], positions[:, 1], color=colour, lw=0.8, label=name)


def _from_above(plot: Any, x: str = "x, m", y: str = "y, m") -> None:
    """Set equal scales and labels of a plot from above."""
    plot.set_aspect("equal", adjustable="datalim")
    label(plot, x, y)


# name -> (what draws it, its height as a share of its width)
FIGURES = {
    "map": (_map, 0.8),
    "trajectory": (_trajectory, 1.3),
    "errors": (_errors, 0.75),
    "features": (_features, 0.55),
    "imu": (_imu, 1.1),
    "buildings": (_buildings, 0.9),
}


MOST_POINTS = 2_000_000  # what a viewer turns smoothly
_ESTIMATE, _ODOMETRY = (31, 119, 180), (214, 39, 40)


def require_rerun() -> Any:
    """The rerun module. Raises InputError with instructions when it is missing."""
    with importing("rerun", install_hint("view")):
        import rerun
    return rerun


def write_recording(path: Path, run: PlottedRun) -> None:
    """Write trajectories, the map coloured by height, and the LiDAR's pose over time; atomically.

    Raises InputError when rerun is missing, OutputError when the file cannot be written.
    """
    rr = require_rerun()
    part = path.with_name(path.name + ".part")
    try:
        part.open("wb").close()
        stream = rr.RecordingStream("lslam", recording_id=run.name)
        stream.save(part)
        _log(rr, stream, run)
        stream.flush()
        stream.disconnect()
        os.replace(part, path)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {cause(error)}") from None
    finally:
        if path.parent.is_dir():
            part.unlink(missing_ok=True)


def _log(rr: Any, stream: Any, run: PlottedRun) -> None:
    """Write trajectories, map and poses of the run to a Rerun stream."""
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    ways = {"trajectory": (run.trajectory, _ESTIMATE), "odometry": (run.odometry, _ODOMETRY)}
    for name, (way, colour) in ways.items():
        if way is not None and len(way) > 1:
            stream.log(
                f"world/{name}", rr.LineStrips3D([way.positions.astype(np.float32)], colors=[colour]), static=True
            )
    if run.cloud is not None and len(run.cloud):
        step = -(-len(run.cloud) // MOST_POINTS)
        points = run.cloud.points[::step].astype(np.float32)
        stream.log("world/map", rr.Points3D(points, colors=by_height(points[:, 2]), radii=0.05), static=True)
    for stamp_ns, T in zip(run.trajectory.stamps_ns, run.trajectory.poses, strict=True):
        stream.set_time("stamp", timestamp=np.datetime64(int(stamp_ns), "ns"))
        stream.log("world/lidar", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
    stream.log("world/lidar", rr.TransformAxes3D(2.0), static=True)


def by_height(z: NDArray[Any]) -> NDArray[np.uint8]:
    """(N, 3) colours from blue at the 2nd to yellow at the 98th percentile of heights (N,), m."""
    low, high = np.percentile(z, [2, 98]) if len(z) else (0.0, 1.0)
    share = np.clip((z - low) / max(high - low, 1e-6), 0, 1)[:, None]
    return np.asarray(np.rint((1 - share) * (40, 60, 160) + share * (250, 220, 60)), np.uint8)
