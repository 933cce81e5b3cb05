"""A sequence in another layout: a bag of ROS 1 or ROS 2, or KITTI's folders. It reads back as the same sequence."""

from __future__ import annotations

import heapq
import logging
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lslam.core.errors import InputError, UsageError
from lslam.core.geometry import se3
from lslam.core.types.scan import Scan
from lslam.core.types.sequence import Calibration, Sequence
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats.bag_files import INFO_TOPIC
from lslam.io.formats.kitti_layout import PER_POINT, POINTS, in_camera, write_calib, write_scan, write_times
from lslam.io.formats.sequence_toml import FILE_NAME, FRAMES, SequenceInfo, sequence_toml_text, write_sequence_toml
from lslam.io.formats.stamped_csv import write_gnss_csv, write_imu_csv
from lslam.io.formats.trajectory_lines import write_kitti, write_tum
from lslam.io.readers.sequence_on_disk import add_labels
from lslam.odometry.frontend.register_scans import sweep_of
from lslam.odometry.inertial.constant_velocity import Course
from lslam.pipeline.convert import check_beside, check_output, stage
from lslam.pipeline.convert.bag_writer import BagMessages, BagWriter
from lslam.pipeline.convert.convert_trajectory import change_frame
from lslam.pipeline.map_pass import motion_within
from lslam.registration.preprocessing.deskew import deskew_points
from lslam.registration.preprocessing.views import MergedLidars

log = logging.getLogger("lslam")

# Stamp, rank among equal stamps, topic, and the function that makes the message.
Message = tuple[int, int, str, Callable[[], Any]]
LIDARS = ("merged", "topics", "frames")
NUMBER = "00"  # of the one sequence in KITTI's layout
TRUTH_FILE, IMU_FILE, GNSS_FILE = "ground_truth.tum", "imu.csv", "gnss.csv"


@dataclass(frozen=True)
class ScanCount:
    """Result of `convert_sequence`: number of scans, and number of unreadable ones, which are left out."""

    scans: int
    unreadable: int


def convert_sequence(
    sequence: Sequence,
    kind: str,
    out: Path,
    *,
    is_zstd: bool = False,
    overwrite: bool = False,
    trajectory: Trajectory | None = None,
    lidars: str = "merged",
    on_scan: Callable[[], None] = lambda: None,
) -> ScanCount:
    """Write `sequence` to `out`, whole or not at all.

    kind : `bag` (ROS 1, one file), `mcap` or `sqlite` (ROS 2, a folder, or a file when `out` ends in .mcap or .db3), `kitti`
    is_zstd : compress mcap and sqlite
    trajectory : LiDAR poses along which scans with per-point times are deskewed on the way; None leaves them as they are
    lidars : of several, one of `LIDARS`: as merged, or in a bag each on a topic of its own, or all on one, told apart by frames
    Raises OutputExistsError, OutputError: as named. UsageError: `out` or `lidars` does not suit. InputError: no scan can be read.
    """
    check_output(kind, out, is_zstd, overwrite)
    source = _Source(add_labels(sequence), trajectory, on_scan)
    if lidars != "merged":
        if kind == "kitti" or trajectory is not None or not isinstance(sequence, MergedLidars):
            raise UsageError(
                f"--lidars {lidars} is for whole recordings of several LiDARs, to a bag and not --deskewed"
            )
        source.take_apart(sequence, lidars == "frames")
    check_beside(out, sequence.path, "the sequence")
    with stage(out) as path:
        if kind == "kitti":
            _write_kitti(source, path)
        else:
            _write_bag(source, path, kind, is_zstd)
    return ScanCount(source.readable, source.unreadable)


@dataclass(frozen=True)
class _Lidar:
    """LiDAR of a bag: its scans, topic and frame, and its mounting `T_lidar_other` (4, 4)."""

    scans: Sequence
    topic: str = "/points"
    frame: str = "lidar"
    T_lidar_other: Any = None


