"""Sequences in memory, made of the sample's scans, whose scans a test may replace or make fail."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.errors import InputError
from lslam.core.types.gnss import GnssStream
from lslam.core.types.imu import ImuStream
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.sequence import Calibration, Sequence, StatedTimes
from lslam.core.types.trajectory import Trajectory
from lslam.io.readers import open_sequence
from lslam.odometry.base import Traits
from lslam.odometry.frontend.segments import TrackedScan
from lslam.odometry.frontend.tracker import ScanInput
from lslam.odometry.frontend.windows import WindowTracker

SAMPLE = Path(__file__).resolve().parents[1] / "sample_data"


@dataclass
class Stub:
    """A `Sequence` over a list; an entry that is a sentence is a scan that cannot be read."""

    scans: list[Scan | str]
    ground_truth: Trajectory | None = None
    calibration: Calibration = field(default_factory=Calibration)
    name: str = "stub"
    path: Path = Path("stub")
    kind: str = "stub"
    rate_hz: float = 10.0
    motion_compensated: bool | None = True
    stated_times: StatedTimes = field(default_factory=StatedTimes)
    imu: ImuStream | None = None
    gnss: GnssStream | None = None
    notes: list[str] = field(default_factory=lambda: ["a note of the reader"])
    problems: list[str] = field(default_factory=list)
    reads: list[int] = field(default_factory=list)
    on_read: Callable[[int], None] = lambda index: None

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        return np.arange(len(self.scans), dtype=np.int64) * 100_000_000

    @stamps_ns.setter
    def stamps_ns(self, value: NDArray[np.int64]) -> None:
        raise AttributeError(value)

    def __len__(self) -> int:
        return len(self.scans)

    def scan(self, index: int) -> Scan:
        self.reads.append(index)
        self.on_read(index)
        entry = self.scans[index]
        if isinstance(entry, str):
            raise InputError(entry)
        return entry


def decided_by(windows: WindowTracker, loaded: Iterable[ScanInput | None]) -> Iterator[list[TrackedScan]]:
    """The scans that are decided with each of the next ones, None at the end of the recording."""
    for one in loaded:
        windows.open(one)
        yield windows.decide(one, None if one is None else windows.present.track(one))


def sample(count: int, start: int = 0) -> Stub:
    """The first scans of sample_data with their ground truth."""
    whole = open_sequence(SAMPLE)
    scans: list[Scan | str] = [replace(whole.scan(start + i), index=i, stamp_ns=i * 100_000_000) for i in range(count)]
    truth = whole.ground_truth
    assert truth is not None
    poses = np.linalg.inv(truth.poses[start]) @ truth.poses[start : start + count]
    stamps = np.arange(count, dtype=np.int64) * 100_000_000
    return Stub(scans, Trajectory(stamps, poses, source="truth"), whole.calibration)


def with_points(stub: Stub, index: int, points: NDArray[np.float32]) -> Stub:
    """The sequence with other points in one scan."""
    scans = list(stub.scans)
    scans[index] = Scan(points.astype(np.float32), index * 100_000_000, index)
    return replace(stub, scans=scans)


def noise(seed: int, count: int = 5000) -> NDArray[np.float32]:
    """Points all over the place, (count, 3): no surface anywhere."""
    return np.random.default_rng(seed).uniform(-30, 30, (count, 3)).astype(np.float32)


class StampedInTheMiddle:
    """The same scans stamped half a sweep of 0.1 s later, with times about that."""

    LATER_NS = 50_000_000

    def __init__(self, sequence: Sequence) -> None:
        self.sequence = sequence

    def __getattr__(self, name: str) -> Any:
        return getattr(self.sequence, name)

    def __len__(self) -> int:
        return len(self.sequence)

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        return self.sequence.stamps_ns + self.LATER_NS

    def scan(self, index: int) -> Scan:
        scan = self.sequence.scan(index)
        assert scan.times is not None
        return replace(
            scan, stamp_ns=scan.stamp_ns + self.LATER_NS, times=scan.times - np.float32(1e-9 * self.LATER_NS)
        )


class StampedAtTheEnd(StampedInTheMiddle):
    """The same scans stamped where their sweeps end."""

    LATER_NS = 100_000_000


class Standstill(Traits):
    """An odometry that registers nothing and says it did: the sentinel every accuracy gate must catch."""

    def prepare(self, scan: Scan) -> None:
        return None

    def register(self, scan: Scan, prepared: None, prior: object) -> ScanResult:
        return ScanResult(scan.index, scan.stamp_ns, np.eye(4))

    def warm_up(self) -> None:
        return None
