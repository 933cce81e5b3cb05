"""Second pass over the raw scans for the feature map: edges and planar points at the final poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.config import Config
from lslam.maps.merge import MapMerger
from lslam.odometry.base import FeatureSource
from lslam.pipeline.front_end import read_ahead
from lslam.pipeline.map_pass import motion_within
from lslam.types.scan_result import ScanResult
from lslam.types.sequence import Sequence

EDGE, PLANE = 1, 0


@dataclass(frozen=True)
class FeatureCloud:
    """One averaged point per voxel and kind, world frame.

    points : (M, 3) float64, m; kinds : (M,) uint8, EDGE 1 or PLANE 0
    """

    points: NDArray[np.float64]
    kinds: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.points)


def build_feature_map(
    sequence: Sequence, odometry: FeatureSource, results: list[ScanResult], config: Config, on_step: Callable[[], None],
    should_stop: Callable[[], bool],
) -> FeatureCloud | None:  # fmt: skip
    """Less sharp edges and less planar points of every scan that was registered, in voxels of `loam.feature_map_voxel`.

    None when `should_stop` said so before the last scan.
    """
    size, reach = config.loam.feature_map_voxel, config.preprocess.range_max
    edges, planes = MapMerger(size, 0.0, reach), MapMerger(size, 0.0, reach)
    stamps = np.array([r.stamp_ns for r in results], np.int64)
    poses = np.stack([r.T_world_lidar for r in results])
    for loaded, result in zip(read_ahead(sequence, odometry.prepare, config.input.threads), results, strict=False):
        if should_stop():
            return None
        if loaded.scan is not None and result.status == "ok":
            features = odometry.features_of(loaded.prepared, motion_within(loaded.scan, stamps, poses))
            edges.add(features.less_edges.points, result.T_world_lidar)
            planes.add(features.less_planes.points, result.T_world_lidar)
        on_step()
    both = edges.result(), planes.result()
    return FeatureCloud(
        np.concatenate([part.points for part in both]),
        np.repeat(np.array([EDGE, PLANE], np.uint8), [len(part) for part in both]),
    )
