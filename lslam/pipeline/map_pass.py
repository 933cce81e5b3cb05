"""Second pass over the raw scans: the merged map, from the final poses."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from lslam.core.config import Config
from lslam.core.config.outputs import MapConfig
from lslam.core.errors import InputError, InterruptedRunError
from lslam.core.geometry.se3 import poses_at
from lslam.core.stopping import asking
from lslam.core.types.arrays import Floats
from lslam.core.types.cloud import ArrayCloud, Cloud, in_memory, thin_out
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.sequence import Sequence
from lslam.core.types.state import State
from lslam.maps.clean import Cleaner, PosedScan
from lslam.maps.colour import ColourCounts
from lslam.maps.every_point import PointCollector
from lslam.maps.floor_plan import TopView, pixel_size, top_view
from lslam.maps.merge import MapMerger
from lslam.maps.mesh import denoise
from lslam.maps.observations import Observations
from lslam.maps.occupancy import OccupancyGrid, OccupancyMapper
from lslam.odometry.frontend.checkpoints import Checkpoints
from lslam.odometry.frontend.register_scans import read_ahead
from lslam.odometry.frontend.tracker import ScanInput
from lslam.odometry.inertial.constant_velocity import Course
from lslam.pipeline.map_attributes import attribute_notes, with_attributes
from lslam.pipeline.run_folder import CHECKPOINT, RunFolder
from lslam.registration.preprocessing.deskew import deskew_points, knots_over
from lslam.registration.preprocessing.ground import Z, world_up_of

log = logging.getLogger("lslam")

SAMPLE = 150_000  # points that a page shows in 3D: 12 bytes each in it, and 4 of their colour
SHOWN = ("red", "green", "blue", "class")
INTERRUPTED = "interrupted while the map was built: nothing of it is written"


@dataclass(frozen=True)
class BuiltMap:
    """Result of building a map: the merged map, its top view, and a sample of its points for pages.

    Also the processing steps, in words, the occupancy if requested, the numbers of a coloured map, and the meaning of each
    attribute of its points.
    """

    merged: Cloud
    view: TopView
    sample: ArrayCloud
    done: tuple[str, ...] = ()
    occupancy: OccupancyGrid | None = None
    colour: ColourCounts | None = None
    attributes: Mapping[str, str] = field(default_factory=dict)


def build_map(
    sequence: Sequence,
    results: list[ScanResult],
    config: Config,
    on_step: Callable[[], None],
    should_stop: Callable[[], bool],
    spool: Path | None = None,
    checkpoints: MapCheckpoints | None = None,
) -> BuiltMap:
    """Merge every registered scan.

    Bridged scans, and scans of another frame, are left out: their error would enter the map. A map too large for memory is
    kept in a temporary folder in `spool`. Raises InterruptedRunError when `should_stop` says so; `checkpoints` then allow to
    continue.
    """
    section = config.map
    poses = np.stack([r.T_world_lidar for r in results])
    up = world_up_of(config.preprocess, poses[0])

    def make() -> MapMaker:
        return MapMaker(section, spool, None if checkpoints is None else checkpoints.folder, up)

    maker, done = (make(), 0) if checkpoints is None else checkpoints.begin(make, poses)
    numbers = range(maker.first_again(done), len(results))
    sequence = with_attributes(sequence, config)
    poser, offer = scan_poser(results, config), None if checkpoints is None else partial(checkpoints.offer, maker)
    for k, loaded in scans_again(sequence, poser, numbers, config, on_step, should_stop, INTERRUPTED, done, offer):
        if loaded.prepared is not None:
            maker.add(k, loaded.prepared)
    with asking(should_stop, INTERRUPTED):
        built = replace(maker.finish(), attributes=attribute_notes(section, results[0].stamp_ns))
    dropped = ", ".join(config.preprocess.drop_labels)
    return replace(built, done=(*built.done, f"without points of {dropped}")) if dropped else built


def scans_again(
    sequence: Sequence,
    prepare: Callable[[Scan], Any],
    numbers: range,
    config: Config,
    on_step: Callable[[], None],
    should_stop: Callable[[], bool],
    interrupted: str,
    done: int = 0,
    offer: Callable[[int, bool], None] | None = None,
) -> Iterator[tuple[int, ScanInput]]:
    """Second pass over raw scans: their numbers, and the results of `prepare`, which runs ahead in a thread.

    interrupted : message of the InterruptedRunError that is raised when `should_stop` says so
    done : number of scans that an earlier pass has done; offer : is called with each further number, and whether it is the last
    """
    for _ in range(done):
        on_step()
    ahead = read_ahead(sequence, prepare, config.input.workers, first=numbers.start)
    for k, loaded in zip(numbers, ahead, strict=False):
        is_last = should_stop()
        if offer is not None and k >= done:
            offer(k, is_last)
        if is_last:
            raise InterruptedRunError(interrupted)
        yield k, loaded
        if k >= done:
            on_step()


def scan_poser(results: list[ScanResult], config: Config) -> Callable[[Scan], PosedScan | None]:
    """Function that deskews a scan by all poses and moves it to its own; it returns None for an unregistered scan.

    For the thread that reads, since merging takes as long as reading and deskewing together.
    """
    ego_box, names = config.map.ego_box or config.preprocess.ego_box, config.map.attributes
    results = [result.at_stamp for result in results]
    # Poses in frames of their own tell nothing of the motion in this one.
    here = [result for result in results if not result.frame]
    course, registered = course_of(here), {result.index: result for result in here if result.status == "ok"}

    def pose_scan(scan: Scan) -> PosedScan | None:
        result = registered.get(scan.index)
        if result is None:
            return None
        scan = scan if ego_box is None else without_box(scan, ego_box)
        points = deskew_points(scan.points, scan.times, motion_within(scan, course))
        return PosedScan(points, result.T_world_lidar, scan.intensity, Observations.of(scan) if names else None)

    return pose_scan


class MapMaker:
    """Processing of scans into a map: cleaning, merging, occupancy.

    section : configuration; spool : folder for maps too large for memory; keep : folder for a map that can be resumed
    up : (3,) unit vector, up in the world of the scans
    """

    def __init__(self, section: MapConfig, spool: Path | None = None, keep: Path | None = None, up: Floats = Z) -> None:
        self._section = section
        make = partial(MapMerger, section.voxel) if section.voxel else PointCollector
        self._merger: MapMerger | PointCollector = make(
            section.range_min,
            section.range_max,
            crop=section.crop_box,
            spool=spool,
            keep=None if keep is None else keep / "map",
            attributes=section.attributes,
        )
        self._cleaner = Cleaner(up) if section.clean else None
        self._occupancy = None
        if section.occupancy:
            self._occupancy = OccupancyMapper(
                section.occupancy_voxel,
                section.range_min,
                section.occupancy_range,
                spool=spool,
                keep=None if keep is None else keep / "occupancy",
            )
        self._given: list[int] = []

    def add(self, number: int, scan: PosedScan) -> None:
        """Add a registered scan, and its number among all scans."""
        self._given.append(number)
        self._merge([scan] if self._cleaner is None else self._cleaner.add(scan))

    def finish(self) -> BuiltMap:
        """Map of all added scans."""
        if self._cleaner is not None:
            self._merge(self._cleaner.finish())
            log.info("map: %d of %d points moved and are left out", self._cleaner.removed, self._cleaner.seen)
        merged: Cloud = self._merger.result()
        done = _done(self._section, self._cleaner)
        if self._section.denoise:
            before, merged = len(merged), denoise(in_memory(merged))
            done = (*done, f"denoised: {before - len(merged)} of {before} points were far from their neighbours")
        view = top_view(merged, pixel_size(self._section.voxel))
        occupancy = None if self._occupancy is None else self._occupancy.result()
        return BuiltMap(merged, view, thin_out(merged, SAMPLE, SHOWN), done, occupancy)

    def state(self) -> State:
        """State for `restore`; voxels and cells are written to `keep`."""
        parts = {"merger": self._merger, "cleaner": self._cleaner, "occupancy": self._occupancy}
        return {name: part.state() for name, part in parts.items() if part is not None} | {
            "given": np.array(self._given, np.int64)
        }

    def restore(self, state: State) -> None:
        """Restore `state` in an empty maker of the same kind. Raises InputError when voxels are missing."""
        self._merger.restore(state["merger"])
        self._given = state["given"].tolist()
        if self._occupancy is not None:
            self._occupancy.restore(state["occupancy"])
        if self._cleaner is not None:
            del self._given[self._cleaner.restore(state["cleaner"]) :]

    def first_again(self, done: int) -> int:
        """Number of the scan from which reading must begin again after `done` scans, since the cleaner looks back."""
        if self._cleaner is None or not done:
            return done
        return self._given[-1] + 1 if self._given else 0

    def _merge(self, scans: Iterable[PosedScan]) -> None:
        for posed in scans:
            self._merger.add(posed.points, posed.T_world_lidar, posed.intensity, posed.observations)
            if self._occupancy is not None:
                self._occupancy.add(posed.points, posed.T_world_lidar)


def _done(section: MapConfig, cleaner: Cleaner | None) -> tuple[str, ...]:
    """Processing steps of the map, in words."""
    done = [] if section.crop is None else [f"cropped to {list(section.crop)}"]
    if cleaner is not None:
        done.append(f"cleaned: {cleaner.removed} of {cleaner.seen} points moved")
    return tuple(done)


def without_box(scan: Scan, box: tuple[float, ...]) -> Scan:
    """Scan without the points in a box of the LiDAR frame (x_min, x_max, y_min, y_max, z_min, z_max), m.

    It must be called before deskewing, since parts of the vehicle do not move relative to the sensor.
    """
    low, high = np.array(box[::2], np.float32), np.array(box[1::2], np.float32)
    inside = np.all((scan.points >= low) & (scan.points <= high), axis=1)
    return scan.select(np.flatnonzero(~inside))


def course_of(results: list[ScanResult]) -> Course:
    """Course of the sensor through the poses of scans at their stamps."""
    return Course(np.array([r.stamp_ns for r in results], np.int64), np.stack([r.T_world_lidar for r in results]))


def motion_within(scan: Scan, course: Course) -> MotionPrior:
    """Motion of the sensor during a sweep, from the final poses of the scans round it; one pose if they do not tell."""
    times, known = knots_over(scan.span), len(course.instants_ns)
    if len(times) < 2 or known < 2:
        return MotionPrior.at_once(np.eye(4))
    poses = course.at(scan.stamp_ns, times)
    if poses is None:
        instants_ns = scan.stamp_ns + np.round(1e9 * times).astype(np.int64)
        poses = poses_at(course.instants_ns, course.poses, instants_ns)
    return MotionPrior(times, poses)


class Maker(Protocol):
    """Interface of a map builder that takes scan after scan."""

    def state(self) -> State:
        """State for `restore`."""

    def restore(self, state: State) -> None:
        """Restore `state` in an empty maker of the same kind. Raises InputError when voxels are missing."""


M = TypeVar("M", bound=Maker)


class MapCheckpoints:
    """Checkpoints of a pass over scans, for a later pass over the same poses after an interruption."""

    def __init__(self, checkpoints: Checkpoints, what: str) -> None:
        self._checkpoints, self._what = checkpoints, what
        self._poses = ""

    @property
    def folder(self) -> Path:
        """Folder for the voxels, in subfolders."""
        return self._checkpoints.folder

    def begin(self, make: Callable[[], M], poses: Floats) -> tuple[M, int]:
        """Maker in the state of an earlier pass over `poses` (N, 4, 4), and the number of scans it has done."""
        self._poses = hashlib.sha256(np.ascontiguousarray(poses).tobytes()).hexdigest()
        latest, maker = self._checkpoints.latest(), make()
        try:
            if latest is None or latest["poses"] != self._poses:
                raise InputError("the poses are others")
            maker.restore(latest["maker"])
        except InputError as error:
            if latest is not None:
                log.warning("the %s begins again: %s", self._what, error)
            self._checkpoints.clear()
            return make(), 0
        log.info("%s: going on after %d scans", self._what, latest["scans"])
        return maker, int(latest["scans"])

    def offer(self, maker: Maker, scans: int, is_last: bool = False) -> None:
        """Write a checkpoint after `scans` scans when one is due, or when it is the last."""
        if scans and (is_last or self._checkpoints.schedule.is_due):
            self._checkpoints.write(scans, lambda: {"poses": self._poses, "scans": scans, "maker": maker.state()})


def map_checkpoints(folder: RunFolder, config: Config, what: str = "map") -> MapCheckpoints | None:
    """Checkpoints of a run folder; None when they are not wanted."""
    every_s = config.odometry.checkpoint_s
    if every_s == 0:
        return None
    return MapCheckpoints(Checkpoints(folder.path / CHECKPOINT, what.replace(" ", "-"), every_s), what)