class _Source:
    """Scans of a sequence in order, deskewed on request; damaged ones are logged, counted and left out.

    trajectory : of the LiDAR, to deskew by; None writes points as they are; on_scan : called after each scan
    lidars : the LiDARs to write into a bag, the leading one first
    """

    def __init__(self, sequence: Sequence, trajectory: Trajectory | None, on_scan: Callable[[], None]) -> None:
        self.sequence, self.trajectory, self.on_scan = sequence, trajectory, on_scan
        self.lidars, self.keys = [_Lidar(sequence)], SequenceInfo()
        self.readable = self.unreadable = 0
        self.sweep = None if trajectory is None else sweep_of(sequence)
        if trajectory is not None:
            self.trajectory = self._check(trajectory)

    def take_apart(self, lidars: MergedLidars, on_one_topic: bool) -> None:
        """Split merged scans by LiDAR, and state which LiDARs are merged when the bag is read."""
        others = lidars.further_lidars
        names = [re.sub(r"\W+", "_", other.name).strip("_") for other in others]
        if len(set(names)) < len(names):
            names = [str(number) for number in range(2, len(names) + 2)]
        frames = ["lidar", *(f"lidar_{name}" for name in names)]
        topics = ["/points" if on_one_topic else f"/{frame}/points" for frame in frames]
        parts = [(lidars.whole, None), *((other.scans, other.T_lidar_other) for other in others)]
        self.lidars = [
            _Lidar(scans, topic, frame, T) for (scans, T), topic, frame in zip(parts, topics, frames, strict=True)
        ]
        of_frames, of_topics = SequenceInfo(lidar_frame=",".join(frames)), SequenceInfo(lidar_topic=",".join(topics))
        self.keys = of_frames if on_one_topic else of_topics

    def scans(self, lidar: _Lidar | None = None) -> Iterator[Scan]:
        """Readable scans of a LiDAR (None: the leading one), deskewed; raises InputError after the last if none was readable."""
        lidar = lidar or self.lidars[0]
        unreadable = 0
        for k in range(len(lidar.scans)):
            try:
                scan = self._deskew(lidar.scans.scan(k))
            except InputError as error:
                log.warning("left out: %s", error)
                unreadable += 1
            else:
                yield scan
            if lidar is self.lidars[0]:
                self.on_scan()
        if unreadable == len(lidar.scans):
            raise InputError(f"{lidar.scans.path}: none of its {unreadable} scans can be read")
        self.readable += len(lidar.scans) - unreadable
        self.unreadable += unreadable

    def _check(self, trajectory: Trajectory) -> Trajectory:
        """The trajectory as LiDAR poses. Raises InputError when scans cannot be deskewed or no trajectory is given."""
        if self.sweep is None:
            raise InputError(f"{self.sequence.path} has no per-point times: there is nothing to deskew")
        if len(trajectory) < 2 or not trajectory.has_stamps:
            raise InputError(f"{trajectory.source} has no stamped poses to deskew along")
        return change_frame(trajectory, "lidar", self.calibration) if trajectory.frame in FRAMES else trajectory

    def _deskew(self, scan: Scan) -> Scan:
        """The scan deskewed along the trajectory, if there is one; raises InputError for a scan outside of its time."""
        if self.trajectory is None or scan.times is None:
            return scan
        if not self.trajectory.stamps_ns[0] <= scan.stamp_ns <= self.trajectory.stamps_ns[-1]:
            raise InputError(
                f"scan {scan.index} at {scan.stamp_ns} ns lies outside the trajectory it is deskewed along"
            )
        motion = motion_within(scan, Course(self.trajectory.stamps_ns, self.trajectory.poses))
        return replace(scan, points=deskew_points(scan.points, scan.times, motion), times=None)

    @property
    def calibration(self) -> Calibration:
        """Known extrinsics; those that a reader assumed are left out."""
        stated = self.sequence.calibration
        return replace(stated, T_lidar_imu=None) if getattr(self.sequence, "has_assumed_extrinsics", False) else stated

    def info(self) -> SequenceInfo:
        """Description of the sequence as written, for sequence.toml."""
        return replace(
            self.keys,
            name=self.sequence.name,
            sensor=getattr(self.sequence, "sensor", None),
            rings=getattr(self.sequence, "rings", None),
            rate_hz=self.sequence.rate_hz,
            motion_compensated=self.trajectory is not None or self.sequence.motion_compensated,
            compensated_to=None if self.sweep is None else self.sweep.instant,
            T_cam0_lidar=self.calibration.T_cam0_lidar,
            T_lidar_imu=self.calibration.T_lidar_imu,
            T_lidar_gnss=self.calibration.T_lidar_gnss,
            frames=self.calibration.frames or None,
        )


def _write_bag(source: _Source, out: Path, kind: str, is_zstd: bool) -> None:
    """Write description, static transforms, and all messages in order of time into a bag."""
    with BagWriter(out, kind, is_zstd) as writer:
        begin = _first_stamp(source)
        writer.write(INFO_TOPIC, begin, writer.messages.text(sequence_toml_text(source.info())))
        transforms = _transforms(source.calibration)
        transforms |= {("lidar", one.frame): one.T_lidar_other for one in source.lidars[1:]}
        if transforms:
            writer.write("/tf_static", begin, writer.messages.transforms(begin, transforms))
        for stamp, _, topic, make in heapq.merge(*_messages(source, writer.messages), key=lambda m: m[:2]):
            writer.write(topic, stamp, make())


