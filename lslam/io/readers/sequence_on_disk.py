"""What the sequences of all readers have in common."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field
from pathlib import Path

from lslam.core.types.arrays import Longs
from lslam.core.types.gnss import GnssStream
from lslam.core.types.imu import ImuStream
from lslam.core.types.scan import Scan
from lslam.core.types.sequence import Calibration, Scans, StatedTimes, no_shared_time
from lslam.core.types.trajectory import Trajectory
from lslam.io.readers.point_clock import PointClock
from lslam.io.readers.point_times import TimeRule


@dataclass(kw_only=True)
class SequenceOnDisk(Scans):
    """A `Sequence`. See `lslam.core.types.sequence` for the attributes every sequence has.

    rings : number of beams, sensor : its name; None where nobody states them
    stated_times : what is stated about the times of points; has_assumed_extrinsics : nothing says where the IMU sits
    clock : how per-point times are read, None when there are none or they are not to be used
    unit_m : of coordinates, None where nobody states it
    """

    name: str
    path: Path
    kind: str
    stamps_ns: Longs
    rate_hz: float
    motion_compensated: bool | None = None
    calibration: Calibration = field(default_factory=Calibration)
    ground_truth: Trajectory | None = None
    imu: ImuStream | None = None
    gnss: GnssStream | None = None
    notes: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    stated_times: StatedTimes = field(default_factory=StatedTimes)
    rings: int | None = None
    sensor: str | None = None
    has_assumed_extrinsics: bool = False
    clock: PointClock | None = None
    unit_m: float | None = None

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def time_rule(self) -> TimeRule | None:
        """How per-point times are meant; None where `clock` is."""
        return None if self.clock is None else self.clock.rule

    def scan(self, index: int) -> Scan:
        """Read scan `index`; a file or message without points gives an empty scan.

        Raises InputError naming the file, or bag, topic and message, when it is damaged, IndexError beyond the end.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"scan {index} of {len(self)}")
        return self._read(index)

    def streams_apart(self) -> list[str]:
        """What is to be said of the IMU and of fixes that lie wholly before or after the scans."""
        own, streams = self.stamps_ns, {"IMU": self.imu, "GNSS": self.gnss}
        stamps = {name: stream.stamps_ns for name, stream in streams.items() if stream is not None}
        return [no_shared_time(name) for name, its in stamps.items() if its[0] > own[-1] or its[-1] < own[0]]

    @abstractmethod
    def _read(self, index: int) -> Scan:
        """Scan `index`, which there is."""
