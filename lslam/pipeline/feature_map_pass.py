"""Second pass over the raw scans: the feature map, and the features that a page shows, from the final poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.core.config import Config
from lslam.core.errors import LslamError
from lslam.core.geometry import se3
from lslam.core.stopping import asking
from lslam.core.types.arrays import Floats
from lslam.core.types.run_record import FeatureView
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.sequence import Sequence
from lslam.core.types.state import State
from lslam.maps.merge import MapMerger
from lslam.odometry.base import FeatureSource
from lslam.pipeline.map_pass import MapCheckpoints, course_of, motion_within, scans_again
from lslam.registration.preprocessing.features import Features

EDGE, PLANE = 1, 0
FEATURES_INTERRUPTED = "interrupted while the feature map was built: nothing of it is written"
# Scans looked at, evenly spaced over the run: enough for a course in time, a second of work.
MOST_SCANS = 30


@dataclass(frozen=True)
class FeatureCloud:
    """One averaged point per voxel and kind, world frame.

    points : (M, 3) float64, m; kinds : (M,) uint8, EDGE 1 or PLANE 0
    """

    points: Floats
    kinds: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.points)


class FeatureMaker:
    """Averages less sharp edges and less planar points in voxels; keep : folder for a map that can be resumed."""

    def __init__(self, voxel: float, reach: float, keep: Path | None = None) -> None:
        self._parts = {
            name: MapMerger(voxel, 0.0, reach, keep=None if keep is None else keep / name)
            for name in ("edges", "planes")
        }

    def add(self, features: Features, T_world_lidar: Floats) -> None:
        """Add the features of a scan at its pose (4, 4)."""
        self._parts["edges"].add(features.less_edges.points, T_world_lidar)
        self._parts["planes"].add(features.less_planes.points, T_world_lidar)

    def finish(self) -> FeatureCloud:
        """Map of all added features."""
        both = [part.result().points for part in self._parts.values()]
        kinds = np.repeat(np.array([EDGE, PLANE], np.uint8), [len(points) for points in both])
        return FeatureCloud(np.concatenate(both), kinds)

    def state(self) -> State:
        """State for `restore`; the voxels are written to `keep`."""
        return {name: part.state() for name, part in self._parts.items()}

    def restore(self, state: State) -> None:
        """Restore `state` in an empty maker of the same kind. Raises InputError when voxels are missing."""
        for name, part in self._parts.items():
            part.restore(state[name])


def build_feature_map(
    sequence: Sequence,
    odometry: FeatureSource,
    results: list[ScanResult],
    config: Config,
    on_step: Callable[[], None],
    should_stop: Callable[[], bool],
    checkpoints: MapCheckpoints | None = None,
) -> FeatureCloud:
    """Map of the less sharp edges and less planar points of all registered scans, in voxels of `loam.feature_map_voxel`.

    Raises InterruptedRunError when `should_stop` says so; `checkpoints` then allow to continue.
    """
    course = course_of(results)

    def make() -> FeatureMaker:
        keep = None if checkpoints is None else checkpoints.folder
        return FeatureMaker(config.loam.feature_map_voxel, config.preprocess.range_max, keep)

    maker, done = (
        (make(), 0) if checkpoints is None else checkpoints.begin(make, np.stack([r.T_world_lidar for r in results]))
    )
    numbers, offer = range(done, len(results)), None if checkpoints is None else partial(checkpoints.offer, maker)
    for k, loaded in scans_again(
        sequence, odometry.prepare, numbers, config, on_step, should_stop, FEATURES_INTERRUPTED, done, offer
    ):
        if loaded.scan is not None and results[k].status == "ok":
            motion = motion_within(loaded.scan, course)
            maker.add(odometry.features_of(loaded.prepared, motion), results[k].T_world_lidar)
    with asking(should_stop, FEATURES_INTERRUPTED):
        return maker.finish()


def view_features(sequence: Sequence, odometry: FeatureSource, results: list[ScanResult]) -> FeatureView | None:
    """Features of some of the registered scans, at their final poses; None without any.

    A scan that can no longer be read, or has no features, is left out.
    """
    registered = [k for k, result in enumerate(results) if result.status == "ok"]
    chosen = [registered[i] for i in np.linspace(0, len(registered) - 1, min(MOST_SCANS, len(registered))).astype(int)]
    if not registered:
        return None
    course, seen = course_of(results), []
    for k in chosen:
        try:
            scan = sequence.scan(k)
            found = odometry.features_of(odometry.prepare(scan), motion_within(scan, course))
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
        map_edges=np.concatenate([se3.apply(results[k].T_world_lidar, f.less_edges.points) for k, f in seen]),
        map_planes=np.concatenate([se3.apply(results[k].T_world_lidar, f.less_planes.points) for k, f in seen]),
        scans=np.array([results[k].index for k, _ in seen], np.int64),
        edge_counts=np.array([len(f.edges) for _, f in seen], np.int64),
        plane_counts=np.array([len(f.planes) for _, f in seen], np.int64),
    )
