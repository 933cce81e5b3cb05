"""Second pass over the raw scans: the merged map and the attributes of its points, from the final poses."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.config import Config
from lslam.core.config.outputs import MapConfig
from lslam.core.errors import InputError, InterruptedRunError
from lslam.core.geometry.se3 import poses_at
from lslam.core.stopping import asking
from lslam.core.types.cloud import Cloud, in_memory, thin_out
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import NO_RING, Scan
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.sequence import Sequence, readable
from lslam.core.types.state import State
from lslam.io.formats.text_tables import is_unix_time
from lslam.maps.clean import Cleaner, PosedScan
from lslam.maps.every_point import PointCollector
from lslam.maps.floor_plan import pixel_size, top_view
from lslam.maps.merge import MapMerger, ScanSums
from lslam.maps.mesh import denoise
from lslam.maps.observations import Observations
from lslam.maps.occupancy import OccupancyMapper
from lslam.odometry.frontend.checkpoints import Checkpoints
from lslam.odometry.frontend.register_scans import read_ahead
from lslam.odometry.frontend.tracker import ScanInput
from lslam.odometry.inertial.constant_velocity import Course
from lslam.pipeline.map_files import BuiltMap
from lslam.pipeline.run_folder import CHECKPOINT, RunFolder
from lslam.pipeline.watch import SILENT, Watch
from lslam.registration.preprocessing.deskew import deskew_points, knots_over
from lslam.registration.preprocessing.ground import Z, world_up_of
from lslam.registration.preprocessing.views import with_rings

log = logging.getLogger("lslam")

SAMPLE = 150_000  # points that a page shows in 3D: 12 bytes each in it, and 4 of their colour
COLUMNS = ("red", "green", "blue", "class")  # of it
INTERRUPTED = "interrupted while the map was built: nothing of it is written"
Offer = Callable[[int, bool], None]
KEY = "map.attributes"
_LOOKED_AT = 5  # scans, the first that can be read


def build_map(
    sequence: Sequence,
    results: list[ScanResult],
    config: Config,
    watch: Watch = SILENT,
    spool: Path | None = None,
    checkpoints: MapCheckpoints | None = None,
) -> BuiltMap:
    """Merge every registered scan.

    Bridged scans, and scans of another frame, are left out: their error would enter the map. A map too large for memory is
    kept in a temporary folder in `spool`. Raises InterruptedRunError when `watch` says so; `checkpoints` then allow resuming.
    """
    section = config.map
    poses = np.stack([r.T_world_lidar for r in results])
    up = world_up_of(config.preprocess, poses[0])
    maker, count, offer = begin_pass(checkpoints, lambda keep: MapMaker(section, spool, keep, up), poses)
    numbers = range(maker.first_again(count), len(results))
    sequence = with_attributes(sequence, config)
    pose_scan = scan_poser(results, config)

    def prepare(scan: Scan) -> tuple[PosedScan, ScanSums | None] | None:
        posed = pose_scan(scan)
        return None if posed is None else (posed, maker.sum_up(posed))

    for k, loaded in scans_again(sequence, prepare, numbers, config, watch, INTERRUPTED, count, offer):
        if loaded.prepared is not None:
            maker.add(k, *loaded.prepared)
    with asking(watch.should_stop, INTERRUPTED):
        result = replace(maker.finish(), attributes=attribute_notes(section, results[0].stamp_ns))
    labels = ", ".join(config.preprocess.drop_labels)
    return replace(result, steps=(*result.steps, f"without points of {labels}")) if labels else result


def scans_again(
    sequence: Sequence,
    prepare: Callable[[Scan], Any],
    numbers: range,
    config: Config,
    watch: Watch,
    message: str,
    count: int = 0,
    offer: Offer | None = None,
) -> Iterator[tuple[int, ScanInput]]:
    """Second pass over raw scans: their numbers, and the results of `prepare`, which runs ahead in a thread.

    message : of the InterruptedRunError that is raised when `watch` says so
    count : number of scans that an earlier pass has processed; offer : called with each further number, and whether it is the
        last
    """
    for _ in range(count):
        watch.on_step()
    ahead = read_ahead(sequence, prepare, config.input.workers, first=numbers.start)
    for k, loaded in zip(numbers, ahead, strict=False):
        is_last = watch.should_stop()
        if offer is not None and k >= count:
            offer(k, is_last)
        if is_last:
            raise InterruptedRunError(message)
        yield k, loaded
        if k >= count:
            watch.on_step()


def posed_scans(
    sequence: Sequence,
    results: list[ScanResult],
    config: Config,
    watch: Watch,
    message: str,
    numbers: range | None = None,
    count: int = 0,
    offer: Offer | None = None,
) -> Iterator[tuple[int, PosedScan | None]]:
    """As `scans_again`, by default of all scans, each deskewed and at its pose; None in place of an unregistered scan."""
    numbers = range(len(results)) if numbers is None else numbers
    for k, loaded in scans_again(sequence, scan_poser(results, config), numbers, config, watch, message, count, offer):
        yield k, loaded.prepared


def scan_poser(results: list[ScanResult], config: Config) -> Callable[[Scan], PosedScan | None]:
    """Function that deskews a scan by all poses and moves it to its own; it returns None for an unregistered scan.

    For the thread that reads.
    """
    ego_box, names = config.map.ego_box or config.preprocess.ego_box, config.map.attributes
    results = [result.at_stamp for result in results]
    # Poses in frames of their own tell nothing of the motion in this one.
    here = [result for result in results if not result.frame]
    course, by_index = course_of(here), {result.index: result for result in here if result.status == "ok"}

    def pose_scan(scan: Scan) -> PosedScan | None:
        result = by_index.get(scan.index)
        if result is None:
            return None
        scan = scan if ego_box is None else without_box(scan, ego_box)
        points = deskew_points(scan.points, scan.times, motion_within(scan, course))
        return PosedScan(points, result.T_world_lidar, scan.intensity, Observations.of(scan) if names else None)

    return pose_scan


class MapMaker:
    """Makes a map out of scans: cleaning, merging, occupancy.

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
        self._numbers: list[int] = []

    def sum_up(self, scan: PosedScan) -> ScanSums | None:
        """Sum up the points of a scan, which the reading thread can do; None where cleaning must come first."""
        if self._cleaner is not None or not isinstance(self._merger, MapMerger):
            return None
        return self._merger.sum_up(scan.points, scan.T_world_lidar, scan.intensity, scan.observations)

    def add(self, number: int, scan: PosedScan, sums: ScanSums | None = None) -> None:
        """Add a registered scan, and its number among all scans; sums : of `sum_up`."""
        self._numbers.append(number)
        self._merge([scan] if self._cleaner is None else self._cleaner.add(scan), sums)

    def finish(self) -> BuiltMap:
        """The map of all added scans, with its image from above, a sample, and the processing steps in words."""
        if self._cleaner is not None:
            self._merge(self._cleaner.finish())
            log.info("map: %d of %d points moved and are left out", self._cleaner.removed, self._cleaner.seen)
        cloud: Cloud = self._merger.result()
        steps = [] if self._section.crop is None else [f"cropped to {list(self._section.crop)}"]
        if self._cleaner is not None:
            steps.append(f"cleaned: {self._cleaner.removed} of {self._cleaner.seen} points moved")
        if self._section.denoise:
            before, cloud = len(cloud), denoise(in_memory(cloud))
            steps.append(f"denoised: {before - len(cloud)} of {before} points were far from their neighbours")
        view = top_view(cloud, pixel_size(self._section.voxel))
        occupancy = None if self._occupancy is None else self._occupancy.result()
        return BuiltMap(cloud, view, thin_out(cloud, SAMPLE, COLUMNS), tuple(steps), occupancy)

    def state(self) -> State:
        """State for `restore`; voxels and cells are written to `keep`."""
        parts = {"merger": self._merger, "cleaner": self._cleaner, "occupancy": self._occupancy}
        return {name: part.state() for name, part in parts.items() if part is not None} | {
            "given": np.array(self._numbers, np.int64)
        }

    def restore(self, state: State) -> None:
        """Restore `state` in an empty maker of the same kind. Raises InputError when voxels are missing."""
        self._merger.restore(state["merger"])
        self._numbers = state["given"].tolist()
        if self._occupancy is not None:
            self._occupancy.restore(state["occupancy"])
        if self._cleaner is not None:
            del self._numbers[self._cleaner.restore(state["cleaner"]) :]

    def first_again(self, done: int) -> int:
        """Number of the scan from which reading must begin again after `done` scans, since the cleaner looks back."""
        if self._cleaner is None or not done:
            return done
        return self._numbers[-1] + 1 if self._numbers else 0

    def _merge(self, scans: Iterable[PosedScan], sums: ScanSums | None = None) -> None:
        """Add cleaned scans to the map, and to the occupancy if there is one; sums : of the one scan, if known."""
        for posed in scans:
            if sums is not None and isinstance(self._merger, MapMerger):
                self._merger.add_sums(sums)
            else:
                self._merger.add(posed.points, posed.T_world_lidar, posed.intensity, posed.observations)
            if self._occupancy is not None:
                self._occupancy.add(posed.points, posed.T_world_lidar)


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
    """Motion of the sensor during a sweep, by the final poses of surrounding scans; one pose if there are fewer than two."""
    times = knots_over(scan.span)
    if len(times) < 2 or len(course.instants_ns) < 2:
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
    """Checkpoints of a pass over scans, for a later pass over the same poses after an interruption.

    what : name of the result, for the log
    """

    def __init__(self, checkpoints: Checkpoints, what: str) -> None:
        self._checkpoints, self._what = checkpoints, what
        self._poses = ""

    @property
    def folder(self) -> Path:
        """Folder for the voxels, in subfolders."""
        return self._checkpoints.folder

    def begin(self, make: Callable[[], M], poses: Floats) -> tuple[M, int]:
        """Maker as an earlier pass over `poses` (N, 4, 4) left it, and number of its scans; a new one, and 0, without."""
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


