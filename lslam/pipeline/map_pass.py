"""Second pass over the raw scans: the merged map from the final poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.config import Config
from lslam.geometry.interpolate import poses_at
from lslam.maps.merge import MapMerger, MergedMap
from lslam.maps.top_view import top_view
from lslam.pipeline.front_end import read_ahead, sweep_seconds
from lslam.preprocessing.deskew import KNOTS, deskew_points
from lslam.types.motion_prior import MotionPrior
from lslam.types.scan import Scan
from lslam.types.scan_result import ScanResult
from lslam.types.sequence import Sequence


@dataclass(frozen=True)
class BuiltMap:
    """The merged map and its view from above."""

    merged: MergedMap
    image: NDArray[np.float32]
    extent: tuple[float, float, float, float]


def build_map(
    sequence: Sequence, results: list[ScanResult], config: Config, on_step: Callable[[], None],
    should_stop: Callable[[], bool],
) -> BuiltMap | None:  # fmt: skip
    """Merge every scan that was registered; bridged scans would draw their error into the map and stay out.

    None when `should_stop` said so before the last scan.
    """
    merger = MapMerger(config.map.voxel, config.map.range_min, config.map.range_max)
    stamps = np.array([r.stamp_ns for r in results], np.int64)
    poses = np.stack([r.T_world_lidar for r in results])
    for loaded, result in zip(read_ahead(sequence, None, config.input.threads), results, strict=False):
        if should_stop():
            return None
        if loaded.scan is not None and result.status == "ok":
            scan = loaded.scan
            motion = motion_within(scan, stamps, poses)
            merger.add(deskew_points(scan.points, scan.times, motion), result.T_world_lidar, scan.intensity)
        on_step()
    merged = merger.result()
    image, extent = top_view(merged.points, pixel=max(0.2, config.map.voxel))
    return BuiltMap(merged, image, extent)


def motion_within(scan: Scan, stamps_ns: NDArray[np.int64], poses: NDArray[np.float64]) -> MotionPrior:
    """How the sensor moved during a sweep, from the final poses (N, 4, 4) of all scans; one pose when they cannot say."""
    span = sweep_seconds(scan)
    if span <= 0 or len(stamps_ns) < 2:
        return MotionPrior(np.zeros(1), np.eye(4)[None])
    times = np.linspace(0.0, span, KNOTS)
    return MotionPrior(times, poses_at(stamps_ns, poses, scan.stamp_ns + np.round(1e9 * times).astype(np.int64)))
