"""Revolutions of an Ouster sensor: the packets of one frame number, laid out as the metadata beside the capture say."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lslam.core.errors import InputError
from lslam.core.geometry import se3
from lslam.core.types.imu import ImuStream
from lslam.io.formats.ouster_packets import IMU_SIZE, OusterSensor, frames_and_times, imu_of, points_of, read_metadata
from lslam.io.formats.point_cloud import PointCloud
from lslam.io.readers.ground_truth import Voice
from lslam.io.readers.pcap_revolutions import (
    Integers,
    Opened,
    Packets,
    in_order,
    metadata_beside,
    no_slivers,
    of_one_sender,
)

_UNIX_NS = 10**18  # a clock that tells less was never told the time


@dataclass(frozen=True)
class OusterRevolutions:
    """Satisfies `Revolutions`.

    packets : (P,) datagrams in order; first, count : (N,) which of them are a revolution
    shift_ns : from the sensor's clock to that of the stamps
    """

    datagrams: Packets
    sensor: OusterSensor
    packets: Integers
    first: Integers
    count: Integers
    stamps_ns: Integers
    shift_ns: int

    def read(self, index: int) -> tuple[PointCloud, Integers]:
        """Points of revolution `index` in the order they were measured, and when each was, ns."""
        first = int(self.first[index])
        packets = self.datagrams.payloads(self.packets[first : first + int(self.count[index])])
        cloud, times = points_of(packets, self.sensor)
        return cloud, times + self.shift_ns


def open_ouster(path: Path, datagrams: Packets, voice: Voice) -> Opened:
    """Raises InputError without metadata, and when no packet of the capture is laid out as they say."""
    beside = metadata_beside(path)
    if len(beside) != 1:
        there = "there is no *.json beside it" if not beside else f"{len(beside)} *.json lie beside it"
        raise InputError(
            f"{path} holds no packets of a Velodyne sensor, and for one of Ouster {there}: put its metadata at "
            f"{path.with_suffix('.json').name} there"
        )
    return open_with_metadata(path, datagrams, read_metadata(beside[0]), beside[0].name, voice)


def open_with_metadata(path: Path, datagrams: Packets, sensor: OusterSensor, metadata: str, voice: Voice) -> Opened:
    """As `open_ouster`, by metadata that were read from what is called `metadata`."""
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
    return Opened(revolutions, sensor.rate_hz, sensor.beams, sensor.name, imu, T_lidar_imu)


def _shift(times_ns: Integers, captured_ns: Integers, voice: Voice) -> int:
    """What makes Unix time of a clock that counts from when the sensor was switched on: the fastest packet tells."""
    if times_ns[0] >= _UNIX_NS:
        return 0
    shift = int((captured_ns - times_ns).min())
    voice.notes.append("the sensor's clock was never told the time: its zero is taken from the times of the capture")
    return shift


def _whole(count: Integers, voice: Voice) -> Integers:
    """Which frames are scans: where a capture begins or ends within a revolution, that one is not."""
    keep = np.ones(len(count), bool)
    if len(count) > 2:
        keep[[0, -1]] = count[[0, -1]] == count.max()
    if not keep.all():
        voice.notes.append(f"{int((~keep).sum())} revolutions at the ends of the capture are not whole and no scans")
    return np.flatnonzero(keep)


def _imu(datagrams: Packets, shift_ns: int, voice: Voice) -> ImuStream | None:
    which = np.flatnonzero(datagrams.sizes == IMU_SIZE)
    which = of_one_sender(datagrams, which, "IMU packets", voice)
    if not len(which):
        return None
    imu = imu_of(datagrams.payloads(which))
    order = in_order(imu.stamps_ns, "IMU packets", voice)
    voice.notes.append(f"IMU of the sensor, {len(order)} samples")
    return replace(imu, stamps_ns=imu.stamps_ns[order] + shift_ns, accel=imu.accel[order], gyro=imu.gyro[order])
