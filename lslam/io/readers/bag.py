"""Bags of ROS 1 and ROS 2 as sequences: chooses topics, orders stamps, finds extrinsics; scans are read one at a time."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.geometry import portable, se3
from lslam.core.printable import first_of, printable
from lslam.core.types.gnss import GnssStream
from lslam.core.types.imu import ImuStream
from lslam.core.types.scan import Scan
from lslam.core.types.sequence import Calibration, Sequence
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats import bag_streams
from lslam.io.formats.bag_files import INFO_TOPIC, Bag, BagTopic, open_bag, read_header
from lslam.io.formats.bag_listing import list_bag_files, parts_beside, stem_of
from lslam.io.formats.bag_streams import Stream, chain, is_static, read_poses
from lslam.io.formats.point_cloud import TIME_NAMES, PointCloud
from lslam.io.formats.sensor_messages import can_decode
from lslam.io.formats.sequence_toml import LENGTHS, SequenceInfo, parse_sequence_toml
from lslam.io.readers.bag_lidars import NO_NAME, Halves, Links, ScanIndex, choose_lidars, places_of, put_together
from lslam.io.readers.bag_packets import open_packets
from lslam.io.readers.bag_topics import (
    GNSS,
    HEADER,
    IMU,
    check_parts,
    choose_clouds,
    index_scans,
    load_companion,
    put_in_order,
)
from lslam.io.readers.cameras import bag_cameras
from lslam.io.readers.clocks import ahead_of
from lslam.io.readers.ground_truth import Voice
from lslam.io.readers.listing import measured_rate
from lslam.io.readers.pcap_revolutions import Revolutions, SpinningSensor, read_scan
from lslam.io.readers.point_clock import (
    onto_recording,
    open_clock,
    point_stamps,
    points_off,
    read_samples,
    step_against,
)
from lslam.io.readers.point_times import Sample
from lslam.io.readers.sequence_on_disk import SequenceOnDisk, in_metres, settle_unit
from lslam.io.readers.sidecars import calibration_over, compensation_note, read_info, stated_times
from lslam.registration.preprocessing.views import FurtherLidar, MergedLidars

KIND = "bag"
_LAYOUTS = ("velodyne", "velodyne_points", "sequences")
_SAID_NS = 1000  # shorter shifts are what absolute seconds are rounded by
CAMERA = "cam0"
# Odometry in a bag is somebody's estimate, unless its name says that it is the truth.
_TRUTH = re.compile(r"(^|[/_])(ground_?truth|gt)([/_]|$)", re.IGNORECASE)


@dataclass(kw_only=True)
class BagSequence(SequenceOnDisk):
    """A recording in a bag.

    messages : (N,) int64, index of each scan's message in `topic`; headers_ns : (N,) int64, stamps of their headers
    uses : purpose of each topic in use; halves : further messages of a scan
    revolutions : set for packets, and then read in place of messages
    """

    bag: Bag
    topic: BagTopic
    messages: Longs
    headers_ns: Longs
    uses: dict[str, str] = field(default_factory=dict)
    halves: Halves = field(default_factory=dict)
    revolutions: Revolutions | None = None

    @property
    def recorded_ns(self) -> Longs:
        """Time of recording of each scan's message, (N,) ns."""
        return self.topic.stamps_ns[self.messages]

    def _read(self, index: int) -> Scan:
        """Read scan `index`, with point times by the recording's clock. Raises InputError if it is damaged."""
        if self.revolutions is not None:
            return read_scan(self.revolutions, index, not self.motion_compensated)
        stamp = int(self.headers_ns[index])
        cloud, shift = self.cloud(index)
        stamp += shift
        if self.clock is None:
            return Scan(cloud.points, stamp, index, cloud.intensity, None, cloud.rings, labels=cloud.labels)
        timed = self.clock.read(cloud, stamp)
        cloud, fault = timed.cloud, timed.fault
        stamp += timed.shift_ns
        off = points_off(self.clock, self.headers_ns, self.stamps_ns, index, stamp, timed.times)
        if off:
            what = f"the clock of its points is {off * 1e-9:+.3f} s off: the header counts"
            fault = f"{fault}; {what}" if fault else what
            stamp = int(self.stamps_ns[index])
        return Scan(cloud.points, stamp, index, cloud.intensity, timed.times, cloud.rings, fault, cloud.labels)

    def cloud(self, index: int) -> tuple[PointCloud, int]:
        """Points of scan `index` as its message holds them, and the offset of their time base from the header's stamp, ns."""
        k = int(self.messages[index])
        cloud, shift, _ = put_together(self.bag, self.topic, (k, *self.halves.get(k, ())))
        return in_metres(cloud, self.unit_m), shift

    def ahead(self, stamps: Longs, recording_ns: Longs, what: str) -> int:
        """Offset of the clock of another stream from that of the scans, ns, positive if ahead; see `ahead_of`."""
        if self.revolutions is not None:
            return 0
        voice = Voice(self.notes, self.problems)
        return ahead_of(self.headers_ns, self.recorded_ns, stamps, recording_ns, what, voice)

    def on_its_clock(self, stream: Stream, what: str) -> Stream:
        """Another stream with its stamps shifted to the clock of the scans."""
        return replace(stream, stamps_ns=stream.stamps_ns - self.ahead(stream.stamps_ns, stream.recorded_ns, what))


