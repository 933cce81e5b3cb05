"""Speeds of wheels that a run asks for: a topic of the bag, or a CSV file beside the scans."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.errors import InputError
from lslam.core.geometry import se3, so3
from lslam.core.types.imu import WheelStream
from lslam.core.types.sequence import Sequence
from lslam.io.formats.bag_files import Bag
from lslam.io.formats.bag_streams import read_twists
from lslam.io.formats.stamped_csv import read_wheels_csv
from lslam.io.readers.bag_topics import Companion, load_companion
from lslam.io.readers.ground_truth import Voice

BASE = "base_link"
WHEELS = Companion("wheels", "--wheels", "Odometry or TwistStamped", read_twists, "--wheels")
# Fewer readings tell no motion.
LEAST_READINGS = 2
# m/s, of what has mass, and rad/s of its parts a metre apart: beyond, and NaN, is no reading.
LIGHT_M_S = 299_792_458.0


def read_wheels(
    sequence: Sequence, source: str, frame: str, wheelbase_m: float | None, notes: list[str], problems: list[str]
) -> WheelStream:
    """The wheel speeds of `source`, on the clock of the scans, with the extrinsics of `frame` or of their own frame.

    source : topic of the bag, or CSV file. Raises InputError for a file that is missing or has no usable readings, and for
    readings that share no time with the scans; UsageError for a topic that does not exist.
    """
    bag = getattr(sequence, "bag", None)
    if isinstance(bag, Bag):
        wheels, own = _of_bag(sequence, bag, source, Voice(notes, problems))
    else:
        wheels, own = _of_file(sequence, source, wheelbase_m, notes), BASE
    finite = np.abs(wheels.speed) < LIGHT_M_S
    if wheels.yaw_rate is not None:
        finite &= np.abs(wheels.yaw_rate) < LIGHT_M_S
    ahead = np.append(True, wheels.stamps_ns[1:] > np.maximum.accumulate(wheels.stamps_ns)[:-1])
    used = finite & ahead
    if used.sum() < LEAST_READINGS:
        raise InputError(f"wheels: {source} has {len(wheels)} readings, {int(used.sum())} of them finite and in order")
    if not used.all():
        problems.append(
            f"wheels: {int((~used).sum())} of {len(used)} readings of {source} are not finite or go back in time"
        )
    stamps = wheels.stamps_ns[used]
    if stamps[0] > sequence.stamps_ns[-1] or stamps[-1] < sequence.stamps_ns[0]:
        raise InputError(
            f"wheels: {source} has readings from {1e-9 * stamps[0]:.3f} to {1e-9 * stamps[-1]:.3f} s and no scan lies there, "
            f"they are from {1e-9 * sequence.stamps_ns[0]:.3f} to {1e-9 * sequence.stamps_ns[-1]:.3f} s: is it of another drive?"
        )
    if frame:
        T: Floats | None = sequence.calibration.T_lidar(frame)
    else:
        T = sequence.calibration.poses_in_lidar().get(own)
        if T is None:
            notes.append(
                f"wheels: nothing says where {own or 'their frame'} sits: it is estimated; wheels.frame names one that is known"
            )
    yaw_rate = None if wheels.yaw_rate is None else wheels.yaw_rate[used]
    return WheelStream(stamps, wheels.speed[used], yaw_rate, T)


def _of_file(sequence: Sequence, source: str, wheelbase_m: float | None, notes: list[str]) -> WheelStream:
    """Wheel speeds of a CSV file beside the scans or at the path `source`; raises InputError without it."""
    folder = sequence.path if sequence.path.is_dir() else sequence.path.parent
    places = [folder / source, Path(source)]
    path = next((place for place in places if place.is_file()), None)
    if path is None:
        raise InputError(
            f"--wheels {source}: {sequence.path} is no bag and has no such file; name a CSV file with a column speed, in m/s"
        )
    return read_wheels_csv(path, wheelbase_m, notes)


def _of_bag(sequence: Sequence, bag: Bag, source: str, voice: Voice) -> tuple[WheelStream, str]:
    """Wheel speeds of the topic `source`, by its twists or else its poses, and their frame; raises InputError without any."""
    stream = load_companion(bag, WHEELS, source, voice)
    if stream is None:
        raise InputError(f"{bag.path}: {source} holds no speeds that can be used")
    on_its_clock = getattr(sequence, "on_its_clock", None)
    if on_its_clock is not None:
        stream = on_its_clock(stream, "wheels")
    speed, yaw_rate, place = stream.values[:, 0], stream.values[:, 1], stream.values[:, 2:]
    if len(place) > 1 and not speed.any() and not yaw_rate.any() and (np.ptp(place[:, :3], axis=0) > 0).any():
        voice.notes.append(f"wheels: {source} has empty twists, its poses tell the speeds")
        speed, yaw_rate = _speeds(stream.stamps_ns, place)
    return WheelStream(stream.stamps_ns, speed, yaw_rate), stream.frame


def _speeds(stamps_ns: Longs, place: Floats) -> tuple[Floats, Floats]:
    """(N,) m/s along x and rad/s about z of poses (N, 7) at increasing stamps, each from the pose before to the one after."""
    poses = se3.make(so3.from_quaternion(place[:, 3:]), place[:, :3])
    before, after = np.maximum(np.arange(len(poses)) - 1, 0), np.minimum(np.arange(len(poses)) + 1, len(poses) - 1)
    seconds = 1e-9 * (stamps_ns[after] - stamps_ns[before])
    twists = se3.log(se3.relative(poses[before], poses[after])) / seconds[:, None]
    return twists[:, 0], twists[:, 5]
