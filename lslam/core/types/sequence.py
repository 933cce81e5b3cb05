"""What every reader gives, one recorded sequence, and views of a part of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sized
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.errors import InputError, UsageError
from lslam.core.geometry import se3
from lslam.core.types.gnss import GnssStream
from lslam.core.types.imu import ImuStream
from lslam.core.types.scan import Scan
from lslam.core.types.trajectory import Trajectory

T = TypeVar("T", bound=Sized)
LIDAR_FRAME = "lidar"


@dataclass(frozen=True)
class Calibration:
    """Extrinsics as (4, 4) transforms; None where the recording does not say.

    T_cam0_lidar : KITTI's `Tr`; T_lidar_imu and T_lidar_gnss : IMU and antenna in the LiDAR frame
    frames : T_lidar_frame of further frames of the robot by name, for example `base_link`
    """

    T_cam0_lidar: Floats | None = None
    T_lidar_imu: Floats | None = None
    T_lidar_gnss: Floats | None = None
    frames: Mapping[str, Floats] = field(default_factory=dict)

    @property
    def extrinsics(self) -> dict[str, Floats | None]:
        """All transforms by their names."""
        own = {"T_cam0_lidar": self.T_cam0_lidar, "T_lidar_imu": self.T_lidar_imu, "T_lidar_gnss": self.T_lidar_gnss}
        return {**own, **{f"T_lidar_{frame}": T for frame, T in self.frames.items()}}

    def poses_in_lidar(self) -> dict[str, Floats]:
        """(4, 4) poses in the LiDAR frame of all frames with known extrinsics, by name."""
        T_cam0_lidar = self.T_cam0_lidar
        own = {
            LIDAR_FRAME: np.eye(4),
            "imu": self.T_lidar_imu,
            "gnss": self.T_lidar_gnss,
            "cam0": None if T_cam0_lidar is None else se3.inverse(T_cam0_lidar),
        }
        return {name: T for name, T in {**self.frames, **own}.items() if T is not None}

    def T_lidar(self, frame: str) -> Floats:
        """(4, 4) pose of `frame` in the LiDAR frame. Raises InputError naming the known frames."""
        known = self.poses_in_lidar()
        if frame not in known:
            raise InputError(
                f"nothing says where frame {frame} sits (known: {', '.join(sorted(known))}): state it below [frames] in "
                f"sequence.toml, {frame} = [T_lidar_{frame}, 12 numbers]"
            )
        return known[frame]


@dataclass(frozen=True)
class StatedTimes:
    """What the user or `sequence.toml` states about the times of points; None where nothing is.

    kind : field, columns, order, azimuth or none; reference : start or end, the instant of a sweep to which its stamp belongs
    """

    kind: str | None = None
    reference: str | None = None


def no_shared_time(stream: str) -> str:
    """The problem of a recording whose `stream`, IMU or GNSS, lies wholly before or after its scans."""
    return f"{stream}: it shares no time with the scans"


def readable(indices: Iterable[int], read: Callable[[int], T]) -> Iterator[tuple[int, T]]:
    """Each index with the result of `read`, except those that are unreadable (InputError) or empty."""
    for index in indices:
        try:
            value = read(index)
        except InputError:
            continue
        if len(value):
            yield index, value


class Scans(ABC):
    """`sequence[i]` and iteration, by `scan`; from the end below 0."""

    @abstractmethod
    def __len__(self) -> int:
        """Number of scans."""

    @abstractmethod
    def scan(self, index: int) -> Scan:
        """Read scan `index`."""

    def __getitem__(self, index: int) -> Scan:
        """As `scan`; IndexError beyond the last."""
        if not -len(self) <= index < len(self):
            raise IndexError(f"scan {index} of {len(self)}")
        return self.scan(index % len(self))


class Sequence(Protocol):
    """A recorded sequence, opened but not loaded: scans are read one at a time, from any thread.

    Attributes
    ----------
    name : short name for run folders, for example `seq07` or `2011_09_26_drive_0005_sync`
    path : where it lies
    kind : the format that was detected, for example `kitti-odometry`
    stamps_ns : (N,) int64, increasing
    rate_hz : nominal scan rate
    motion_compensated : True or False, None when unknown
    calibration : extrinsics that are known
    ground_truth : T_world_lidar at scan stamps or denser, None when unknown
    imu, gnss : streams, None when the recording has none
    notes : decisions the reader took, one sentence each, for the log and the manifest
    problems : what is wrong with the recording but does not stop a run, one sentence each
    """

    name: str
    path: Path
    kind: str
    stamps_ns: Longs
    rate_hz: float
    motion_compensated: bool | None
    calibration: Calibration
    ground_truth: Trajectory | None
    imu: ImuStream | None
    gnss: GnssStream | None
    notes: list[str]
    problems: list[str]

    def __len__(self) -> int:
        """Number of scans."""
        ...

    def scan(self, index: int) -> Scan:
        """Read scan `index`. Raises InputError naming the file when it cannot be read."""
        ...

    def __getitem__(self, index: int) -> Scan:
        """As `scan`; IndexError beyond the last, and from the end below 0."""
        ...


class SequenceView(Scans):
    """Delegates to `whole` whatever `own` does not replace; a subclass says which scans there are and what they hold."""

    def __init__(self, whole: Sequence, **own: Any) -> None:
        self.whole = whole
        vars(self).update(own)

    def __getattr__(self, name: str) -> Any:
        if name == "whole":  # a copy that is not filled in yet
            raise AttributeError(name)
        return getattr(self.whole, name)

    def __len__(self) -> int:
        return len(self.whole)

    def scan(self, index: int) -> Scan:
        """Read scan `index` of the whole sequence, with the errors of its `scan`."""
        return self.whole.scan(index)


class Selection(SequenceView):
    """Every `step`-th scan of a sequence; scans keep their index of the recording, all else is the sequence's own."""

    def __init__(self, whole: Sequence, indices: Longs) -> None:
        super().__init__(whole, stamps_ns=whole.stamps_ns[indices])
        self.indices = indices

    def __len__(self) -> int:
        return len(self.indices)

    def scan(self, index: int) -> Scan:
        """Read the `index`-th scan of the selection; its own `index` counts in the whole recording."""
        if not 0 <= index < len(self.indices):
            raise IndexError(f"scan {index} of {len(self.indices)}")
        return self.whole.scan(int(self.indices[index]))


def select(sequence: Sequence, start: int = 0, count: int | None = None, skip_frames: int = 1) -> Sequence:
    """Scans `start`, `start + skip_frames`, ..., at most `count` of them; the sequence itself when that is all.

    `rate_hz` stays the recording's. Raises UsageError when nothing is left or a number is out of range.
    """
    if start < 0 or skip_frames < 1 or (count is not None and count < 1):
        raise UsageError(
            f"--start {start} --count {count} --skip-frames {skip_frames}: start from 0, the others from 1"
        )
    if start >= len(sequence):
        raise UsageError(f"--start {start} is beyond the last scan of {sequence.name}, which has {len(sequence)} scans")
    indices = np.arange(start, len(sequence), skip_frames, dtype=np.int64)[:count]
    if len(indices) == len(sequence):
        return sequence
    return Selection(sequence, indices)
