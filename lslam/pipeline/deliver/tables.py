"""Tables of what is delivered: the trajectory as text, and layers of points and loops for the GeoPackage."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np

from lslam.core import __version__
from lslam.core.errors import input_errors
from lslam.core.geometry import so3
from lslam.core.types.arrays import Floats
from lslam.core.untrusted import MISFIT
from lslam.io.formats.atomic import write_text
from lslam.io.formats.text_tables import utc_of
from lslam.pipeline.convert.to_gpkg import GeoLayer, building_layers, pose_layers
from lslam.pipeline.deliver.survey import Survey
from lslam.pipeline.rebuild import EarlierRun, results_of

_GREEN, _RED, _BLUE = "#2e7d32", "#c62828", "#1565c0"
_DRAWN = {"control_points": {"used": _BLUE, "kept out": _RED}, "loops": {"accepted": _GREEN, "rejected": _RED}}


def trajectory_text(survey: Survey, name: str) -> str:
    """Table of the poses of a drive, with what its columns mean in lines that begin with #."""
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
        "status: ok was registered, bridged follows the motion prior, skipped has no points",
        "frame: lidar",
    ]
    sigmas = tuple(f"sigma_{axis}_m" for axis in axes) + tuple(f"sigma_about_{axis}_deg" for axis in about)
    names = ["scan", "stamp_ns", *(["utc"] if utc else []), *(f"{axis}_m" for axis in axes)]
    names += ["roll_deg", "pitch_deg", "yaw_deg", "qx", "qy", "qz", "qw", *sigmas, "status"]
    lines = [*(f"# {line}" for line in comments), ",".join(names)]
    angles, turns = np.degrees(so3.euler_rpy(poses[:, :3, :3])), so3.to_quaternion(poses[:, :3, :3])
    spread = np.full((len(poses), 6), np.nan) if covariances is None else _sigmas(covariances)
    for k, result in enumerate(results_of(run)):
        values = [f"{v:.4f}" for v in (*poses[k, :3, 3], *angles[k])] + [f"{v:.9f}" for v in turns[k]]
        values += [f"{v:.4f}" if np.isfinite(v) else "" for v in spread[k]]
        when = [f"{utc[k]:%Y-%m-%dT%H:%M:%S.%f}Z"] if utc else []
        lines.append(",".join([str(result.index), str(result.stamp_ns), *when, *values, run.statuses[k]]))
    return "\n".join(lines) + "\n"


def _sigmas(covariances: Floats) -> Floats:
    """(N, 6) roots of the variances, m and deg."""
    sigmas = np.sqrt(np.maximum(np.diagonal(covariances, axis1=1, axis2=2), 0.0))
    return np.asarray(sigmas * [1.0, 1.0, 1.0, *np.degrees(np.ones(3))])


def _pose_time(run: EarlierRun) -> str:
    return str(run.manifest.get("frames", {}).get("pose_time", "scan_start")).removeprefix("scan_")


def precision_note(survey: Survey) -> str:
    """What standard deviations of the poses are relative to, in words."""
    georeference = next(iter(survey.drives.values())).georeference
    is_absolute = georeference is not None and georeference.is_in_graph
    return "internal precision " + ("in the delivered coordinates" if is_absolute else "relative to the first pose")


def write_trajectories(folder: Path, survey: Survey) -> list[str]:
    """Write trajectory.csv, or trajectory_<session>.csv of each session of a merge. Returns their names. Raises OutputError."""
    is_one = len(survey.drives) == 1
    names = {drive: "trajectory.csv" if is_one else f"trajectory_{drive}.csv" for drive in survey.drives}
    for drive, name in names.items():
        write_text(folder / name, trajectory_text(survey, drive))
    return list(names.values())


def layers_of(survey: Survey) -> list[GeoLayer]:
    """Layers of the GeoPackage: poses, surveyed points, loops and buildings, those that there are."""
    from lslam.maps.georeference import Projection

    layers = pose_layers(survey.drives, survey.frame)
    if survey.points:
        layers.append(_points_layer(survey))
    layers += _loops_layer(survey)
    if isinstance(survey.frame, Projection):
        layers += building_layers(survey.folder, survey.frame)
    return layers


def _points_layer(survey: Survey) -> GeoLayer:
    places, off = (np.concatenate([getattr(p, name) for p in survey.points]) for name in ("places", "residuals"))
    columns = {
        "point": [name for p in survey.points for name in p.names],
        "stamp_ns": [stamp for p in survey.points for stamp in p.stamps_ns],
        "status": [p.kind for p in survey.points for _ in p.names],
        **{f"off_{axis}_m": off[:, k].tolist() for k, axis in enumerate(("easting", "northing", "height"))},
        "off_horizontally_m": np.hypot(off[:, 0], off[:, 1]).tolist(),
    }
    about = f"surveyed minus solved; used points held the run; {survey.frame.frame}"
    return GeoLayer("control_points", "points", list(places), columns, about, _DRAWN["control_points"])


def _loops_layer(survey: Survey) -> list[GeoLayer]:
    """A line for each loop candidate, from scan to scan; none where the run looked for none."""
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
    return [GeoLayer("loops", "lines", lines, columns, survey.frame.frame, _DRAWN["loops"])] if rows else []