def _messages(source: _Source, messages: BagMessages) -> list[Iterator[Message]]:
    """For each topic its messages in order of time: stamp (ns), rank among equal stamps, topic, function that makes it."""
    sequence = source.sequence
    imu, gnss, truth = sequence.imu, sequence.gnss, sequence.ground_truth
    topics = [_clouds(source, lidar, rank, messages) for rank, lidar in enumerate(source.lidars, 3)]
    if imu is not None:
        rows = zip(imu.stamps_ns.tolist(), imu.accel, imu.gyro, strict=True)
        topics.append((t, 0, "/imu", partial(messages.imu, t, a, g, "imu")) for t, a, g in rows)
    if gnss is not None:
        fixes = zip(gnss.stamps_ns.tolist(), gnss.lat_lon_alt, gnss.sigma.tolist(), strict=True)
        topics.append((t, 1, "/gnss", partial(messages.fix, t, p, s, "gnss")) for t, p, s in fixes)
    if truth is not None:
        poses = zip(truth.stamps_ns.tolist(), truth.poses, strict=True)
        topics.append((t, 2, "/ground_truth", partial(messages.odometry, t, T, "world", "lidar")) for t, T in poses)
    return topics


def _clouds(source: _Source, lidar: _Lidar, rank: int, messages: BagMessages) -> Iterator[Message]:
    """Messages with the scans of a LiDAR; rank : their order among messages of equal stamps."""
    for scan in source.scans(lidar):
        yield scan.stamp_ns, rank, lidar.topic, partial(messages.cloud, scan, lidar.frame)


def _first_stamp(source: _Source) -> int:
    """Earliest stamp of all streams, ns."""
    sequence = source.sequence
    streams = (sequence.imu, sequence.gnss, sequence.ground_truth)
    starts = [int(s.stamps_ns[0]) for s in streams if s is not None and len(s)]
    return min([*(int(lidar.scans.stamps_ns[0]) for lidar in source.lidars), *starts])


def _transforms(calibration: Calibration) -> dict[tuple[str, str], Any]:
    """Known extrinsics T_lidar_frame (4, 4), by (lidar, frame), for /tf_static."""
    T_cam0_lidar = calibration.T_cam0_lidar
    below = {
        **calibration.frames,
        "imu": calibration.T_lidar_imu,
        "gnss": calibration.T_lidar_gnss,
        "cam0": None if T_cam0_lidar is None else se3.inverse(T_cam0_lidar),
    }
    return {("lidar", frame): T for frame, T in below.items() if T is not None and frame != "lidar"}


def _write_kitti(source: _Source, out: Path) -> None:
    """Write the scans in KITTI's odometry layout, with all other files."""
    folder = out / "sequences" / NUMBER
    for inside in (folder / POINTS, folder / PER_POINT, out / "poses"):
        inside.mkdir(parents=True)
    stamps = []
    for number, scan in enumerate(source.scans()):
        write_scan(folder, number, scan)
        stamps.append(scan.stamp_ns)
    _write_sides(source, folder, out / "poses", np.array(stamps, np.int64))


def _write_sides(source: _Source, folder: Path, poses: Path, stamps: Any) -> None:
    """Write the files besides the scans: times, calibration, IMU, fixes, ground truth and sequence.toml."""
    sequence, calibration, info = source.sequence, source.calibration, source.info()
    write_times(folder, stamps)
    if calibration.T_cam0_lidar is not None:
        write_calib(folder, calibration.T_cam0_lidar)
    if sequence.imu is not None:
        write_imu_csv(folder / IMU_FILE, sequence.imu)
        info = replace(info, imu=IMU_FILE)
    if sequence.gnss is not None:
        write_gnss_csv(folder / GNSS_FILE, sequence.gnss)
        info = replace(info, gnss=GNSS_FILE)
    truth, T_cam0_lidar = sequence.ground_truth, calibration.T_cam0_lidar
    if truth is not None and T_cam0_lidar is not None and np.array_equal(truth.stamps_ns, stamps):
        write_kitti(poses / f"{NUMBER}.txt", in_camera(truth, T_cam0_lidar))
        info = replace(info, ground_truth=f"../../poses/{NUMBER}.txt", ground_truth_frame="cam0")
    elif truth is not None:
        # KITTI's poses have no stamps and are of a camera: neither would do here.
        write_tum(folder / TRUTH_FILE, truth)
        info = replace(info, ground_truth=TRUTH_FILE, ground_truth_frame="lidar")
    # Without a word, KITTI's layout means scans that are compensated and need the HDL-64E's vertical correction.
    info = replace(
        info, per_point=PER_POINT, vertical_correction_deg=0.0, motion_compensated=bool(info.motion_compensated)
    )
    write_sequence_toml(folder / FILE_NAME, info)
