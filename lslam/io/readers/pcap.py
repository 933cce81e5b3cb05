"""Packet captures of Velodyne and Ouster sensors as sequences: a scan is a revolution, read on demand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lslam.core.errors import InputError
from lslam.core.printable import printable
from lslam.core.types.scan import Scan
from lslam.core.types.sequence import Calibration
from lslam.io.formats import velodyne_packets
from lslam.io.formats.bag_listing import CAPTURES
from lslam.io.formats.pcap_files import Datagrams, read_datagrams
from lslam.io.formats.sensor_messages import decoding_advice, maker_by_bytes
from lslam.io.formats.sequence_toml import SequenceInfo
from lslam.io.readers.ground_truth import Voice
from lslam.io.readers.listing import list_scans
from lslam.io.readers.pcap_revolutions import Revolutions, SpinningSensor, open_ouster, open_velodyne, read_scan
from lslam.io.readers.sequence_on_disk import SequenceOnDisk
from lslam.io.readers.sidecars import calibration_over, compensation_note, load_streams, read_info, stated_times

KIND = "pcap"
_PACKET_BYTES, _LOOKED_AT = 200, 20  # LiDAR packets are larger; so many tell whose they are


@dataclass(kw_only=True)
class PcapSequence(SequenceOnDisk):
    """Recording in a capture; revolutions : its scans."""

    revolutions: Revolutions

    def _read(self, index: int) -> Scan:
        """Read revolution `index`, without times if the recording is motion compensated."""
        return read_scan(self.revolutions, index, not self.motion_compensated)


def locate(path: Path) -> tuple[Path, str] | None:
    """Capture at `path`, or the only one in this folder, and the reason; None without one, or if the folder has scan files.

    Raises InputError listing the captures when a folder has several.
    """
    if path.suffix.lower() in CAPTURES:
        return (path, f"{path.name} is a capture") if path.is_file() else None
    if not path.is_dir():
        return None
    captures = sorted(p for p in path.iterdir() if p.suffix.lower() in CAPTURES and p.is_file() and p.name[0] != ".")
    if not captures or list_scans(path)[0]:
        return None
    if len(captures) > 1:
        raise InputError(
            f"{path} holds {len(captures)} captures ({', '.join(p.name for p in captures)}): name one of them"
        )
    return captures[0], f"it holds the capture {captures[0].name}"


def open_folder(path: Path, overrides: SequenceInfo, why: str) -> PcapSequence:
    """Open the capture at `path`; overrides : outrank `sequence.toml`; why : reason for this format, for the notes.

    Raises InputError if unreadable, without packets of a known sensor or their metadata.
    """
    info, _ = read_info(path.parent, overrides)
    voice = Voice([f"format {KIND}: {why}", *compensation_note(info)], [])
    datagrams = read_datagrams(path)
    if datagrams.loss:
        voice.problems.append(datagrams.loss)
    spinning = _opener(path, datagrams)(path, datagrams, voice)
    revolutions = spinning.revolutions
    sequence = PcapSequence(
        name=info.name or printable(path.stem),
        path=path,
        kind=KIND,
        revolutions=revolutions,
        stamps_ns=revolutions.stamps_ns,
        rate_hz=info.rate_hz or spinning.rate_hz,
        rings=info.rings or spinning.rings,
        sensor=info.sensor or spinning.sensor,
        motion_compensated=bool(info.motion_compensated),
        notes=voice.notes,
        problems=voice.problems,
        stated_times=stated_times(info),
        calibration=calibration_over(info, Calibration(T_lidar_imu=spinning.T_lidar_imu)),
    )
    beside, sequence.gnss = load_streams(path.parent, info, voice)
    sequence.imu = spinning.imu if beside is None else beside
    if beside is not None and info.T_lidar_imu is None:
        voice.problems.append(
            "extrinsics: nothing says where the IMU beside the capture sits: it is taken to sit in the LiDAR, axes alike; "
            "--extrinsics states T_lidar_imu"
        )
        sequence.calibration = calibration_over(info, Calibration(T_lidar_imu=np.eye(4)))
        sequence.has_assumed_extrinsics = True
    voice.problems += sequence.streams_apart()
    return sequence


def _opener(path: Path, datagrams: Datagrams) -> Callable[..., SpinningSensor]:
    """Opener by packet size: Velodyne's have 1206 bytes and a flag, Ouster's need metadata; InputError for other packets."""
    of_size = np.flatnonzero(datagrams.sizes == velodyne_packets.SIZE)
    flags = datagrams.bytes_at(of_size, (0, 1))
    if (flags == velodyne_packets.FLAG).all(axis=1).any():
        return open_velodyne
    if not len(datagrams):
        raise InputError(f"{path} holds no UDP datagrams over IPv4, which LiDAR packets are")
    large = np.flatnonzero(datagrams.sizes >= _PACKET_BYTES)[:_LOOKED_AT]
    heads = datagrams.bytes_at(large, tuple(range(4)))
    makers = {maker_by_bytes(bytes(head), int(size)) for head, size in zip(heads, datagrams.sizes[large], strict=True)}
    if len(makers) == 1 and (maker := makers.pop()):
        raise InputError(f"{path} holds {decoding_advice(maker)}")
    return open_ouster