# One LiDAR of a bag: which messages, its scans, and what its packets tell where it has any.
_Lidar = tuple[ScanIndex, BagSequence, SpinningSensor | None]


def locate(path: Path) -> tuple[Path, str] | None:
    """Bag at or in `path`, and the reason why it is one. None when there is none, or when it lies in one of KITTI's layouts."""
    if path.is_dir() and any((path / name).is_dir() for name in _LAYOUTS):
        return None
    files = list_bag_files(path)
    if not files:
        return None
    if path.is_file():
        return path, f"{path.name} is a bag{_others(path)}"
    return path, f"it holds {len(files)} bag file{'s' if len(files) > 1 else ''}, {files[0].name} first"


def _others(path: Path) -> str:
    """Other parts of the recording of which `path` is one part."""
    names = [p.name for p in parts_beside(path)]
    if not names:
        return ""
    one, several = f"by its name {names[0]} is another part", f"by their names {first_of(names)} are other parts"
    return f"; {one if len(names) == 1 else several} of it: a folder of its parts is read as one"


def open_folder(path: Path, overrides: SequenceInfo, why: str) -> Sequence:
    """Open the bag file, or the folder of them, at `path`; several requested LiDARs are merged into one sequence.

    overrides : outrank `sequence.toml`; why : reason for this format, for the notes
    Raises InputError when it is unreadable, has no clouds, or lacks the extrinsics of a LiDAR to be merged, UsageError for
    topics that are ambiguous or do not exist.
    """
    bag = open_bag(path)
    info = _info(path, bag, overrides)
    voice = Voice([f"format {KIND}: {why}", *compensation_note(info), *bag.notes], list(bag.losses))
    lidars: list[_Lidar] = []
    for topic in choose_clouds(bag, info.lidar_topic, voice):
        check_parts(bag, topic)
        at = len(voice.notes)
        some = _lidars_of(bag, topic, info, voice, bool(lidars))
        frames = ", ".join(index.name for index, _, _ in some)
        voice.notes.insert(at, f"scans from {topic.name} ({topic.type}, {len(topic)} messages), frame {frames}")
        lidars += some
    (leading, sequence, spinning), frame = lidars[0], lidars[0][0].frame
    own = spinning if info.imu_topic is None else None
    imu = load_companion(bag, IMU, info.imu_topic, voice) if own is None or own.imu is None else None
    gnss = load_companion(bag, GNSS, info.gnss_topic, voice)
    if imu is not None:
        imu = sequence.on_its_clock(imu, "IMU")
        sequence.imu = ImuStream(imu.stamps_ns, imu.values[:, :3].copy(), imu.values[:, 3:].copy())
    if gnss is not None:
        gnss = sequence.on_its_clock(gnss, "GNSS")
        sequence.gnss = GnssStream(gnss.stamps_ns, gnss.values[:, :3].copy(), gnss.values[:, 3].copy())
    voice.problems += sequence.streams_apart()
    links = Links(bag, voice)
    sequence.calibration, sequence.has_assumed_extrinsics = find_extrinsics(links, frame, imu, gnss, info, voice)
    sequence.ground_truth = find_truth(sequence, links, frame, voice)
    sequence.open_cameras = partial(bag_cameras, bag, links, frame, sequence.ahead, info.cameras)
    if own is not None and own.imu is not None:
        if left_out := [t.name for t in bag.of_type("Imu")]:
            voice.notes.append(f"IMU from the sensor's packets: {', '.join(left_out)} left out; --imu-topic reads one")
        sequence.imu = own.imu
        sequence.calibration = calibration_over(info, replace(sequence.calibration, T_lidar_imu=own.T_lidar_imu))
    places = places_of([index for index, _, _ in lidars], links, info.lidars)
    sequence.uses = _uses(sequence, imu, gnss, links) | {index.topic.name: "scans" for index, _, _ in lidars}
    if not places:
        return sequence
    voice.notes.append(f"scans are the sweeps of {leading}, the leading one of {len(lidars)} LiDARs")
    others = []
    for (index, scans, turns), place in zip(lidars[1:], places, strict=True):
        if turns is None:
            ahead = sequence.ahead(scans.headers_ns, scans.recorded_ns, str(index))
            scans.headers_ns, scans.stamps_ns = scans.headers_ns - ahead, scans.stamps_ns - ahead
        others.append(FurtherLidar(str(index), scans, *place))
    return MergedLidars(sequence, others)


