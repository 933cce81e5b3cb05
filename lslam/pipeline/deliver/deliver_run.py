"""Delivery of a run: a folder with its map, trajectories, layers, plans, a sheet to sign and a README, whole or not at all."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core import __version__
from lslam.core.arrays import Floats
from lslam.core.errors import InputError, OutputExistsError, UsageError, input_errors
from lslam.core.extras import install_command
from lslam.core.geometry import so3
from lslam.core.printable import count_of
from lslam.core.untrusted import MISFIT
from lslam.io.formats.atomic import atomic_write, write_text
from lslam.io.formats.image_files import write_geotiff
from lslam.io.formats.las_files import write_las
from lslam.io.formats.point_files import open_map
from lslam.io.formats.state_files import read_npz
from lslam.io.formats.text_tables import is_unix_time, utc_of
from lslam.maps.floor_plan import UNKNOWN, Extent, floor_plan, pixel_size, top_view
from lslam.maps.georeference import Projection
from lslam.maps.occupancy import OccupancyGrid
from lslam.pipeline.convert import check_beside, stage
from lslam.pipeline.convert.to_gpkg import GeoLayer, building_layers, pose_layers, write_gpkg
from lslam.pipeline.deliver.survey import (
    TITLE,
    Survey,
    accuracy,
    coordinates,
    limits,
    making,
    precision_note,
    readme,
)
from lslam.pipeline.rebuild import EarlierRun, results_of
from lslam.pipeline.stored_map import map_of
from lslam.reports.plans import SurveySheet, survey_pdf
from lslam.reports.png import density_grey

MAP, PLAN, FLOOR = "map.laz", "plan.tif", "floor_plan.tif"
GPKG, SHEET, README = "survey.gpkg", "sheet.pdf", "README.txt"
STEPS = 6
_EMPTY = 255  # grey of a pixel without points
_PIXEL_M, _LONGEST = 0.1, 2500
_PAPER_M = 20.0  # around a trajectory without a map
_GREEN, _RED, _BLUE = "#2e7d32", "#c62828", "#1565c0"
_STATUS_COLOURS = {"control_points": {"used": _BLUE, "kept out": _RED}, "loops": {"accepted": _GREEN, "rejected": _RED}}


@dataclass(frozen=True)
class Delivery:
    """Result of `deliver`: descriptions of the files by name, sentences about the accuracy, and what is missing and why."""

    folder: Path
    files: Mapping[str, str]
    accuracy: list[str]
    notes: list[str]


def check_delivery(folder: Path, out: Path, overwrite: bool) -> None:
    """Raise UsageError or OutputExistsError for what cannot be delivered to `out`, before any work is done.

    Only an earlier delivery may be replaced, and only with `overwrite`.
    """
    if find_spec("fudgeo") is None:
        raise UsageError(f"a delivery has a GeoPackage, which fudgeo writes: install it with: {install_command('geo')}")
    check_beside(out, folder, "the run")
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return
    first = (out / README).read_text(errors="replace")[: len(TITLE)] if (out / README).is_file() else ""
    if first != TITLE:
        raise OutputExistsError(
            f"{out} exists and is no delivery of lslam, --overwrite replaces those only: name another --out"
        )
    if not overwrite:
        raise OutputExistsError(f"{out} exists; name another folder with --out or replace it with --overwrite")


def deliver(
    survey: Survey, out: Path, *, overwrite: bool = False, command: str = "", on_step: Callable[[], None] = lambda: None
) -> Delivery:
    """Write the delivery of `survey` to the folder `out`.

    A map or floor plan that the run lacks is left out, with a note in README.txt. `on_step` is called `STEPS` times.
    Raises as `check_delivery`, InputError for a damaged map, OutputError when something cannot be written.
    """
    check_delivery(survey.folder, out, overwrite)
    with stage(out) as folder:
        folder.mkdir()
        files, notes = _write_map(folder, survey)
        on_step()
        image, extent = _write_plan(folder, survey, files)
        on_step()
        _write_floor_plan(folder, survey, files)
        for name in write_trajectories(folder, survey):
            files[name] = "pose of the LiDAR at each scan, standard deviations, status; its head says what columns mean"
        on_step()
        layers = layers_of(survey)
        write_gpkg(folder / GPKG, layers, survey.frame)
        files[GPKG] = f"layers for GIS, with styles for QGIS: {', '.join(layer.name for layer in layers)}"
        on_step()
        with atomic_write(folder / SHEET) as stream:
            stream.write(survey_pdf(_sheet(survey, image, extent, notes)))
        files[SHEET] = "one page to sign: map, accuracy, coordinates, limits"
        on_step()
        write_text(folder / README, readme(survey, files, notes, command))
        on_step()
    return Delivery(out, {**files, README: "this survey in words"}, accuracy(survey), notes)


def _write_map(folder: Path, survey: Survey) -> tuple[dict[str, str], list[str]]:
    """Write map.laz in the delivered coordinates. Returns its description by file name, and notes on what is missing."""
    try:
        stored = map_of(survey.folder)
    except InputError:
        way = f"the run was made without one; `lslam map {survey.folder}` builds it"
        return {}, [f"There is no map, and no plan from above: {way}, and then deliver again."]
    attributes = dict(stored.note.get("attributes") or {})
    cloud = stored.cloud(attributes, survey.frame)
    write_las(folder / MAP, cloud, survey.frame.wkt)
    columns = ["intensity", *(name for name in attributes if name != "time")]
    columns += ["colour"] if "red" in cloud.column_types else []
    voxel = f"one in each voxel of {stored.voxel:g} m" if stored.voxel else "every point of every scan"
    about = f"{count_of(len(cloud), 'point')}, {voxel}; with {', '.join(columns)}"
    if "time" in attributes:
        is_unix = is_unix_time(int(next(iter(survey.drives.values())).trajectory.stamps_ns[0]))
        about += ", GPS time (adjusted standard)" if is_unix else ", times by the recording's clock (as week time)"
    if survey.frame.attribution:
        about += f"; {survey.frame.attribution}"
    if "time" in attributes or survey.manifest.get("kind") == "merge":
        return {MAP: about}, []
    way = f"lslam map {survey.folder} --attributes {','.join(['time', *attributes])} --overwrite"
    return {MAP: about}, [f"The points of the map have no times: `{way}` gives them, and then deliver again."]


def _write_plan(folder: Path, survey: Survey, files: dict[str, str]) -> tuple[NDArray[np.uint8] | None, Extent]:
    """Write plan.tif, the delivered map from above. Returns image and extent; without a map None and that of the trajectory."""
    if MAP not in files:
        places = np.concatenate([survey.frame.apply(run.trajectory.positions)[:, :2] for run in survey.drives.values()])
        (x, y), (east, north) = places.min(axis=0) - _PAPER_M, places.max(axis=0) + _PAPER_M
        return None, (float(x), float(east), float(y), float(north))
    view = top_view(open_map(folder / MAP, ()), pixel_size(map_of(survey.folder).voxel, _PIXEL_M), _LONGEST)
    image, (west, east, _, north) = density_grey(view.image), view.extent
    size = (east - west) / image.shape[1]
    write_geotiff(folder / PLAN, image, np.array([[size, 0, west], [0, -size, north]]), survey.frame.epsg, _EMPTY)
    files[PLAN] = f"the map from above, GeoTIFF with pixels of {size:.3g} m: the darker, the more points"
    return image, view.extent


def _write_floor_plan(folder: Path, survey: Survey, files: dict[str, str]) -> None:
    """Write floor_plan.tif of the occupancy map, rotated to the run's axes, if there is one; InputError if damaged."""
    path = survey.folder / "occupancy.npz"
    if not path.is_file():
        return
    arrays = read_npz(path)
    try:
        plan = floor_plan(OccupancyGrid(arrays["cells"], arrays["log_odds"], float(arrays["voxel"])))
    except MISFIT as error:
        raise InputError(f"{path} is no occupancy map: {error}; build it anew with lslam map --occupancy") from None
    height, width = plan.image.shape
    z = float(next(iter(survey.drives.values())).trajectory.positions[:, 2].mean())
    x, y = plan.x + width * plan.resolution, plan.y + height * plan.resolution
    corner, right, low = survey.frame.apply(np.array([[plan.x, y, z], [x, y, z], [plan.x, plan.y, z]]))[:, :2]
    transform = np.column_stack([(right - corner) / width, (low - corner) / height, corner])
    write_geotiff(folder / FLOOR, plan.image, transform, survey.frame.epsg, UNKNOWN)
    files[FLOOR] = f"floor plan, GeoTIFF, pixels of {plan.resolution:.3g} m: black occupied, white free, else unknown"


