"""What a feature method saw, for the report: some scans of a run are looked at again."""

from __future__ import annotations

import numpy as np

from lslam.errors import LslamError
from lslam.geometry import se3
from lslam.odometry.base import FeatureSource
from lslam.pipeline.map_pass import motion_within
from lslam.types.feature_view import FeatureView
from lslam.types.scan_result import ScanResult
from lslam.types.sequence import Sequence

# Scans looked at, evenly spaced over the run: enough for a course in time, a second of work.
MOST_SCANS = 30


def view_features(sequence: Sequence, odometry: FeatureSource, results: list[ScanResult]) -> FeatureView | None:
    """The features of some of the scans that were registered, at their final poses; None without any.

    A scan that can no longer be read, or has no features, is left out.
    """
    registered = [k for k, result in enumerate(results) if result.status == "ok"]
    chosen = [registered[i] for i in np.linspace(0, len(registered) - 1, min(MOST_SCANS, len(registered))).astype(int)]
    stamps = np.array([r.stamp_ns for r in results], np.int64)
    poses = np.stack([r.T_world_lidar for r in results]) if results else np.zeros((0, 4, 4))
    seen = []
    for k in chosen:
        try:
            scan = sequence.scan(k)
            found = odometry.features_of(odometry.prepare(scan), motion_within(scan, stamps, poses))
        except LslamError:
            continue
        seen.append((k, found))
    if not seen:
        return None
    middle, shown = seen[len(seen) // 2]
    others = (shown.less_edges, shown.less_planes, shown.neither)
    return FeatureView(
        scan=results[middle].index,
        edges=shown.edges.points[:, :2],
        planes=shown.planes.points[:, :2],
        around=np.concatenate([part.points for part in others]),
        map_edges=np.concatenate([se3.apply(poses[k], f.less_edges.points) for k, f in seen]),
        map_planes=np.concatenate([se3.apply(poses[k], f.less_planes.points) for k, f in seen]),
        scans=np.array([results[k].index for k, _ in seen], np.int64),
        edge_counts=np.array([len(f.edges) for _, f in seen], np.int64),
        plane_counts=np.array([len(f.planes) for _, f in seen], np.int64),
    )