def _lidars_of(bag: Bag, topic: BagTopic, info: SequenceInfo, voice: Voice, has_leading: bool) -> list[_Lidar]:
    """The chosen LiDARs of a topic: index, scans and, for packets, sensor. `info` applies to the leading one only.

    has_leading : whether an earlier topic has the leading LiDAR
    """
    if can_decode(topic):
        turns, frame = open_packets(bag, topic, voice)
        stamps = turns.revolutions.stamps_ns
        ((name, _),) = choose_lidars(topic, [frame or NO_NAME], info.lidar_frame, voice)
        whole = ScanIndex(topic, name, frame, np.arange(len(stamps)), stamps, {})
        sources: list[tuple[ScanIndex, SpinningSensor | None]] = [(whole, turns)]
    else:
        sources = [(index, None) for index in index_scans(bag, topic, info.lidar_frame, voice)]
    lidars: list[_Lidar] = []
    for index, spinning in sources:
        if lidars or has_leading:
            info, voice = replace(info, rate_hz=None, rings=None, sensor=None), Voice([], [])
        lidars.append((index, _scans_of(bag, index, spinning, info, voice), spinning))
    return lidars


def _scans_of(
    bag: Bag, index: ScanIndex, spinning: SpinningSensor | None, info: SequenceInfo, voice: Voice
) -> BagSequence:
    """Scans of one LiDAR, from the packets `spinning` or from messages, without IMU and fixes."""
    sequence = BagSequence(
        name=info.name or printable(stem_of(bag.path)),
        path=bag.path,
        kind=KIND,
        bag=bag,
        topic=index.topic,
        messages=index.messages,
        headers_ns=index.stamps_ns,
        stamps_ns=index.stamps_ns,
        rate_hz=info.rate_hz or (spinning.rate_hz if spinning else measured_rate(index.stamps_ns)),
        motion_compensated=info.motion_compensated,
        rings=info.rings or (spinning.rings if spinning else None),
        sensor=info.sensor or (spinning.sensor if spinning else None),
        revolutions=spinning.revolutions if spinning else None,
        notes=voice.notes,
        problems=voice.problems,
        halves=index.halves,
        stated_times=stated_times(info),
        unit_m=LENGTHS.get(info.point_unit or ""),
        uses=dict(spinning.uses) if spinning else {},
    )
    if spinning is not None:
        return sequence
    settle_unit(sequence)
    ends = {
        read_header(index.topic, bag.message(index.topic, int(k), HEADER)).stamp_ns for k in index.messages[[0, -1]]
    }
    if len(sequence) > 1 and len(ends) == 1:
        # Better than the times of recording, where the headers stand still.
        points = point_stamps(range(len(sequence)), lambda k: sequence.cloud(k)[0], sequence.rate_hz)
        if points is not None:
            sequence.stamps_ns, note = onto_recording(points, index.stamps_ns)
            sequence.headers_ns = sequence.stamps_ns
            voice.notes.append(note)
    _open_clock(sequence, info)
    return sequence


