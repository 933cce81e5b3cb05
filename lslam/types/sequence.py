"""What every reader gives: one recorded sequence."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sized
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError
from lslam.types.gnss import GnssStream
from lslam.types.imu import ImuStream
from lslam.types.scan import Scan
from lslam.types.trajectory import Trajectory

T = TypeVar("T", bound=Sized)


@dataclass(frozen=True)
class Calibration:
    """Extrinsics as (4, 4) transforms; None where the recording does not say.

    T_cam0_lidar : KITTI's `Tr`; T_lidar_imu and T_lidar_gnss : IMU and antenna in the LiDAR frame
    """

    T_cam0_lidar: NDArray[np.float64] | None = None
    T_lidar_imu: NDArray[np.float64] | None = None
    T_lidar_gnss: NDArray[np.float64] | None = None


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
    """What `read` makes of each index, where it can be read and has points."""
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
    stamps_ns: NDArray[np.int64]
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