def begin_pass(
    checkpoints: MapCheckpoints | None, make: Callable[[Path | None], M], poses: Floats
) -> tuple[M, int, Offer | None]:
    """What a pass over scans at `poses` (N, 4, 4) begins with.

    make : creates the builder, by the folder for its voxels, None where it needs none

    Returns the builder, from a checkpoint if there is one, the number of scans that are in it, and a function that offers it
    checkpoints.
    """
    if checkpoints is None:
        return make(None), 0, None
    maker, count = checkpoints.begin(partial(make, checkpoints.folder), poses)
    return maker, count, partial(checkpoints.offer, maker)


def map_checkpoints(folder: RunFolder, config: Config, what: str = "map") -> MapCheckpoints | None:
    """Checkpoints of a run folder; None when they are not wanted."""
    every_s = config.odometry.checkpoint_s
    if every_s == 0:
        return None
    return MapCheckpoints(Checkpoints(folder.path / CHECKPOINT, what.replace(" ", "-"), every_s), what)


def needs_labels(section: MapConfig) -> bool:
    """Whether points need labels for the attributes of the map."""
    return "class" in section.attributes


def with_attributes(sequence: Sequence, config: Config) -> Sequence:
    """The sequence with rings, where the map stores them and the points have none; points without a ring remain.

    Raises InputError where rings cannot be determined.
    """
    if "ring" not in config.map.attributes:
        return sequence
    scans = [scan for _, scan in islice(readable(range(len(sequence)), sequence.scan), _LOOKED_AT)]
    if not scans or any(scan.rings is not None for scan in scans):
        return sequence
    try:
        return with_rings(sequence, config.input.rings, is_strict=False)
    except InputError as error:
        raise InputError(f"{error}; or leave ring out of {KEY}") from None


def attribute_notes(section: MapConfig, first_ns: int) -> dict[str, str]:
    """Meaning of each attribute, in words, by its name; first_ns : earliest stamp of the recording."""
    clock = "Unix time in PLY and PCD, adjusted standard GPS time (less 1e9 s) in LAS and LAZ"
    if "time" in section.attributes and not is_unix_time(first_ns):
        clock = "the recording's own seconds, which are no Unix time; LAS and LAZ mark them as GPS week time"
        log.warning("map: stamps of the recording are no Unix time: points keep its own seconds")
    own = {
        "time": f"s; {clock}",
        "scan": "number in the recording, from 0",
        "ring": f"number of the beam; {NO_RING} where it has none",
        "range": "m, from the sensor, as measured",
        "observations": "number of points averaged",
        "class": "label in the recording; in LAS and LAZ also classification, of SemanticKITTI's numbers",
    }
    nearest = "" if section.voxel == 0 else "; of the observation nearest to the sensor"
    return {name: own[name] + (nearest if name != "observations" else "") for name in section.attributes}
