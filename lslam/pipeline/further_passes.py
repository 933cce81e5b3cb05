"""Further passes over the raw scans, from the final poses: the colours of the map, and the feature map."""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.config import Config
from lslam.core.errors import InputError, LslamError
from lslam.core.geometry import portable, se3
from lslam.core.geometry.se3 import ContinuousMotion
from lslam.core.stopping import asking
from lslam.core.types.camera import Camera, cameras_of
from lslam.core.types.cloud import Cloud, thin_out
from lslam.core.types.run_record import FeatureView
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.sequence import Sequence
from lslam.core.types.state import State
from lslam.maps.colour import ColourCounts, ColouredCloud, MapColourer
from lslam.maps.merge import MapMerger
from lslam.odometry.base import FeatureSource
from lslam.pipeline.map_files import BuiltMap
from lslam.pipeline.map_pass import (
    COLUMNS,
    INTERRUPTED,
    SAMPLE,
    MapCheckpoints,
    begin_pass,
    build_map,
    course_of,
    motion_within,
    posed_scans,
    scans_again,
)
from lslam.pipeline.watch import SILENT, Watch
from lslam.registration.preprocessing.features import Features

log = logging.getLogger("lslam")
_MOST_IMAGES = 3  # that cannot be read, named one by one
EDGE, PLANE = 1, 0
INTERRUPTED_FEATURES = "interrupted while the feature map was built: nothing of it is written"
# Scans looked at, evenly spaced over the run: enough for a course in time, a second of work.
MOST_SCANS = 30


def build_finished_map(
    sequence: Sequence,
    results: list[ScanResult],
    config: Config,
    watch: Watch = SILENT,
    spool: Path | None = None,
    checkpoints: MapCheckpoints | None = None,
    problems: list[str] | None = None,
) -> BuiltMap:
    """The map of `build_map`, coloured if the configuration says so. Raises as `build_map` and `colour_map`.

    problems : list for the reason why no image colours the map, which is returned uncoloured then; None raises instead
    """
    if config.map.colour:
        cameras_of(sequence)  # what is wrong with them is said before the work
    result = build_map(sequence, results, config, watch, spool, checkpoints)
    if not config.map.colour:
        return result
    log.info("colouring the map")
    try:
        with asking(watch.should_stop, INTERRUPTED):
            cloud, counts = colour_map(
                result.cloud, sequence, results, config, Watch(should_stop=watch.should_stop), spool
            )
    except InputError as error:
        if problems is None:
            raise
        problems.append(f"{error}; it is written without")
        log.warning("%s", problems[-1])
        return result
    sample, steps = thin_out(cloud, SAMPLE, COLUMNS), (*result.steps, f"coloured: {counts}")
    return replace(result, cloud=cloud, sample=sample, colour=counts, steps=steps)


def colour_map(
    cloud: Cloud,
    sequence: Sequence,
    results: list[ScanResult],
    config: Config,
    watch: Watch = SILENT,
    spool: Path | None = None,
) -> tuple[ColouredCloud, ColourCounts]:
    """Colour the map `cloud` by all images that lie between two registered scans.

    Points of both scans count as occluders too: they contain moving objects that the map lacks or has elsewhere.
    An image that cannot be read is logged, counted and left out. Raises InputError when no image is left, and as `cameras_of`.
    """
    cameras = cameras_of(sequence)
    motion = motion_of(results)
    colourer = MapColourer(cloud, config.map.voxel, config.map.range_max, spool)
    waiting = _in_order(cameras, motion)
    images = sum(len(camera.stamps_ns) for camera in cameras)
    outside, unreadable = images - len(waiting), 0
    before: Floats | None = None
    for k, scan in posed_scans(sequence, results, config, watch, INTERRUPTED):
        points = None if scan is None else se3.apply(scan.T_world_lidar, scan.points.astype(np.float64))
        while waiting and waiting[0].stamp_ns <= results[k].stamp_ns:
            view = waiting.popleft()
            try:
                image = view.camera.image(view.number)
            except InputError as error:
                unreadable += 1
                if unreadable <= _MOST_IMAGES:
                    log.warning("an image is left out: %s", error)
                continue
            others = [some for some in (before, points) if some is not None]
            colourer.add(image, view.camera.lens, view.T_world_camera, others, view.sharpness)
        before = points
    if not colourer.images:
        raise InputError(
            f"no image of {sequence.name} can colour its map: {outside} are not between registered scans, "
            f"{unreadable} cannot be read"
        )
    result = colourer.result()
    counts = ColourCounts(len(cloud), colourer.unseen, colourer.images, outside, unreadable)
    log.info("colour: %s", counts)
    return result, counts


