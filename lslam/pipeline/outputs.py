"""Output files of a run: trajectories, tables of loops, building matches, times and IMU states, map, evaluation, report."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lslam.core import __version__
from lslam.core.arrays import Floats
from lslam.core.config import Config, to_toml
from lslam.core.config.outputs import MapConfig
from lslam.core.geometry import se3
from lslam.core.types.building import BuildingMatch, KeyframeMatch, OsmMatches
from lslam.core.types.constraint import LoopCandidate
from lslam.core.types.imu import IMU_STATES
from lslam.core.types.run_record import RunRecord
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.sequence import Calibration
from lslam.core.types.trajectory import Trajectory
from lslam.evaluation.evaluate import Evaluation
from lslam.evaluation.timing import AFTER, IMU_SAVING
from lslam.io.formats.atomic import write_text
from lslam.io.formats.point_files import write_ply
from lslam.io.formats.trajectory_lines import write_kitti, write_tum
from lslam.pipeline import map_files
from lslam.pipeline.further_passes import FeatureCloud
from lslam.pipeline.map_files import LOCAL, BuiltMap
from lslam.pipeline.run_folder import RunFolder
from lslam.reports.evaluations import run_document
from lslam.reports.facts import stage_matrix

LOOP_COLUMNS = (
    "keyframe_a,keyframe_b,scan_a,scan_b,distance_m,descriptor_distance,verdict,stage,"
    "rmse_m,overlap,sigma_m,sigma_deg,reason"
)
# x, y, yaw: of the keyframe in the map frame, or of the displacement of the building about its middle.
MATCH_COLUMNS = "keyframe,scan,building,verdict,kind,rank,walls,fitness,coverage,rms_m,x_m,y_m,yaw_deg,reason"


def write_loops(path: Path, candidates: Sequence[LoopCandidate], scans: Sequence[int]) -> None:
    """Write loops.csv, one row per candidate in their order; sigmas are the largest standard deviations, empty when unknown.

    scans : of the keyframes, as the recording numbers them. Raises OutputError when the file cannot be written.
    """
    rows = [
        (
            c.a,
            c.b,
            scans[c.a],
            scans[c.b],
            f"{c.distance:.3f}",
            _number(c.descriptor_distance),
            c.verdict,
            c.stage,
            _number(c.rmse),
            _number(c.overlap),
            *map(_number, _sigmas(c)),
            c.reason,
        )
        for c in candidates
    ]
    _write(path, LOOP_COLUMNS, rows)


def _sigmas(candidate: LoopCandidate) -> tuple[float, float]:
    """Largest standard deviations of position, m, and rotation, deg."""
    if candidate.constraint is None:
        return float("nan"), float("nan")
    C = candidate.constraint.covariance
    largest = [float(np.sqrt(max(np.linalg.eigvalsh(block)[-1], 0.0))) for block in (C[:3, :3], C[3:, 3:])]
    return largest[0], float(np.rad2deg(largest[1]))


def _number(value: float) -> str:
    """A number with 4 decimals; empty if it is not finite."""
    return f"{value:.4f}" if np.isfinite(value) else ""


def write_osm_matches(path: Path, matches: OsmMatches, scans: Sequence[int], poses: Floats) -> None:
    """One row per keyframe, `building` empty, then one per building seen from one, with its OpenStreetMap number.

    scans : of the keyframes, as the recording numbers them; poses : (K, 3) their final planar poses in the map frame.
    Raises OutputError when it cannot be written.
    """
    rows = [_match_row(match, scans, "", match.pose) for match in matches.keyframes]
    for one in matches.local:
        building = matches.buildings[one.building]
        rows.append(_match_row(one, scans, building.osm_id, one.displacement(poses[one.keyframe], building.middle)))
    _write(path, MATCH_COLUMNS, rows)


def _match_row(
    match: KeyframeMatch | BuildingMatch, scans: Sequence[int], building: str, pose: Floats
) -> tuple[Any, ...]:
    """Row of osm_matches.csv for a match with its pose (3,), m and rad, written in m and deg; NaN for rank 0."""
    place = (pose[0], pose[1], np.degrees(pose[2])) if match.rank else (np.nan, np.nan, np.nan)
    return (
        match.keyframe,
        scans[match.keyframe],
        building,
        match.verdict,
        match.kind,
        match.rank,
        len(match.pairs),
        *map(_number, (match.fitness, match.coverage, match.rms, *place)),
        match.reason,
    )


def _write(path: Path, columns: str, rows: Iterable[Sequence[Any]]) -> None:
    """Write a CSV table; columns : their names, separated by commas. Raises OutputError."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([columns.split(","), *rows])
    write_text(path, text.getvalue())


