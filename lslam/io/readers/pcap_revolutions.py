"""Packets of a sensor, from a capture or a bag, split into revolutions with their stamps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Bools, Floats, Longs
from lslam.core.errors import InputError
from lslam.core.geometry import se3
from lslam.core.types.imu import ImuStream
from lslam.core.types.scan import Scan
from lslam.io.formats.ouster_packets import IMU_SIZE, OusterSensor, frames_and_times, imu_of, read_metadata
from lslam.io.formats.ouster_packets import points_of as ouster_points
from lslam.io.formats.point_cloud import PointCloud
from lslam.io.formats.velodyne_packets import (
    BLOCKS,
    DUAL,
    FLAG,
    HOUR_US,
    MODELS,
    RETURNS,
    SIZE,
    TURN,
    Blocks,
    VelodyneModel,
    points_of,
    split_blocks,
)
from lslam.io.readers.ground_truth import Voice

# Shares of a revolution: less is no scan, and so much is one where it is the only one.
SLIVER, ALONE = 0.1, 0.9
_HOUR_NS = HOUR_US * 1000
_SAID_NS = 10**9  # clocks that are nearer are the same clock, and the way of a packet
_UNIX_NS = 10**18  # a clock that tells less was never told the time


class Packets(Protocol):
    """Source of packets; only the requested bytes are read. See `lslam.io.formats.pcap_files`."""

    @property
    def stamps_ns(self) -> Longs:
        """(N,) ns, time of arrival of each."""

    @property
    def sizes(self) -> Longs:
        """(N,) size of each, bytes."""

    @property
    def sources(self) -> Longs:
        """(N,) sender of each, as a number."""

    def __len__(self) -> int:
        """Number of packets."""

    def bytes_at(self, which: Longs, positions: tuple[int, ...]) -> NDArray[np.uint8]:
        """(K, P) bytes at `positions` of the packets `which`, which must be long enough."""

    def payloads(self, which: Longs) -> NDArray[np.uint8]:
        """(K, size) payloads of the packets `which`, which must be of one size."""


class Revolutions(Protocol):
    """The revolutions of a capture."""

    @property
    def stamps_ns(self) -> Longs:
        """(N,) ns, time of the first point of each."""

    def read(self, index: int) -> tuple[PointCloud, Longs]:
        """Points of revolution `index` in the order they were measured, and the time of each, ns, on the clock of `stamps_ns`."""


@dataclass(frozen=True)
class SpinningSensor:
    """Revolutions and facts about their sensor; `uses` : purpose of further topics of a bag."""

    revolutions: Revolutions
    rate_hz: float
    rings: int
    sensor: str
    imu: ImuStream | None = None
    T_lidar_imu: Floats | None = None
    uses: Mapping[str, str] = field(default_factory=dict)


def read_scan(revolutions: Revolutions, index: int, with_times: bool) -> Scan:
    """Revolution `index` as a scan, with the times of its points if they are to be used."""
    cloud, times_ns = revolutions.read(index)
    stamp = int(revolutions.stamps_ns[index])
    times = ((times_ns - stamp) * 1e-9).astype(np.float32) if with_times else None
    return Scan(cloud.points, stamp, index, cloud.intensity, times, cloud.rings)


def of_one_sender(datagrams: Packets, which: Longs, what: str, voice: Voice) -> Longs:
    """Datagrams, among `which`, of the sender that has most of them; other senders are named in the problems."""
    senders, counts = np.unique(datagrams.sources[which], return_counts=True)
    if len(senders) < 2:
        return which
    chosen = int(senders[np.argmax(counts)])
    others = ", ".join(_address(int(sender)) for sender in senders if sender != chosen)
    voice.problems.append(f"{what} of {len(senders)} senders: those of {_address(chosen)} are read, not of {others}")
    return np.asarray(which[datagrams.sources[which] == chosen], np.int64)


def no_slivers(shares: NDArray[np.floating[Any]], voice: Voice) -> Bools:
    """(N,) whether a revolution is a scan, by its share of the usual number of packets; all are if none has enough."""
    keep = shares >= SLIVER
    if keep.all() or not keep.any():
        return np.ones(len(shares), np.bool_)
    voice.problems.append(
        f"revolutions are missing: {int((~keep).sum())} of which less than {SLIVER:.0%} was captured are left out"
    )
    return keep


def in_order(times_ns: Longs, what: str, voice: Voice) -> Longs:
    """Order of packets by their own times, without duplicates; a note is added if it is not that of the capture."""
    order = np.argsort(times_ns, kind="stable")
    if late := int((np.diff(times_ns) < 0).sum()):
        voice.problems.append(f"{what} are out of order in {late} places: sorted by their own times")
    ordered = times_ns[order]
    repeated = np.diff(ordered, prepend=ordered[:1] - 1) == 0
    if repeated.any():
        voice.problems.append(f"{what} repeat a time {int(repeated.sum())} times: the first one of each counts")
    return np.asarray(order[~repeated], np.int64)


def metadata_beside(path: Path) -> Sequence[Path]:
    """JSON files that may be the metadata of the capture: of its name, else all of its folder."""
    own = [p for p in (path.with_suffix(".json"), path.with_name(path.stem + "_0.json")) if p.is_file()]
    return own[:1] or sorted(p for p in path.parent.glob("*.json") if p.is_file())


def _address(source: int) -> str:
    """A sender's number as text: IPv4 address and port."""
    return ".".join(str(source >> shift & 255) for shift in (40, 32, 24, 16)) + f":{source & 0xFFFF}"