@dataclass(frozen=True)
class View:
    """An image of a camera, when it was taken, from where, T_world_camera (4, 4), and how much it counts for its sharpness."""

    stamp_ns: int
    camera: Camera
    number: int
    T_world_camera: Floats
    sharpness: float


def _in_order(cameras: list[Camera], motion: ContinuousMotion) -> deque[View]:
    """Images of all cameras that have poses, by time."""
    views = []
    for camera in cameras:
        stamps = camera.stamps_ns
        poses, rates, within = motion.at(stamps)
        # Nothing says how long an image was exposed, only that it was less than the time to the next: what a pixel moves in that
        # time says which image is sharper than which.
        interval_s = 1e-9 * float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
        sharpness = 1 / (1 + (rates * camera.lens.intrinsics[0] * interval_s) ** 2)
        for k in np.flatnonzero(within).tolist():
            T_world_camera = portable.product(poses[k], camera.T_lidar_camera)
            views.append(View(int(stamps[k]), camera, k, T_world_camera, float(sharpness[k])))
    return deque(sorted(views, key=lambda view: view.stamp_ns))


def motion_of(results: list[ScanResult]) -> ContinuousMotion:
    """Continuous motion of the LiDAR along the registered scans of the world, in stretches uninterrupted by others."""
    results = [result.at_stamp for result in results]
    is_registered = np.array([r.status == "ok" and not r.frame for r in results], bool)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_registered, [False]]).astype(int)))
    stretches = []
    for begin, end in edges.reshape(-1, 2):
        some = results[begin:end]
        stretches.append((np.array([r.stamp_ns for r in some], np.int64), np.stack([r.T_world_lidar for r in some])))
    return ContinuousMotion(stretches)


@dataclass(frozen=True)
class FeatureCloud:
    """Averaged points (M, 3), m, world, one per voxel and kind; kinds : (M,) uint8, EDGE 1 or PLANE 0."""

    points: Floats
    kinds: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.points)


class FeatureMaker:
    """Averages less sharp edges and less planar points in voxels.

    voxel : edge, m; reach : greatest range of points, m; keep : folder for a map that can be resumed
    """

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
    watch: Watch = SILENT,
    checkpoints: MapCheckpoints | None = None,
) -> FeatureCloud:
    """Map of the less sharp edges and less planar points of all registered scans, in voxels of `loam.feature_map_voxel`.

    Raises InterruptedRunError when `watch` says so; `checkpoints` then allow to continue.
    """
    course, message = course_of(results), INTERRUPTED_FEATURES
    make = partial(FeatureMaker, config.loam.feature_map_voxel, config.preprocess.range_max)
    maker, count, offer = begin_pass(checkpoints, make, np.stack([r.T_world_lidar for r in results]))
    numbers = range(count, len(results))
    for k, loaded in scans_again(sequence, odometry.prepare, numbers, config, watch, message, count, offer):
        if loaded.scan is not None and results[k].status == "ok":
            motion = motion_within(loaded.scan, course)
            maker.add(odometry.features_of(loaded.prepared, motion), results[k].T_world_lidar)
    with asking(watch.should_stop, message):
        return maker.finish()


def view_features(sequence: Sequence, odometry: FeatureSource, results: list[ScanResult]) -> FeatureView | None:
    """Features of up to `MOST_SCANS` registered scans, at their final poses; None without any.

    A scan that can no longer be read, or has no features, is left out.
    """
    numbers = [k for k, result in enumerate(results) if result.status == "ok"]
    if not numbers:
        return None
    course, views = course_of(results), []
    for i in np.linspace(0, len(numbers) - 1, min(MOST_SCANS, len(numbers))).astype(int):
        try:
            scan = sequence.scan(numbers[i])
            features = odometry.features_of(odometry.prepare(scan), motion_within(scan, course))
        except LslamError:
            continue
        views.append((numbers[i], features))
    if not views:
        return None
    middle, own = views[len(views) // 2]
    others = (own.less_edges, own.less_planes, own.neither)
    return FeatureView(
        scan=results[middle].index,
        edges=own.edges.points[:, :2],
        planes=own.planes.points[:, :2],
        around=np.concatenate([part.points for part in others]),
        map_edges=np.concatenate([se3.apply(results[k].T_world_lidar, f.less_edges.points) for k, f in views]),
        map_planes=np.concatenate([se3.apply(results[k].T_world_lidar, f.less_planes.points) for k, f in views]),
        scans=np.array([results[k].index for k, _ in views], np.int64),
        edge_counts=np.array([len(f.edges) for _, f in views], np.int64),
        plane_counts=np.array([len(f.planes) for _, f in views], np.int64),
    )