def timing_text(
    indices: list[int],
    stamps_ns: list[int],
    names: list[str],
    seconds: Floats,
    back_end: Mapping[int, Mapping[str, float]] | None = None,
    saved_s: Mapping[int, float] | None = None,
) -> str:
    """Table of times of scans by number and stamp, with seconds (N, S) of the stages `names`.

    back_end : seconds by row and name, of stages that do not count in the total of a scan
    saved_s : seconds by row that the IMU saved, a column when there are any; empty where unknown
    """
    back_end = back_end or {}
    later = list(dict.fromkeys(f"{AFTER}{name}" for row in back_end.values() for name in row))
    lines = [",".join(["index", "stamp_ns", *names, "total", *later, *([IMU_SAVING] if saved_s else [])])]
    for k, (index, stamp, row) in enumerate(zip(indices, stamps_ns, seconds, strict=True)):
        own = back_end.get(k, {})
        values = (*row, row.sum(), *(own.get(name.removeprefix(AFTER), 0.0) for name in later))
        cells = [str(index), str(stamp), *(f"{v:.6f}" for v in values)]
        if saved_s:
            cells.append(f"{saved_s[k]:.6f}" if k in saved_s else "")
        lines.append(",".join(cells))
    return "\n".join(lines) + "\n"


def imu_states_text(results: Iterable[ScanResult]) -> str:
    """Table of IMU states, each value with its standard deviation: a row per scan that has an `ImuState`.

    A state that is not estimated is empty. SI units, radians.
    """
    header = ["index", "stamp_ns", *(column for name in IMU_STATES for column in (name, f"{name}_sigma"))]
    rows = [",".join(header)]
    for r in results:
        if r.imu.state is not None:
            pairs = np.stack([r.imu.state.values, r.imu.state.sigmas], axis=1).ravel()
            rows.append(",".join([str(r.index), str(r.stamp_ns), *("" if np.isnan(v) else f"{v:.7g}" for v in pairs)]))
    return "\n".join(rows) + "\n"


# Bytes per point of the map files: 16 in PLY and PCD, 30 in LAS, with room for the header.
BYTES_PER_POINT = 32
# Of a point that the report shows: 12, with room for the map's picture.
BYTES_PER_SAMPLE_POINT = 15
# The 95 scans of sample_data make 310 kB without the map, half of it the report.
BYTES_PER_SCAN, BYTES_OF_REPORT = 4000, 500_000


def least_bytes(scans: int) -> int:
    """Least size of a run's output, bytes, without the map."""
    return BYTES_OF_REPORT + BYTES_PER_SCAN * scans


def config_text(config: Config) -> str:
    """Text of config.toml: `--config` with this file repeats the run."""
    return f"# lslam {__version__}, resolved configuration\n" + to_toml(config)


def write_trajectories(folder: RunFolder, record: RunRecord, calibration: Calibration) -> None:
    """Write trajectory.tum (LiDAR), trajectory_kitti.txt (camera 0 if Tr is known, else LiDAR) and covariances.npz."""
    trajectory = record.trajectory
    frames = np.array([r.frame for r in record.results])
    title = f"lslam {__version__}, {record.method}: T_world_lidar"
    about = f"world: {record.world}\npose_time: {record.pose_time}"
    elsewhere = "".join(
        f"\nin frame {n}, of their own, as in trajectory_frame_{n}.tum: {np.count_nonzero(frames == n)} poses, the first of "
        f"scan {record.results[int(np.argmax(frames == n))].index}"
        for n in range(1, int(frames.max(initial=0)) + 1)
    )
    write_tum(folder.path / "trajectory.tum", trajectory, comment=f"{title}\n{about}{elsewhere}")
    for n in range(1, int(frames.max(initial=0)) + 1):
        comment = f"{title} in frame {n}, of its own\npose_time: {record.pose_time}"
        write_tum(folder.path / f"trajectory_frame_{n}.tum", trajectory.select(frames == n), comment=comment)
    write_kitti(folder.path / "trajectory_kitti.txt", _in_camera(trajectory, calibration))
    if trajectory.covariances is not None:
        stream = io.BytesIO()
        registration = [
            np.full((6, 6), np.nan) if r.registration_covariance is None else r.registration_covariance
            for r in record.results
        ]
        np.savez_compressed(
            stream,
            stamps_ns=trajectory.stamps_ns,
            covariances=trajectory.covariances,
            registration=np.stack(registration),
        )
        folder.write_bytes("covariances.npz", stream.getvalue())


