"""Second pass over the raw scans for the feature map: edges and planar points at the final poses, and some for the report."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.core.config import Config
from lslam.core.errors import InterruptedRunError, LslamError
from lslam.core.geometry import se3
from lslam.core.stopping import asking
from lslam.core.types.arrays import Floats
from lslam.core.types.run_record import FeatureView
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.sequence import Sequence
from lslam.core.types.state import State
from lslam.maps.merge import MapMerger
from lslam.odometry.base import FeatureSource
from lslam.odometry.frontend.register_scans import read_ahead
from lslam.pipeline.map_pass import MapCheckpoints, motion_within
from lslam.registration.preprocessing.features import Features

EDGE, PLANE = 1, 0
INTERRUPTED = "interrupted while the feature map was built: nothing of it is written"
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
    """Less sharp edges and less planar points in voxels; keep : folder for a map that is gone on with."""

    def __init__(self, voxel: float, reach: float, keep: Path | None = None) -> None:
        self._parts = {
            name: MapMerger(voxel, 0.0, reach, keep=None if keep is None else keep / name)
            for name in ("edges", "planes")
        }

    def add(self, features: Features, T_world_lidar: Floats) -> None:
        """Those of one more scan, and its pose (4, 4)."""
        self._parts["edges"].add(features.less_edges.points, T_world_lidar)
        self._parts["planes"].add(features.less_planes.points, T_world_lidar)

    def finish(self) -> FeatureCloud:
        """The map of all that was added."""
        both = [part.result().points for part in self._parts.values()]
        kinds = np.repeat(np.array([EDGE, PLANE], np.uint8), [len(points) for points in both])
        return FeatureCloud(np.concatenate(both), kinds)

    def state(self) -> State:
        """What `restore` needs to go on from here; the voxels go to `keep`."""
        return {name: part.state() for name, part in self._parts.items()}

    def restore(self, state: State) -> None:
        """Go on where `state` was taken, in an empty maker of the same kind; raises InputError when voxels are missing."""
        for name, part in self._parts.items():
            part.restore(state[name])


def build_feature_map(
    sequence: Sequence, odometry: FeatureSource, results: list[ScanResult], config: Config, on_step: Callable[[], None],
    should_stop: Callable[[], bool], checkpoints: MapCheckpoints | None = None,
) -> FeatureCloud:  # fmt: skip
    """Less sharp edges and less planar points of every scan that was registered, in voxels of `loam.feature_map_voxel`.

    Raises InterruptedRunError when `should_stop` says so; `checkpoints` know then where to go on.
    """
    stamps = np.array([r.stamp_ns for r in results], np.int64)
    poses = np.stack([r.T_world_lidar for r in results])

    def make() -> FeatureMaker:
        keep = None if checkpoints is None else checkpoints.folder
        return FeatureMaker(config.loam.feature_map_voxel, config.preprocess.range_max, keep)

    maker, first = (make(), 0) if checkpoints is None else checkpoints.begin(make, poses)
    for _ in range(first):
        on_step()
    ahead = read_ahead(sequence, odometry.prepare, config.input.workers, first=first)
    for k, (loaded, result) in enumerate(zip(ahead, results[first:], strict=False), first):
        is_last = should_stop()
        if checkpoints is not None:
            checkpoints.offer(k, maker, is_last)
        if is_last:
            raise InterruptedRunError(INTERRUPTED)
        if loaded.scan is not None and result.status == "ok":
            motion = motion_within(loaded.scan, stamps, poses)
            maker.add(odometry.features_of(loaded.prepared, motion), result.T_world_lidar)
        on_step()
    with asking(should_stop, INTERRUPTED):
        return maker.finish()


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
