"""A run as a bag for rviz and Foxglove: deskewed scans, poses, path, transforms and the map."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.errors import InputError, UsageError
from lslam.core.kernels.voxel import first_points
from lslam.core.types.sequence import Sequence
from lslam.maps.clean import PosedScan
from lslam.odometry.frontend.register_scans import read_ahead
from lslam.pipeline.convert import check_beside, check_output, stage
from lslam.pipeline.convert.bag_writer import MAP_TOPIC, PATH_TOPIC, BagWriter
from lslam.pipeline.map_pass import scan_poser
from lslam.pipeline.rebuild import EarlierRun, covariances_of, results_of
from lslam.pipeline.stored_map import map_of

log = logging.getLogger("lslam")

WORLD, BODY = "map", "lidar"  # as ROS calls them (REP 105)
POINTS_TOPIC, POSE_TOPIC = "/points", "/odometry"
# What viewers take in one message; of more, every k-th is written.
MOST_MAP_POINTS, MOST_PATH_POSES = 2_000_000, 1000
PATHS = 20


@dataclass(frozen=True)
class RunBag:
    """Result of `convert_run`: numbers of poses, clouds and map points."""

    poses: int
    clouds: int
    map_points: int


def convert_run(
    run: EarlierRun,
    scans: Sequence | None,
    kind: str,
    out: Path,
    *,
    voxel: float = 0.0,
    is_zstd: bool = False,
    overwrite: bool = False,
    on_scan: Callable[[], None] = lambda: None,
) -> RunBag:
    """Write a run to `out`, whole or not at all; one scan is in memory at a time.

    Every scan has its pose as Odometry, with the run's covariance, and as the transform map -> lidar; those that were registered
    have their points, deskewed along the run's poses to the scan's stamp. The path so far comes `PATHS` times, the map first.

    scans : the raw scans of the run, as `open_scans` gives them; None leaves the clouds out
    kind : `bag` (ROS 1), `mcap` or `sqlite` (ROS 2), as `convert_sequence` has them
    voxel : edge, m, of the voxels that keep one point of a scan each; 0 keeps all
    Raises OutputExistsError, OutputError: as named. UsageError: `out` does not suit `kind`, or `voxel` is no length. InputError:
    covariances or the map are damaged.
    """
    check_output(kind, out, is_zstd, overwrite)
    check_beside(out, run.folder, "the run")
    if not (np.isfinite(voxel) and voxel >= 0):
        raise UsageError(f"--voxel {voxel:g}: an edge in m, 0 for all points")
    if scans is not None:
        check_beside(out, scans.path, "the sequence")
    stamps, poses = run.trajectory.stamps_ns, run.trajectory.poses
    if not len(stamps):
        raise InputError(f"{run.folder / 'trajectory.tum'} has no pose")
    covariances = covariances_of(run)
    due, clouds = _path_ends(len(stamps)), 0
    with stage(out) as path, BagWriter(path, kind, is_zstd) as writer:
        map_points = _write_map(writer, run, int(stamps[0]))
        for k, scan in enumerate(_scans_by_pose(run, scans)):
            _write_pose(
                writer, int(stamps[k]), poses[k], None if covariances is None else np.nan_to_num(covariances[k])
            )
            if scan is not None:
                _write_points(writer, int(stamps[k]), scan, voxel)
                clouds += 1
            if k in due:
                some = _indices(k + 1, MOST_PATH_POSES)
                writer.write(PATH_TOPIC, int(stamps[k]), writer.messages.path(stamps[some], poses[some], WORLD))
            on_scan()
    return RunBag(len(stamps), clouds, map_points)


def _write_pose(writer: BagWriter, stamp: int, T: Floats, covariance: Floats | None) -> None:
    """Write the pose of a scan as transform and as Odometry."""
    writer.write("/tf", stamp, writer.messages.transforms(stamp, {(WORLD, BODY): T}))
    writer.write(POSE_TOPIC, stamp, writer.messages.odometry(stamp, T, WORLD, BODY, covariance))


def _write_points(writer: BagWriter, stamp: int, scan: PosedScan, voxel: float) -> None:
    """Write the points of a scan, of each voxel of edge `voxel`, m, the first; 0: all."""
    points, intensity = scan.points, scan.intensity
    if voxel:
        some = first_points(np.ascontiguousarray(points, np.float32), voxel)
        points, intensity = points[some], None if intensity is None else intensity[some]
    writer.write(POINTS_TOPIC, stamp, writer.messages.points(stamp, points, intensity, BODY))


def _scans_by_pose(run: EarlierRun, scans: Sequence | None) -> Iterator[PosedScan | None]:
    """One deskewed scan for each pose; None for a scan that was not registered or cannot be read."""
    if scans is None:
        yield from [None] * len(run.trajectory)
        return
    results = results_of(run)
    ahead = read_ahead(scans, scan_poser(results, run.config), run.config.input.workers)
    for loaded, _ in zip(ahead, results, strict=False):
        if loaded.error:
            log.warning("left out: %s", loaded.error)
        yield loaded.prepared


def _write_map(writer: BagWriter, run: EarlierRun, stamp: int) -> int:
    """Write the map in the world of the poses. Returns its number of points; 0, with a log message, without a map."""
    try:
        stored = map_of(run.folder)
    except InputError as error:
        log.warning("%s", error)
        return 0
    cloud = stored.read()
    if len(cloud) > MOST_MAP_POINTS:
        log.info("%s: %d of its %d points are written", stored.path, MOST_MAP_POINTS, len(cloud))
    some = _indices(len(cloud), MOST_MAP_POINTS)
    intensity = None if cloud.intensity is None else cloud.intensity[some]
    writer.write(MAP_TOPIC, stamp, writer.messages.points(stamp, cloud.points[some], intensity, WORLD))
    return len(some)


def _path_ends(count: int) -> set[int]:
    """Numbers of scans, of `count`, after which the path is written; the last is among them."""
    return set(np.unique(np.ceil(np.linspace(0, count, PATHS + 1)[1:]).astype(int) - 1).tolist())


def _indices(count: int, most: int) -> NDArray[np.intp]:
    """At most `most` indices spread evenly over `count`, including the first and the last."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(count, most)).round().astype(np.intp))