def _uses(sequence: BagSequence, imu: Stream | None, gnss: Stream | None, links: Links) -> dict[str, str]:
    """Purpose of each topic, by its name."""
    uses = {INFO_TOPIC: "sequence.toml", **sequence.uses}
    for topic in sequence.bag.of_type("TFMessage"):
        if links.static if is_static(topic) else links.uses_tf:
            uses[topic.name] = "extrinsics"
    if sequence.ground_truth is not None:
        uses[truth_topics(sequence.bag)[0].name] = "ground truth"
    for what, stream in (("IMU", imu), ("GNSS", gnss)):
        if stream is not None:
            uses = {name: use for name, use in uses.items() if use != what} | {stream.topic: what}
    return uses


def _info(path: Path, bag: Bag, overrides: SequenceInfo) -> SequenceInfo:
    """Merged settings: those of the user, then of a `sequence.toml` beside the bag, then of the bag itself."""
    said, _ = read_info(path if path.is_dir() else path.parent, overrides)
    text = bag_streams.read_text(bag, INFO_TOPIC)
    return said if text is None else said.over(parse_sequence_toml(text, f"{path}, {INFO_TOPIC}"))


def _open_clock(sequence: BagSequence, info: SequenceInfo) -> None:
    """Learn the encoding of per-point times from a few scans, and move the stamps to the scans' starts."""

    def sample(index: int) -> Sample:
        cloud, shift = sequence.cloud(index)
        return Sample(cloud, int(sequence.headers_ns[index]) + shift)

    samples = read_samples(len(sequence), sample)
    sequence.clock = open_clock(list(samples.values()), sequence.rate_hz, info, sequence.notes, sequence.problems)
    if sequence.clock is None:
        if not info.motion_compensated and not any(sample.cloud.clocks for sample in samples.values()):
            sequence.notes.append(
                f"the points of {sequence.topic.name} have no times (looked for {', '.join(TIME_NAMES[:4])} and the like)"
            )
        return
    step = step_against(sequence.clock, samples.values())
    if step:
        sequence.problems.append(
            f"the absolute times of the points step by {step:.3f} s against the stamps of the headers: the headers count"
        )
    index = sequence.clock.first_whole(samples)
    first = sample(index)
    shift = first.stamp_ns + sequence.clock.read(first.cloud, first.stamp_ns).shift_ns - int(sequence.headers_ns[index])
    if shift:
        sequence.stamps_ns = sequence.headers_ns + shift
    if abs(shift) >= _SAID_NS:
        sequence.notes.append(
            f"stamps of the scans moved by {shift * 1e-9:.6f} s, to where their first points were measured"
        )