@dataclass(frozen=True)
class VelodyneRevolutions:
    """Revolutions of a Velodyne sensor; satisfies `Revolutions`.

    began : azimuth of the first block, 0.01 deg
    packets : (P,) datagrams in order; azimuth : (P,) of their first blocks from `began`, unwrapped; times_ns : (P,)
    turns : (N,) which revolutions have points
    """

    datagrams: Packets
    model: VelodyneModel
    began: int
    packets: Longs
    azimuth: Longs
    times_ns: Longs
    turns: Longs

    @cached_property
    def stamps_ns(self) -> Longs:
        """(N,) ns, time of the first block of each revolution."""
        return np.array([self._stamp(turn) for turn in self.turns.tolist()], np.int64)

    def read(self, index: int) -> tuple[PointCloud, Longs]:
        """Points of revolution `index` in the order they were measured, and the time of each, ns, on the clock of `stamps_ns`."""
        turn = int(self.turns[index])
        # One packet more: the azimuth of the next block tells how far the last one turns.
        blocks = self._blocks(self._begin(turn), int(np.searchsorted(self.azimuth, (turn + 1) * TURN)) + 1)
        return points_of(blocks, blocks.azimuth // TURN == turn, self.began, self.model)

    def _stamp(self, turn: int) -> int:
        """Time, ns, of the first block of revolution number `turn`."""
        begin = self._begin(turn)
        blocks = self._blocks(begin, begin + 2)
        times_ns = blocks.times_ns[blocks.azimuth >= turn * TURN]
        return int(times_ns[0] if len(times_ns) else self.times_ns[begin:][:2][-1])

    def _begin(self, turn: int) -> int:
        """Index of the packet in which revolution number `turn` begins."""
        return max(int(np.searchsorted(self.azimuth, turn * TURN, "right")) - 1, 0)

    def _blocks(self, begin: int, end: int) -> Blocks:
        """Blocks of the packets from `begin` to before `end`."""
        packets = self.datagrams.payloads(self.packets[begin:end])
        return split_blocks(packets, self.azimuth[begin:end], self.times_ns[begin:end], self.model)


def open_velodyne(path: Path, datagrams: Packets, voice: Voice) -> SpinningSensor:
    """Open the packets of a Velodyne sensor. Raises InputError for an unknown model, and for less than one revolution."""
    which = np.flatnonzero(datagrams.sizes == SIZE)
    which = which[(datagrams.bytes_at(which, (0, 1)) == FLAG).all(axis=1)]
    if not len(which):
        raise InputError(f"{path} holds no packets of {SIZE} bytes that begin as Velodyne's do")
    which = of_one_sender(datagrams, which, "Velodyne packets", voice)
    model, mode = _factory(path, datagrams, which)
    raw = datagrams.bytes_at(which, (1200, 1201, 1202, 1203)).astype(np.int64)
    times = _absolute(raw @ (1 << np.array([0, 8, 16, 24])), datagrams.stamps_ns[which], voice)
    order = in_order(times, "Velodyne packets", voice)
    which, times = which[order], times[order]
    angle = datagrams.bytes_at(which, (2, 3)).astype(np.int64) @ (1 << np.array([0, 8]))
    azimuth, rate = _unwrap(path, angle, times)
    per_packet = BLOCKS // 2 if mode == DUAL else BLOCKS
    end = int(azimuth[-1]) + round(rate * model.block_ns * per_packet)
    turns, counts = np.unique(azimuth // TURN, return_counts=True)
    # The last block reaches to where the next one would begin, give or take its rounding.
    is_whole = turns < (end + round(rate * model.block_ns)) // TURN
    if not is_whole.any() and end < ALONE * TURN:
        raise InputError(f"{path} holds {end / TURN:.2f} of a revolution of the {model.name}: one is needed")
    if not is_whole.any():
        voice.notes.append(f"the capture holds {end / TURN:.2f} of one revolution: it is the only scan")
        is_whole[0] = True
    elif end % TURN > TURN // 100:
        voice.notes.append(f"the last {end % TURN / TURN:.2f} of a revolution are no scan")
    turns = turns[is_whole][no_slivers(counts[is_whole] * (rate * model.block_ns * per_packet / TURN), voice)]
    revolutions = VelodyneRevolutions(datagrams, model, int(angle[0]), which, azimuth, times, turns)
    voice.notes.append(
        f"{len(which)} packets of a {model.name}, {RETURNS[mode]} return{' read: the last' if mode == DUAL else ''}; scans are "
        f"cut at the azimuth of {angle[0] * 0.01:.2f} deg"
    )
    return SpinningSensor(revolutions, round(rate * 1e9 / TURN, 3), model.lasers, model.name)


def _factory(path: Path, datagrams: Packets, which: Longs) -> tuple[VelodyneModel, int]:
    """Model and return mode of Velodyne packets, by their last two bytes; raises InputError for unknown ones."""
    mode, number = (int(v) for v in datagrams.bytes_at(which[:1], (1204, 1205))[0])
    if mode not in RETURNS or number not in MODELS:
        known = ", ".join(model.name for model in MODELS.values())
        raise InputError(
            f"{path}: its Velodyne packets end in {mode:#04x} {number:#04x}, which is no return mode and model that is known; "
            f"{known} are; of others the driver makes PointCloud2"
        )
    return MODELS[number], mode


# A packet that comes a day after the one before belongs to another capture.
_LONGEST_NS = 86_400 * 10**9


def _absolute(past_hour_us: Longs, captured_ns: Longs, voice: Voice) -> Longs:
    """Packet times, ns: the hour of the capture's clock and the microseconds past the hour of the sensor's clock.

    A sensor without satellite time counts from another minute. That offset is taken from the first packet.
    """
    within = past_hour_us * 1000
    apart = int((within[0] - captured_ns[0] + _HOUR_NS // 2) % _HOUR_NS - _HOUR_NS // 2)
    hours = np.round((captured_ns + apart - within) / _HOUR_NS).astype(np.int64)
    if abs(apart) >= _SAID_NS:
        voice.notes.append(f"the sensor's clock is {apart * 1e-9:+.3f} s from the capture's: it is kept")
    return within + hours * _HOUR_NS


def _unwrap(path: Path, angle: Longs, times_ns: Longs) -> tuple[Longs, float]:
    """Azimuths unwrapped, 0.01 deg from the first, and the rate of rotation, 0.01 deg/ns.

    angle : (P,) 0.01 deg of each packet. Raises InputError if the times leap or the sensor does not turn.
    """
    steps, spans = np.diff(angle) % TURN, np.diff(times_ns)
    if len(spans) and float(np.abs(spans.astype(np.float64)).max()) > _LONGEST_NS:
        raise InputError(f"{path}: the times of its packets leap by days: the capture is damaged")
    rate = float(np.median(steps / spans)) if len(steps) else 0.0
    if rate <= 0:
        raise InputError(f"{path}: the sensor does not turn in its {len(angle)} packets")
    turned = np.round((rate * spans - steps) / TURN).astype(np.int64)
    azimuth = np.concatenate([[0], np.cumsum(np.maximum(steps + TURN * turned, 0))])
    # Over the whole of the capture the rounding of azimuths does not count.
    return azimuth, float(azimuth[-1] / (times_ns[-1] - times_ns[0]))


@dataclass(frozen=True)
class OusterRevolutions:
    """Revolutions of an Ouster sensor; satisfies `Revolutions`.

    packets : (P,) datagrams in order; first, count : (N,) which of them are a revolution
    shift_ns : from the sensor's clock to that of the stamps
    """

    datagrams: Packets
    sensor: OusterSensor
    packets: Longs
    first: Longs
    count: Longs
    stamps_ns: Longs
    shift_ns: int

    def read(self, index: int) -> tuple[PointCloud, Longs]:
        """Points of revolution `index` in the order they were measured, and the time of each, ns, on the clock of `stamps_ns`."""
        first = int(self.first[index])
        packets = self.datagrams.payloads(self.packets[first : first + int(self.count[index])])
        cloud, times = ouster_points(packets, self.sensor)
        return cloud, times + self.shift_ns


def open_ouster(path: Path, datagrams: Packets, voice: Voice) -> SpinningSensor:
    """Open the packets of an Ouster sensor. Raises InputError without metadata, or when no packet fits them."""
    beside = metadata_beside(path)
    if len(beside) != 1:
        there = "there is no *.json beside it" if not beside else f"{len(beside)} *.json lie beside it"
        raise InputError(
            f"{path} holds no packets of a Velodyne sensor, and for one of Ouster {there}: put its metadata at "
            f"{path.with_suffix('.json').name} there"
        )
    return open_with_metadata(path, datagrams, read_metadata(beside[0]), beside[0].name, voice)


def open_with_metadata(
    path: Path, datagrams: Packets, sensor: OusterSensor, metadata: str, voice: Voice
) -> SpinningSensor:
    """Open Ouster packets like `open_ouster`, with metadata already read; `metadata` names their source. Raises InputError."""
    which = np.flatnonzero(datagrams.sizes == sensor.packet_bytes)
    if not len(which):
        sizes, counts = np.unique(datagrams.sizes, return_counts=True)
        raise InputError(
            f"{path} holds no LiDAR packets of {sensor.packet_bytes} bytes, as {metadata} has them; most of its "
            f"{len(datagrams)} datagrams have {sizes[np.argmax(counts)]}"
        )
    which = of_one_sender(datagrams, which, "LiDAR packets", voice)
    frames, times = frames_and_times(datagrams.bytes_at(which, sensor.profile.positions))
    order = in_order(times, "LiDAR packets", voice)
    which, frames, times = which[order], frames[order], times[order]
    shift = _shift(times, datagrams.stamps_ns[which], voice)
    first = np.flatnonzero(np.concatenate([[True], np.diff(frames) != 0]))
    count = np.diff(np.concatenate([first, [len(frames)]])).astype(np.int64)
    whole = _whole(count, voice)
    whole = whole[no_slivers(count[whole] / count.max(), voice)]
    first, count = first[whole], count[whole]
    voice.notes.append(f"{len(which)} packets of an {sensor.name} with {sensor.beams} beams, metadata from {metadata}")
    revolutions = OusterRevolutions(datagrams, sensor, which, first, count, times[first] + shift, shift)
    imu = _imu(datagrams, shift, voice)
    T_lidar_imu = None if imu is None else se3.normalise(sensor.T_sensor_imu)
    return SpinningSensor(revolutions, sensor.rate_hz, sensor.beams, sensor.name, imu, T_lidar_imu)


def _shift(times_ns: Longs, captured_ns: Longs, voice: Voice) -> int:
    """Offset from the sensor's clock since power-up to Unix time, ns, by the packet with the least delay."""
    if times_ns[0] >= _UNIX_NS:
        return 0
    shift = int((captured_ns - times_ns).min())
    voice.notes.append("the sensor's clock was never told the time: its zero is taken from the times of the capture")
    return shift


def _whole(count: Longs, voice: Voice) -> Longs:
    """Indices of complete frames by their numbers of packets; the first and the last may be cut off by the capture."""
    keep = np.ones(len(count), bool)
    if len(count) > 2:
        keep[[0, -1]] = count[[0, -1]] == count.max()
    if not keep.all():
        voice.notes.append(f"{int((~keep).sum())} revolutions at the ends of the capture are not whole and no scans")
    return np.flatnonzero(keep)


def _imu(datagrams: Packets, shift_ns: int, voice: Voice) -> ImuStream | None:
    """IMU samples of an Ouster sensor, with stamps shifted by `shift_ns`; None without IMU packets."""
    which = np.flatnonzero(datagrams.sizes == IMU_SIZE)
    which = of_one_sender(datagrams, which, "IMU packets", voice)
    if not len(which):
        return None
    imu = imu_of(datagrams.payloads(which))
    order = in_order(imu.stamps_ns, "IMU packets", voice)
    voice.notes.append(f"IMU of the sensor, {len(order)} samples")
    return replace(imu, stamps_ns=imu.stamps_ns[order] + shift_ns, accel=imu.accel[order], gyro=imu.gyro[order])
