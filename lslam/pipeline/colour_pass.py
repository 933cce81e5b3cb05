"""Third pass of a map: its points in the colours of the recording's images, from the final poses."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lslam.core.config import Config
from lslam.core.errors import InputError
from lslam.core.geometry import portable, se3
from lslam.core.geometry.se3 import ContinuousMotion
from lslam.core.stopping import asking
from lslam.core.types.arrays import Floats
from lslam.core.types.camera import Camera, cameras_of
from lslam.core.types.cloud import Cloud, thin_out
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.sequence import Sequence
from lslam.maps.colour import ColourCounts, ColouredCloud, MapColourer
from lslam.pipeline.map_pass import (
    INTERRUPTED,
    SAMPLE,
    SHOWN,
    BuiltMap,
    MapCheckpoints,
    build_map,
    scan_poser,
    scans_again,
)

log = logging.getLogger("lslam")
_NAMED = 3  # images that cannot be read, one by one


def build_finished_map(
    sequence: Sequence,
    results: list[ScanResult],
    config: Config,
    on_step: Callable[[], None],
    should_stop: Callable[[], bool],
    spool: Path | None = None,
    checkpoints: MapCheckpoints | None = None,
    problems: list[str] | None = None,
) -> BuiltMap:
    """The map of `build_map`, coloured if the configuration says so. Raises as `build_map` and `colour_map`.

    problems : takes why no image colours the map, which stays as it is then; None where that raises
    """
    if not config.map.colour:
        return build_map(sequence, results, config, on_step, should_stop, spool, checkpoints)
    cameras_of(sequence)  # what is wrong with them is said before the work
    built = build_map(sequence, results, config, on_step, should_stop, spool, checkpoints)
    log.info("colouring the map")
    try:
        with asking(should_stop, INTERRUPTED):
            coloured, counts = colour_map(built.merged, sequence, results, config, should_stop, spool)
    except InputError as error:
        if problems is None:
            raise
        problems.append(f"{error}; it is written without")
        log.warning("%s", problems[-1])
        return built
    sample = thin_out(coloured, SAMPLE, SHOWN)
    return replace(built, merged=coloured, sample=sample, colour=counts, done=(*built.done, f"coloured: {counts}"))


def colour_map(
    cloud: Cloud,
    sequence: Sequence,
    results: list[ScanResult],
    config: Config,
    should_stop: Callable[[], bool],
    spool: Path | None = None,
) -> tuple[ColouredCloud, ColourCounts]:
    """Colour the map `cloud` by all images that lie between two registered scans.

    Both scans are in the way as well: they have what passes while the image is taken and is in no map, or elsewhere in it.
    An image that cannot be read is logged, counted and left out. Raises InputError when no image is left, and as `cameras_of`.
    """
    cameras = cameras_of(sequence)
    motion = motion_of(results)
    colourer = MapColourer(cloud, config.map.voxel, config.map.range_max, spool)
    waiting = _in_order(cameras, motion)
    images = sum(len(camera.stamps_ns) for camera in cameras)
    outside, unreadable = images - len(waiting), 0
    before: Floats | None = None
    for k, points in _posed_scans(sequence, results, config, should_stop):
        while waiting and waiting[0].stamp_ns <= results[k].stamp_ns:
            view = waiting.popleft()
            try:
                image = view.camera.image(view.number)
            except InputError as error:
                unreadable += 1
                if unreadable <= _NAMED:
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
    coloured = colourer.result()
    counts = ColourCounts(len(cloud), colourer.unseen, colourer.images, outside, unreadable)
    log.info("colour: %s", counts)
    return coloured, counts


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


def _posed_scans(
    sequence: Sequence, results: list[ScanResult], config: Config, should_stop: Callable[[], bool]
) -> Iterator[tuple[int, Floats | None]]:
    """Number and points (N, 3), world, m, of each scan; None for one that is not registered."""
    poser = scan_poser(results, config)
    numbers = range(len(results))
    for k, loaded in scans_again(sequence, poser, numbers, config, lambda: None, should_stop, INTERRUPTED):
        scan = loaded.prepared
        yield k, None if scan is None else se3.apply(scan.T_world_lidar, scan.points.astype(np.float64))


def motion_of(results: list[ScanResult]) -> ContinuousMotion:
    """Motion of the LiDAR along the registered scans of the world, in stretches without others between them."""
    stamped = [result.at_stamp for result in results]
    registered = np.array([r.status == "ok" and not r.frame for r in stamped], bool)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], registered, [False]]).astype(int)))
    stretches = []
    for begin, end in edges.reshape(-1, 2):
        some = stamped[begin:end]
        stretches.append((np.array([r.stamp_ns for r in some], np.int64), np.stack([r.T_world_lidar for r in some])))
    return ContinuousMotion(stretches)