def _sheet(survey: Survey, image: NDArray[np.uint8] | None, extent: Extent, notes: list[str]) -> SurveySheet:
    """Content of the one-page PDF: plan, drives, points, accuracy, coordinates and limits."""
    is_local = survey.frame.epsg is None
    return SurveySheet(
        title=f"Survey of {survey.name}",
        subtitle=survey.frame.frame,
        warning="" if survey.status == "done" else f"the run is {survey.status}: see the limits",
        image=image,
        extent=extent,
        drives=[(survey.frame.apply(run.trajectory.positions)[:, :2], run.statuses) for run in survey.drives.values()],
        points={points.kind: points.places[:, :2] for points in survey.points},
        axes=("x, m", "y, m") if is_local else ("easting, m", "northing, m"),
        has_north=not is_local,
        left={"Accuracy": accuracy(survey), "Coordinates": coordinates(survey)},
        right={"Survey": making(survey), "Limits": [*limits(survey), *notes]},
        foot=f"lslam {__version__}; delivered on {datetime.now(UTC):%Y-%m-%d}; README.txt says how it was made",
    )


def trajectory_text(survey: Survey, name: str) -> str:
    """Table of the poses of a drive as CSV; lines that begin with # explain its columns."""
    run, frame = survey.drives[name], survey.frame
    poses, stamps, covariances = frame.carry(run.trajectory.poses), run.trajectory.stamps_ns, survey.covariances(run)
    is_local, utc = frame.epsg is None, utc_of(stamps)
    axes = ("x", "y", "z") if is_local else ("easting", "northing", "height")
    about = ("x", "y", "z") if is_local else ("east", "north", "up")
    clock = "Unix time" if utc else "the clock of the recording, which is no Unix time"
    comments = [
        f"lslam {__version__}: trajectory of the LiDAR, {name}, {len(poses)} scans, a row each",
        f"coordinates: {frame.frame if is_local else f'm, {frame.name} ({frame.plane}); {frame.heights}'}",
        f"stamp_ns: ns, {clock}, of the {_pose_time(run)} of each scan",
        "roll_deg, pitch_deg, yaw_deg: R = Rz(yaw) Ry(pitch) Rx(roll) takes the sensor's axes (forward, left, up) to "
        f"{', '.join(about)}"
        f"{'' if is_local else ' of the grid; yaw counts from east to north'}; qx to qw is the same rotation",
        f"sigma_*: one standard deviation by the covariances, {precision_note(survey)}; rotations, deg, about {', '.join(about)}",
        "status: ok was registered, bridged and skipped (no points) are interpolated or predicted",
        "frame: lidar",
    ]
    sigmas = tuple(f"sigma_{axis}_m" for axis in axes) + tuple(f"sigma_about_{axis}_deg" for axis in about)
    names = ["scan", "stamp_ns", *(["utc"] if utc else []), *(f"{axis}_m" for axis in axes)]
    names += ["roll_deg", "pitch_deg", "yaw_deg", "qx", "qy", "qz", "qw", *sigmas, "status"]
    lines = [*(f"# {line}" for line in comments), ",".join(names)]
    angles, turns = np.degrees(so3.euler_rpy(poses[:, :3, :3])), so3.to_quaternion(poses[:, :3, :3])
    sigma = np.full((len(poses), 6), np.nan) if covariances is None else _sigmas(covariances)
    for k, result in enumerate(results_of(run)):
        values = [f"{v:.4f}" for v in (*poses[k, :3, 3], *angles[k])] + [f"{v:.9f}" for v in turns[k]]
        values += [f"{v:.4f}" if np.isfinite(v) else "" for v in sigma[k]]
        when = [f"{utc[k]:%Y-%m-%dT%H:%M:%S.%f}Z"] if utc else []
        lines.append(",".join([str(result.index), str(result.stamp_ns), *when, *values, run.statuses[k]]))
    return "\n".join(lines) + "\n"


