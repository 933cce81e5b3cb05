"""Second pass over the raw scans: the merged map from the final poses."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.config import Config
from lslam.config.map import MapConfig
from lslam.geometry.interpolate import poses_at
from lslam.maps.clean import Cleaner, PosedScan
from lslam.maps.merge import MapMerger
from lslam.maps.mesh import denoise
from lslam.maps.occupancy import OccupancyGrid, OccupancyMapper
from lslam.maps.top_view import top_view
from lslam.pipeline.front_end import read_ahead
from lslam.pipeline.map_checkpoints import MapCheckpoints
from lslam.pipeline.tracker import sweep_seconds
from lslam.preprocessing.deskew import KNOTS, deskew_points
from lslam.types.cloud import Cloud, in_memory
from lslam.types.motion_prior import MotionPrior
from lslam.types.scan import Scan
from lslam.types.scan_result import ScanResult
from lslam.types.sequence import Sequence

log = logging.getLogger("lslam")


@dataclass(frozen=True)
class BuiltMap:
    """The merged map, its view from above, what was done to it, in words, and the occupancy when it was asked for."""

    merged: Cloud
    image: NDArray[np.float32]
    extent: tuple[float, float, float, float]
    done: tuple[str, ...] = ()
    occupancy: OccupancyGrid | None = None


def build_map(
    sequence: Sequence, results: list[ScanResult], config: Config, on_step: Callable[[], None],
    should_stop: Callable[[], bool], spool: Path | None = None, checkpoints: MapCheckpoints | None = None,
) -> BuiltMap | None:  # fmt: skip
    """Merge every scan that was registered; bridged scans would draw their error into the map and stay out.

    A map too large for memory is kept in a temporary folder in `spool` meanwhile. None when `should_stop` said so before
    the last scan. `checkpoints` are of the merger alone: where anything else is made of the scans (`map.clean`,
    `map.occupancy`), a map that was interrupted begins again.
    """
    section = config.map
    if section.clean or section.occupancy:
        checkpoints = None
    merger = MapMerger(
        section.voxel, section.range_min, section.range_max, crop=section.crop_box, spool=spool,
        keep=None if checkpoints is None else checkpoints.spool,
    )  # fmt: skip
    ego_box = section.ego_box or config.preprocess.ego_box
    stamps = np.array([r.stamp_ns for r in results], np.int64)
    poses = np.stack([r.T_world_lidar for r in results])
    cleaner = Cleaner() if section.clean else None

    occupancy = None
    if section.occupancy:
        occupancy = OccupancyMapper(section.occupancy_voxel, section.range_min, section.occupancy_range, spool=spool)

    def merge(scans: Iterable[PosedScan]) -> None:
        for posed in scans:
            merger.add(posed.points, posed.T_world_lidar, posed.intensity)
            if occupancy is not None:
                occupancy.add(posed.points, posed.T_world_lidar)

    first = 0 if checkpoints is None else checkpoints.begin(merger, poses)
    for _ in range(first):
        on_step()
    ahead = read_ahead(sequence, None, config.input.threads, first=first)
    for k, (loaded, result) in enumerate(zip(ahead, results[first:], strict=False), first):
        is_last = should_stop()
        if checkpoints is not None:
            checkpoints.offer(k, merger, is_last)
        if is_last:
            return None
        if loaded.scan is not None and result.status == "ok":
            scan = loaded.scan if ego_box is None else without_box(loaded.scan, ego_box)
            motion = motion_within(scan, stamps, poses)
            posed = PosedScan(deskew_points(scan.points, scan.times, motion), result.T_world_lidar, scan.intensity)
            merge([posed] if cleaner is None else cleaner.add(posed))
        on_step()
    if cleaner is not None:
        merge(cleaner.finish())
        log.info("map: %d of %d points moved and are left out", cleaner.removed, cleaner.seen)
    merged: Cloud = merger.result()
    done = _done(section, cleaner)
    if section.denoise:
        before, merged = len(merged), denoise(in_memory(merged))
        done = (*done, f"denoised: {before - len(merged)} of {before} points were far from their neighbours")
    image, extent = top_view(merged, pixel=max(0.2, config.map.voxel))
    return BuiltMap(merged, image, extent, done, None if occupancy is None else occupancy.result())


def _done(section: MapConfig, cleaner: Cleaner | None) -> tuple[str, ...]:
    done = [] if section.crop is None else [f"cropped to {list(section.crop)}"]
    if cleaner is not None:
        done.append(f"cleaned: {cleaner.removed} of {cleaner.seen} points moved")
    return tuple(done)


def without_box(scan: Scan, box: tuple[float, ...]) -> Scan:
    """The scan without what lies in a box of the LiDAR frame (x_min, x_max, y_min, y_max, z_min, z_max), m.

    To be done before deskewing: what rides along does not move against the sensor.
    """
    low, high = np.array(box[::2], np.float32), np.array(box[1::2], np.float32)
    inside = np.all((scan.points >= low) & (scan.points <= high), axis=1)
    return scan.select(np.flatnonzero(~inside))


def motion_within(scan: Scan, stamps_ns: NDArray[np.int64], poses: NDArray[np.float64]) -> MotionPrior:
    """How the sensor moved during a sweep, from the final poses (N, 4, 4) of all scans; one pose when they cannot say."""
    span = sweep_seconds(scan)
    if span <= 0 or len(stamps_ns) < 2:
        return MotionPrior(np.zeros(1), np.eye(4)[None])
    times = np.linspace(0.0, span, KNOTS)
    return MotionPrior(times, poses_at(stamps_ns, poses, scan.stamp_ns + np.round(1e9 * times).astype(np.int64)))