def write_scans(folder: RunFolder, record: RunRecord) -> None:
    """Write timing.csv, seconds per stage with those of the back end apart, and scans.csv, the result of each scan.

    With an IMU also imu_states.csv, its estimated state after each scan.

    `saved_s` of timing.csv is the time the IMU saved where a scan was registered from constant velocity too, empty elsewhere.
    """
    names, seconds = stage_matrix(record.results)
    indices, stamps = [r.index for r in record.results], [r.stamp_ns for r in record.results]
    saved_s = {k: r.imu.saved_s for k, r in enumerate(record.results) if r.imu.saved_s is not None}
    folder.write_text("timing.csv", timing_text(indices, stamps, names, seconds, record.back_end_seconds, saved_s))
    # Every number of scans.csv is the same in every run.
    columns = "index,stamp_ns,status,posed_by,standing,converged,iterations,source_points,inliers,overlap,rmse_m"
    columns += ",degenerate,prior_m,prior_deg,prior_norm,steady_norm,steady_iterations,lost,segment,frame"
    rows = [
        (
            r.index,
            r.stamp_ns,
            r.status,
            r.poser(record.method),
            int(r.is_stationary),
            int(r.converged),
            r.iterations,
            r.source_points,
            r.inliers,
            f"{r.overlap:.4f}",
            f"{r.rmse:.5f}",
            len(r.degenerate),
            f"{r.prior_error[0]:.5f}",
            f"{np.rad2deg(r.prior_error[1]):.5f}",
            f"{r.prior_norm:.5f}",
            "" if r.imu.steady_norm is None else f"{r.imu.steady_norm:.5f}",
            "" if r.imu.steady_iterations is None else r.imu.steady_iterations,
            int(r.may_be_elsewhere),
            r.segment,
            r.frame,
        )
        for r in record.results
    ]
    _write(folder.path / "scans.csv", columns, rows)
    if any(r.imu.state is not None for r in record.results):
        folder.write_text("imu_states.csv", imu_states_text(record.results))


def write_localization(folder: RunFolder, record: RunRecord) -> None:
    """Write localization.csv: the result of each scan on the prior map, with positions in the coordinates of the map's file.

    Also write trajectory.geojson if that map is georeferenced.
    """
    columns = (
        "index,stamp_ns,status,doubted,overlap,inlier_share,innovation_m,innovation_deg,sigma_m,sigma_deg,x,y,z,reason"
    )
    rows: list[Sequence[Any]] = []
    for result, fix in zip(record.results, record.map_fixes, strict=True):
        sigma_m, sigma_rad = (
            np.sqrt(np.linalg.eigvalsh(C)[-1]) for C in (fix.covariance[:3, :3], fix.covariance[3:, 3:])
        )
        at = fix.T_map_lidar[:3, 3] + record.map_origin
        values = (
            result.index,
            result.stamp_ns,
            fix.status,
            int(fix.is_doubtful),
            f"{fix.overlap:.4f}",
            f"{fix.inlier_share:.4f}",
            f"{fix.innovation[0]:.5f}",
            f"{np.rad2deg(fix.innovation[1]):.5f}",
            f"{sigma_m:.5f}",
            f"{np.rad2deg(sigma_rad):.5f}",
            *(f"{v:.4f}" for v in at),
            fix.reason.replace(",", ";"),
        )
        rows.append(values)
    _write(folder.path / "localization.csv", columns, rows)
    if record.georeference is not None:
        map_files.write_geojson(folder.path / "trajectory.geojson", record.trajectory, record.georeference, record.name)


def write_map(folder: RunFolder, built: BuiltMap, config: MapConfig, record: RunRecord) -> None:
    """Write map.<format> with map.json, in map coordinates if the run is georeferenced; raises OutputError for a full disk."""
    points = len(built.cloud) + (0 if built.occupancy is None else len(built.occupancy))
    columns = sum(kind.itemsize for kind in built.cloud.column_types.values())
    size = BYTES_PER_POINT * points + columns * len(built.cloud) + BYTES_PER_SAMPLE_POINT * len(built.sample)
    folder.require_space(size, "the map")
    path = folder.path / f"map.{config.format}"
    map_files.write_run_map(path, built, config, record.name, record.trajectory, record.world, record.georeference)


def write_feature_map(folder: RunFolder, features: FeatureCloud) -> None:
    """Write feature_map.ply, world frame of the trajectory; the scalar `class` is 1 on edges and 0 on planes."""
    folder.require_space(BYTES_PER_POINT * len(features), "the feature map")
    write_ply(
        folder.path / "feature_map.ply",
        features.points,
        scalars={"class": features.kinds},
        comment=f"lslam feature map, class 1 = edge, 0 = plane; {LOCAL}",
    )


def write_evaluation(folder: RunFolder, record: RunRecord, evaluation: Evaluation | None) -> None:
    """Write evaluation.json, when ground truth or a map is known."""
    document = run_document(record, evaluation)
    if document is not None:
        text = json.dumps(document, indent=2, allow_nan=False, ensure_ascii=False)
        folder.write_text("evaluation.json", text + "\n")


def write_html(folder: RunFolder, record: RunRecord, evaluation: Evaluation | None) -> None:
    """Write report.html."""
    from lslam.reports.html import write_report

    write_report(folder.path / "report.html", record, evaluation)


def _in_camera(trajectory: Trajectory, calibration: Calibration) -> Trajectory:
    """Poses of camera 0 in camera 0 at the start, or of the LiDAR if Tr is unknown; the first is the identity."""
    poses = se3.relative(trajectory.poses[:1], trajectory.poses)
    T = calibration.T_cam0_lidar
    if T is None:
        return replace(trajectory, poses=poses)
    return Trajectory(trajectory.stamps_ns, T @ poses @ se3.inverse(T), frame="cam0", source=trajectory.source)