def _sigmas(covariances: Floats) -> Floats:
    """(N, 6) roots of the variances, m and deg."""
    sigmas = np.sqrt(np.maximum(np.diagonal(covariances, axis1=1, axis2=2), 0.0))
    return np.asarray(sigmas * [1.0, 1.0, 1.0, *np.degrees(np.ones(3))])


def _pose_time(run: EarlierRun) -> str:
    """Where in a sweep the poses of the run belong: start, middle or end."""
    return str(run.manifest.get("frames", {}).get("pose_time", "scan_start")).removeprefix("scan_")


def write_trajectories(folder: Path, survey: Survey) -> list[str]:
    """Write trajectory.csv, or trajectory_<session>.csv of each session of a merge. Returns their names. Raises OutputError."""
    is_one = len(survey.drives) == 1
    names = {drive: "trajectory.csv" if is_one else f"trajectory_{drive}.csv" for drive in survey.drives}
    for drive, name in names.items():
        write_text(folder / name, trajectory_text(survey, drive))
    return list(names.values())


def layers_of(survey: Survey) -> list[GeoLayer]:
    """Layers of the GeoPackage: poses, and surveyed points, loops and buildings where available."""
    layers = pose_layers(survey.drives, survey.frame)
    if survey.points:
        layers.append(_points_layer(survey))
    layers += _loops_layer(survey)
    if isinstance(survey.frame, Projection):
        layers += building_layers(survey.folder, survey.frame)
    return layers


