"""Captures made from the formulas of the sensors' manuals, for tests: what the sensor would send of a room about it.

Nothing of the decoder is used. Files and network headers are dpkt's.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dpkt
import numpy as np

# 22 minutes past the hour, so that the hour the capture tells matters.
START_NS = 1_700_000_000_000_000_000 + 123_456_000
Frame = tuple[int, bytes]
# Range in m that a sensor sees at `t` seconds along a bearing (rad, left of the front) and an elevation (rad).
Room = Callable[[float, float, float], float]
TOP_OF_HOUR = {"VLP-16": 0x22, "HDL-32E": 0x21, "VLP-32C": 0x28}
MODES = {"strongest": 0x37, "last": 0x38, "dual": 0x39}

VLP16_DEG = [-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15]
VLP16_UP_MM = [11.2, -0.7, 9.7, -2.2, 8.1, -3.7, 6.6, -5.1, 5.1, -6.6, 3.7, -8.1, 2.2, -9.7, 0.7, -11.2]
HDL32_DEG = [
    -30.67, -9.33, -29.33, -8.00, -28.00, -6.67, -26.67, -5.33, -25.33, -4.00, -24.00, -2.67, -22.67, -1.33, -21.33, 0.00,
    -20.00, 1.33, -18.67, 2.67, -17.33, 4.00, -16.00, 5.33, -14.67, 6.67, -13.33, 8.00, -12.00, 9.33, -10.67, 10.67,
]  # fmt: skip


@dataclass
class Shot:
    """What one laser measured: when (ns), which ring from below, the point (m, x forward, y left, z up), reflectivity."""

    at_ns: int
    ring: int
    point: tuple[float, float, float]
    reflectivity: int


def square_room(_: float, bearing: float, elevation: float) -> float:
    """Walls 8 m ahead and behind, 5 m to the sides, floor 1.5 m below, no ceiling."""
    c, s = math.cos(bearing) * math.cos(elevation), math.sin(bearing) * math.cos(elevation)
    hits = [8 / abs(c) if abs(c) > 1e-9 else 1e9, 5 / abs(s) if abs(s) > 1e-9 else 1e9]
    if elevation < 0:
        hits.append(1.5 / -math.sin(elevation))
    return min(hits)


def velodyne(
    model: str, revolutions: float, room: Room = square_room, *, mode: str = "strongest", rate_hz: float = 10.0,
    first_deg: float = 123.45, start_ns: int = START_NS, clock_ns: int = 0,
) -> tuple[list[Frame], list[Shot]]:  # fmt: skip
    """Data packets with the times of their arrival, and what was measured.

    clock_ns : by how much the sensor's clock is ahead of the capture's
    """
    degrees = {"VLP-16": VLP16_DEG, "HDL-32E": HDL32_DEG}[model]
    ups = VLP16_UP_MM if model == "VLP-16" else [0.0] * 32
    sequence_us, laser_us = (55.296, 2.304) if model == "VLP-16" else (46.080, 1.152)
    per_block = 32 // len(degrees)
    rings = [sorted(degrees).index(d) for d in degrees]
    per_packet = 6 if mode == "dual" else 12
    frames, shots = [], []
    total_us, t_us = revolutions / rate_hz * 1e6, 0.0

    def heading(us: float) -> float:
        return first_deg + us * 1e-6 * rate_hz * 360

    while t_us < total_us:
        body = b""
        for block in range(per_packet):
            block_us = t_us + block * per_block * sequence_us
            record = struct.pack("<HH", 0xEEFF, round(heading(block_us) * 100) % 36000)
            near = record
            for half in range(per_block):
                for laser, up in enumerate(degrees):
                    us = block_us + half * sequence_us + laser * laser_us
                    bearing, elevation = -math.radians(heading(us)), math.radians(up)
                    r = room(us * 1e-6, bearing, elevation)
                    # Nothing comes back from beyond 100 m.
                    units = 0 if r > 100 else round(r / 0.002)
                    shade = (laser * 7 + block) % 256
                    record += struct.pack("<HB", units, shade)
                    near += struct.pack("<HB", units // 2, shade)
                    if units:
                        d = units * 0.002
                        point = (
                            d * math.cos(elevation) * math.cos(bearing), d * math.cos(elevation) * math.sin(bearing),
                            d * math.sin(elevation) + ups[laser] / 1000,
                        )  # fmt: skip
                        shots.append(Shot(start_ns + clock_ns + round(us * 1000), rings[laser], point, shade))
            # Of two returns the last comes first, then the strongest.
            body += record + (near if mode == "dual" else b"")
        sent = start_ns + round(t_us * 1000)
        past = (sent + clock_ns) // 1000 % 3_600_000_000
        frames.append((sent + 1_330_000, body + struct.pack("<IBB", past, MODES[mode], TOP_OF_HOUR[model])))
        t_us += per_packet * per_block * sequence_us
    return frames, shots


@dataclass
class OusterSpec:
    """A small sensor: 8 beams, 64 columns a turn, 16 of them in a packet."""

    profile: str = "RNG19_RFL8_SIG16_NIR16"
    beams: int = 8
    width: int = 64
    offset_mm: float = 15.806
    rate_hz: int = 10
    start_ns: int = START_NS

    @property
    def altitudes(self) -> list[float]:
        return [20.0 - 5.0 * k for k in range(self.beams)]

    @property
    def azimuths(self) -> list[float]:
        return [1.5 if k % 2 else -1.5 for k in range(self.beams)]

    def metadata(self, is_nested: bool = True) -> dict[str, Any]:
        """As firmware 3 groups it, or side by side as firmware 1 did."""
        beams = {
            "beam_altitude_angles": self.altitudes, "beam_azimuth_angles": self.azimuths,
            "lidar_origin_to_beam_origin_mm": self.offset_mm,
        }  # fmt: skip
        data = {
            "columns_per_frame": self.width, "columns_per_packet": 16, "pixels_per_column": self.beams,
            "udp_profile_lidar": self.profile,
        }  # fmt: skip
        lidar = {"lidar_to_sensor_transform": [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 36.18, 0, 0, 0, 1]}
        imu = {"imu_to_sensor_transform": [1, 0, 0, 6.253, 0, 1, 0, -11.775, 0, 0, 1, 7.645, 0, 0, 0, 1]}
        mode = {"lidar_mode": f"{self.width}x{self.rate_hz}"}
        if is_nested:
            return {
                "beam_intrinsics": beams, "lidar_data_format": data, "lidar_intrinsics": lidar, "imu_intrinsics": imu,
                "config_params": mode, "sensor_info": {"prod_line": "OS-1-8"},
            }  # fmt: skip
        return {**beams, **lidar, **imu, **mode, "prod_line": "OS-1-8"}


def ouster(
    spec: OusterSpec, turns: int, room: Room = square_room, *, clock_ns: int = 0
) -> tuple[list[Frame], list[Shot]]:
    """Lidar packets and what was measured. clock_ns : by how much the sensor's clock is ahead of the capture's."""
    frames, shots = [], []
    step_ns = 10**9 // spec.rate_hz // spec.width
    for turn in range(turns):
        for begin in range(0, spec.width, 16):
            columns = b""
            for m in range(begin, begin + 16):
                at = spec.start_ns + (turn * spec.width + m) * step_ns
                channels = b""
                for u in range(spec.beams):
                    channel, shot = _ouster_shot(spec, room, m, u, at + clock_ns, (at - spec.start_ns) * 1e-9)
                    channels += channel
                    shots += [] if shot is None else [shot]
                columns += _ouster_column(spec, at + clock_ns, m, turn, channels)
            packet = columns
            if spec.profile != "LEGACY":
                packet = struct.pack("<HH", 1, turn) + bytes(28) + columns + bytes(32)
            frames.append((spec.start_ns + (turn * spec.width + begin + 16) * step_ns, packet))
    return frames, shots


def _ouster_column(spec: OusterSpec, at_ns: int, m: int, turn: int, channels: bytes) -> bytes:
    if spec.profile == "LEGACY":
        return struct.pack("<QHHI", at_ns, m, turn, m * 88) + channels + b"\xff\xff\xff\xff"
    return struct.pack("<QHH", at_ns, m, 1) + channels


def _ouster_shot(spec: OusterSpec, room: Room, m: int, u: int, at_ns: int, t: float) -> tuple[bytes, Shot | None]:
    theta_encoder = 2 * math.pi * (1 - m / spec.width)
    theta_azimuth = -2 * math.pi * spec.azimuths[u] / 360
    phi = 2 * math.pi * spec.altitudes[u] / 360
    # The sensor's front is behind the rotor's.
    metres = room(t, theta_encoder + theta_azimuth + math.pi, phi)
    unit = 8 if spec.profile == "RNG15_RFL8_NIR8" else 1
    r = 0 if metres > 100 else round(metres * 1000 / unit) * unit
    shade = (u * 11 + m) % 256
    channel = {
        "LEGACY": struct.pack("<IHHHH", r | 0x5 << 28, shade, 300, 20, 0),
        "RNG19_RFL8_SIG16_NIR16": struct.pack("<IBBHHH", r | 0x1F << 19, shade, 0, 300, 20, 0),
        "RNG19_RFL8_SIG16_NIR16_DUAL": struct.pack("<IIHHHH", r | shade << 24 | 1 << 19, r // 2, 300, 30, 20, 0),
        "RNG15_RFL8_NIR8": struct.pack("<HBB", r // unit | 0x8000, shade, 20),
    }[spec.profile]
    if not r:
        return channel, None
    n = spec.offset_mm
    x = (r - n) * math.cos(theta_encoder + theta_azimuth) * math.cos(phi) + n * math.cos(theta_encoder)
    y = (r - n) * math.sin(theta_encoder + theta_azimuth) * math.cos(phi) + n * math.sin(theta_encoder)
    z = (r - n) * math.sin(phi)
    return channel, Shot(at_ns, u, (-x / 1000, -y / 1000, (z + 36.18) / 1000), shade)


def ouster_imu(count: int, start_ns: int = START_NS) -> list[Frame]:
    """Samples at 100 Hz: 1 g upwards, 10 deg/s about z, the rest small and different."""
    frames = []
    for k in range(count):
        at = start_ns + k * 10_000_000
        frames.append((at, struct.pack("<QQQ6f", at + 7, at - 3, at, 0.01, 0.02, 1.0, 1.0, 2.0, 10.0)))
    return frames


def udp(
    payload: bytes, port: int = 2368, sender: bytes = b"\xc0\xa8\x01\xc9", mtu: int = 65000, number: int = 1
) -> Iterator[bytes]:
    """Ethernet frames of one datagram, in pieces where it is larger than `mtu`."""
    datagram = dpkt.udp.UDP(sport=port, dport=port, data=payload)
    datagram.ulen = len(datagram)
    whole = bytes(datagram)
    step = mtu // 8 * 8
    for at in range(0, len(whole), step):
        piece = whole[at : at + step]
        packet = dpkt.ip.IP(
            id=number,
            src=sender,
            dst=b"\xff\xff\xff\xff",
            p=17,
            data=piece,
            mf=int(at + step < len(whole)),
            offset=at // 8,
        )
        packet.len = len(packet)
        yield bytes(dpkt.ethernet.Ethernet(dst=b"\xff" * 6, src=b"\x02" * 6, type=0x0800, data=bytes(packet)))


def write_pcap(path: Path, frames: list[Frame], **how: Any) -> Path:
    """A capture of these datagrams, in the order of their times; pcapng by its name."""
    with path.open("wb") as stream:
        writer: Any = (dpkt.pcapng if path.suffix == ".pcapng" else dpkt.pcap).Writer(stream)
        for number, (at_ns, payload) in enumerate(sorted(frames, key=lambda frame: frame[0])):
            for data in udp(payload, number=number & 0xFFFF, **how):
                writer.writepkt(data, ts=at_ns / 1e9)
    return path


def write_ouster(folder: Path, spec: OusterSpec, frames: list[Frame], *, is_nested: bool = True, **how: Any) -> Path:
    """A capture and its metadata."""
    path = write_pcap(folder / "drive.pcap", frames, **how)
    (folder / "drive.json").write_text(json.dumps(spec.metadata(is_nested)))
    return path


def arrays(shots: list[Shot]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Times, rings, points and reflectivities of the shots."""
    return (
        np.array([s.at_ns for s in shots], np.int64), np.array([s.ring for s in shots]),
        np.array([s.point for s in shots]), np.array([s.reflectivity for s in shots]),
    )  # fmt: skip
