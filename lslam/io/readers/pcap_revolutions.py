"""What the packets of a sensor give, of a capture or a bag: revolutions with their stamps, and what is known of the sensor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lslam.core.types.imu import ImuStream
from lslam.core.types.scan import Scan
from lslam.io.formats.point_cloud import PointCloud
from lslam.io.readers.ground_truth import Voice

Integers = NDArray[np.int64]
# Shares of a revolution: less is no scan, and so much is one where it is the only one.
SLIVER, ALONE = 0.1, 0.9


class Packets(Protocol):
    """Packets that lie somewhere; of what they hold only that is read which is asked for. See `lslam.io.formats.pcap_files`."""

    @property
    def stamps_ns(self) -> Integers:
        """(N,) when each arrived."""

    @property
    def sizes(self) -> Integers:
        """(N,) bytes."""

    @property
    def sources(self) -> Integers:
        """(N,) whose they are."""

    def __len__(self) -> int:
        """Number of packets."""

    def bytes_at(self, which: Integers, positions: tuple[int, ...]) -> NDArray[np.uint8]:
        """(K, P) the bytes at `positions` of the packets `which`, which are so long."""

    def payloads(self, which: Integers) -> NDArray[np.uint8]:
        """(K, size) the packets `which`, which are of one size."""


class Revolutions(Protocol):
    """The revolutions of a capture."""

    @property
    def stamps_ns(self) -> Integers:
        """(N,) when the first point of each was measured."""

    def read(self, index: int) -> tuple[PointCloud, Integers]:
        """Points of revolution `index` in the order they were measured, and when each was, ns."""


@dataclass(frozen=True)
class Opened:
    """Revolutions and their sensor; `uses` says what further topics of a bag are used for."""

    revolutions: Revolutions
    rate_hz: float
    rings: int
    sensor: str
    imu: ImuStream | None = None
    T_lidar_imu: NDArray[np.float64] | None = None
    uses: Mapping[str, str] = field(default_factory=dict)


def read_scan(revolutions: Revolutions, index: int, is_timed: bool) -> Scan:
    """Revolution `index` as a scan, with the times of its points unless they are not to be used."""
    cloud, times_ns = revolutions.read(index)
    stamp = int(revolutions.stamps_ns[index])
    times = ((times_ns - stamp) * 1e-9).astype(np.float32) if is_timed else None
    return Scan(cloud.points, stamp, index, cloud.intensity, times, cloud.rings)


def of_one_sender(datagrams: Packets, which: Integers, what: str, voice: Voice) -> Integers:
    """Those of the datagrams `which` that come from the sender of most; others are named among the problems."""
    senders, counts = np.unique(datagrams.sources[which], return_counts=True)
    if len(senders) < 2:
        return which
    chosen = int(senders[np.argmax(counts)])
    others = ", ".join(_address(int(sender)) for sender in senders if sender != chosen)
    voice.problems.append(f"{what} of {len(senders)} senders: those of {_address(chosen)} are read, not of {others}")
    return np.asarray(which[datagrams.sources[which] == chosen], np.int64)


def no_slivers(shares: NDArray[np.floating[Any]], voice: Voice) -> NDArray[np.bool_]:
    """Which revolutions are scans, by the share of its packets that each has.

    Where revolutions are missing, a packet or two of the one before are kept with the next: that is no scan.
    """
    keep = shares >= SLIVER
    if keep.all() or not keep.any():
        return np.ones(len(shares), np.bool_)
    voice.problems.append(
        f"revolutions are missing: {int((~keep).sum())} of which less than {SLIVER:.0%} was captured are left out"
    )
    return keep


def in_order(times_ns: Integers, what: str, voice: Voice) -> Integers:
    """Order of packets by their own times, each time once; said where it is not that of the capture."""
    order = np.argsort(times_ns, kind="stable")
    if late := int((np.diff(times_ns) < 0).sum()):
        voice.problems.append(f"{what} are out of order in {late} places: sorted by their own times")
    ordered = times_ns[order]
    repeated = np.diff(ordered, prepend=ordered[:1] - 1) == 0
    if repeated.any():
        voice.problems.append(f"{what} repeat a time {int(repeated.sum())} times: the first one of each counts")
    return np.asarray(order[~repeated], np.int64)


def metadata_beside(path: Path) -> Sequence[Path]:
    """JSON files that may say how the packets of the capture are laid out: of its name, else all of its folder."""
    own = [p for p in (path.with_suffix(".json"), path.with_name(path.stem + "_0.json")) if p.is_file()]
    return own[:1] or sorted(p for p in path.parent.glob("*.json") if p.is_file())


def _address(source: int) -> str:
    return ".".join(str(source >> shift & 255) for shift in (40, 32, 24, 16)) + f":{source & 0xFFFF}"