def _points_layer(survey: Survey) -> GeoLayer:
    """Layer of all surveyed points with their residuals, m."""
    places, off = (np.concatenate([getattr(p, name) for p in survey.points]) for name in ("places", "residuals"))
    columns = {
        "point": [name for p in survey.points for name in p.names],
        "stamp_ns": [stamp for p in survey.points for stamp in p.stamps_ns],
        "status": [p.kind for p in survey.points for _ in p.names],
        **{f"off_{axis}_m": off[:, k].tolist() for k, axis in enumerate(("easting", "northing", "height"))},
        "off_horizontally_m": np.hypot(off[:, 0], off[:, 1]).tolist(),
    }
    about = f"surveyed minus solved; used points held the run; {survey.frame.frame}"
    return GeoLayer("control_points", "points", list(places), columns, about, _STATUS_COLOURS["control_points"])


def _loops_layer(survey: Survey) -> list[GeoLayer]:
    """Layer with a line for each loop candidate, from scan to scan; no layer where the run searched none."""
    path, drives = survey.folder / "loops.csv", list(survey.drives.values())
    if not path.is_file():
        return []
    firsts = [int(row["first_keyframe"]) for row in survey.manifest.get("sessions", ())] or [0]
    places = [
        {r.index: place for r, place in zip(results_of(run), survey.frame.apply(run.trajectory.positions), strict=True)}
        for run in drives
    ]
    columns: dict[str, Any] = {}
    with input_errors(path, *MISFIT, as_what="a table of loops"), path.open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
        sessions = {
            end: np.searchsorted(firsts, [int(row[f"keyframe_{end}"]) for row in rows], "right") - 1 for end in "ab"
        }
        for end in "ab":
            columns[f"scan_{end}"] = [int(row[f"scan_{end}"]) for row in rows]
        lines = [
            np.stack([places[sessions[end][k]][columns[f"scan_{end}"][k]] for end in "ab"]) for k in range(len(rows))
        ]
        columns["status"] = [row["verdict"] for row in rows]
        for name in ("distance_m", "rmse_m", "overlap"):
            columns[name] = [float(row[name]) if row[name] else None for row in rows]
        columns["reason"] = [row["reason"] for row in rows]
    return [GeoLayer("loops", "lines", lines, columns, survey.frame.frame, _STATUS_COLOURS["loops"])] if rows else []