def find_extrinsics(
    links: Links, lidar: str, imu: Stream | None, gnss: Stream | None, info: SequenceInfo, voice: Voice
) -> tuple[Calibration, bool]:
    """Extrinsics by `info`, else by the bag's transforms, else the identity for the IMU, with a problem; and whether assumed.

    lidar : the frame of the scans
    """
    names = {name for pair in links.static for name in pair} - {lidar}
    frames = {name: T for name in sorted(names) if (T := chain(links.static, lidar, name)) is not None}
    calibration = calibration_over(info, Calibration(T_cam0_lidar=chain(links.static, CAMERA, lidar), frames=frames))
    T_lidar_imu, T_lidar_gnss = calibration.T_lidar_imu, calibration.T_lidar_gnss
    is_assumed = False
    if imu is not None and T_lidar_imu is None:
        T_lidar_imu = _find(links, lidar, imu.frame, "IMU", voice)
        if T_lidar_imu is None:
            voice.problems.append(
                f"extrinsics: {links.why_not(lidar, imu.frame)}, so the IMU is taken to sit in the LiDAR, axes alike; "
                "--extrinsics states T_lidar_imu"
            )
            T_lidar_imu, is_assumed = np.eye(4), True
    if gnss is not None and T_lidar_gnss is None:
        T_lidar_gnss = _find(links, lidar, gnss.frame, "GNSS", voice)
        if T_lidar_gnss is None:
            voice.notes.append(f"extrinsics: {links.why_not(lidar, gnss.frame)}: the place of the antenna is unknown")
    own = replace(calibration, T_lidar_imu=T_lidar_imu, T_lidar_gnss=T_lidar_gnss, frames={})
    return replace(
        own, frames={name: T for name, T in calibration.frames.items() if name not in own.poses_in_lidar()}
    ), is_assumed


def truth_topics(bag: Bag) -> list[BagTopic]:
    """Topics of poses whose name says ground truth; the first one counts."""
    return [t for t in bag.of_type("Odometry", "PoseStamped") if _TRUTH.search(t.name)]


def find_truth(sequence: BagSequence, links: Links, lidar: str, voice: Voice) -> Trajectory | None:
    """LiDAR poses from the first topic named as ground truth (Odometry or PoseStamped), None when there is none.

    Poses of a body without a static transform to the LiDAR are taken as the LiDAR's, with a problem.
    """
    bag = sequence.bag
    topics = truth_topics(bag)
    if not topics:
        return None
    topic = topics[0]
    if topics[1:]:
        others = ", ".join(t.name for t in topics[1:])
        voice.notes.append(f"ground truth from {topic.name}, the first of {len(topics)}: {others} left out")
    stream = read_poses(bag, topic, voice.problems)
    order, stamps = put_in_order(stream.stamps_ns, stream.recorded_ns, f"{topic.name}: poses", voice)
    if not len(order):
        return None
    stream = replace(stream, stamps_ns=stamps, values=stream.values[order], recorded_ns=stream.recorded_ns[order])
    stream = sequence.on_its_clock(stream, f"ground truth {topic.name}")
    stamps, poses, body = stream.stamps_ns, stream.values, stream.frame
    rigid = links.find(body, lidar)
    if rigid is None:
        voice.problems.append(
            f"ground truth {topic.name} holds poses of {body or 'an unnamed body'} and no static transform leads from there to "
            f"{lidar}: they are taken as LiDAR poses"
        )
    elif body != lidar:
        T_body_lidar, source = rigid
        poses = se3.normalise(portable.product(poses, T_body_lidar))
        voice.notes.append(
            f"ground truth {topic.name}: poses of {body}, carried to {lidar} with {source.removeprefix('from ')}"
        )
    return Trajectory(stamps, poses, "lidar", True, None, f"{bag.path}, {topic.name}")


def _find(links: Links, lidar: str, frame: str, what: str, voice: Voice) -> Floats | None:
    """`T_lidar_frame` (4, 4) by the bag's transforms, with a note; None without a chain of them."""
    T, source = (links.find(lidar, frame) if frame else None) or (None, "")
    if T is not None:
        voice.notes.append(f"extrinsics of the {what}: T_{lidar}_{frame}, {source}")
    return T
