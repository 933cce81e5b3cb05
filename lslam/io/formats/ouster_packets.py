"""Lidar and IMU packets of Ouster sensors, and the metadata that describe their layout (sensor's user manual)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats, Longs
from lslam.core.errors import InputError, input_errors
from lslam.core.geometry import se3
from lslam.core.types.imu import ImuStream
from lslam.core.untrusted import MISFIT, parse_json
from lslam.io.formats.point_cloud import PointCloud

IMU_SIZE = 48
GRAVITY = 9.80665  # m/s2 of the unit g


@dataclass(frozen=True)
class Profile:
    """Byte layout of a lidar packet.

    head, foot : bytes about the packet; column_head, column_foot : about each column; channel : of a beam in a column
    range_bits, range_mm : width and unit of the first return's range, which opens the channel; reflectivity : its byte
    status : place of the column's status from its beginning, counted from its end where below 0
    frame : place of the frame's number in the packet
    """

    head: int
    foot: int
    column_head: int
    column_foot: int
    channel: int
    range_bits: int
    reflectivity: int
    status: int
    frame: int
    range_mm: int = 1

    @property
    def positions(self) -> tuple[int, ...]:
        """Positions of the bytes that hold the frame number and the time of a packet."""
        return (self.frame, self.frame + 1, *range(self.head, self.head + 8))


PROFILES = {
    "LEGACY": Profile(0, 0, 16, 4, 12, 20, 4, -4, 10),
    "RNG19_RFL8_SIG16_NIR16": Profile(32, 32, 12, 0, 12, 19, 4, 10, 2),
    "RNG19_RFL8_SIG16_NIR16_DUAL": Profile(32, 32, 12, 0, 16, 19, 3, 10, 2),
    "RNG15_RFL8_NIR8": Profile(32, 32, 12, 0, 4, 15, 2, 10, 2, range_mm=8),
}
# The sensor's frame against that of its rotor, where the metadata do not say.
_LIDAR_TO_SENSOR = (-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 36.18, 0, 0, 0, 1)
_IMU_TO_SENSOR = (1, 0, 0, 6.253, 0, 1, 0, -11.775, 0, 0, 1, 7.645, 0, 0, 0, 1)


@dataclass(frozen=True)
class OusterSensor:
    """Sensor description from its metadata.

    columns, width : columns of a packet, and of a revolution; altitudes, azimuths : (beams,) rad
    offset_m : from the rotor's axis to the beams' origin; T_sensor_lidar, T_sensor_imu : (4, 4), m
    rate_hz : revolutions per second
    """

    name: str
    profile: Profile
    columns: int
    width: int
    altitudes: Floats
    azimuths: Floats
    offset_m: float
    T_sensor_lidar: Floats
    T_sensor_imu: Floats
    rate_hz: float

    @property
    def beams(self) -> int:
        """Number of beams."""
        return len(self.altitudes)

    @property
    def column_bytes(self) -> int:
        """Bytes of a column of a packet."""
        return self.profile.column_head + self.beams * self.profile.channel + self.profile.column_foot

    @property
    def packet_bytes(self) -> int:
        """Bytes of a lidar packet."""
        return self.profile.head + self.columns * self.column_bytes + self.profile.foot


def read_metadata(path: Path) -> OusterSensor:
    """Read the metadata file of a sensor, as its software writes it, of any firmware.

    Raises InputError naming the file when it is unreadable, lacks something or names a layout lslam does not know.
    """
    with input_errors(path):
        return parse_metadata(path.read_bytes(), str(path))


def parse_metadata(text: str | bytes, where: str) -> OusterSensor:
    """Parse metadata as `read_metadata`, from text; `where` names its source in messages. Raises InputError."""
    try:
        entries = _flat(parse_json(text))
    except MISFIT as error:
        raise InputError(f"{where} is no metadata of an Ouster sensor: {error}") from None
    layout = str(entries.get("udp_profile_lidar") or "LEGACY")
    if layout not in PROFILES:
        raise InputError(f"{where}: packets of profile {layout} are not read; {', '.join(PROFILES)} are")
    try:
        return _sensor(entries, layout)
    except MISFIT as error:
        raise InputError(
            f"{where} is no metadata of an Ouster sensor: beam_altitude_angles, beam_azimuth_angles and lidar_mode are needed "
            f"({type(error).__name__}: {error})"
        ) from None


def _flat(tree: Any) -> dict[str, Any]:
    """Values by key with nested tables flattened: firmware 3 groups keys that older ones had side by side."""
    entries: dict[str, Any] = {}
    if isinstance(tree, dict):
        for value in tree.values():
            entries.update(_flat(value))
        entries.update({key: value for key, value in tree.items() if not isinstance(value, dict)})
    return entries


def _sensor(entries: dict[str, Any], layout: str) -> OusterSensor:
    """Sensor by the flattened metadata `entries` and the packet profile `layout`; ValueError or KeyError if they misfit."""
    width, rate = (int(word) for word in str(entries["lidar_mode"]).split("x"))
    width, columns = int(entries.get("columns_per_frame") or width), int(entries.get("columns_per_packet") or 16)
    altitudes, azimuths = (
        np.radians(np.array(entries[f"beam_{name}_angles"], np.float64).reshape(-1)) for name in ("altitude", "azimuth")
    )
    T_lidar_beam = entries.get("beam_to_lidar_transform")
    offset_mm = entries.get("lidar_origin_to_beam_origin_mm")
    if offset_mm is None:
        offset_mm = 0.0 if T_lidar_beam is None else np.array(T_lidar_beam, np.float64).ravel()[3]
    sensor = OusterSensor(
        str(entries.get("prod_line") or "Ouster"),
        PROFILES[layout],
        columns,
        width,
        altitudes,
        azimuths,
        float(offset_mm) * 1e-3,
        _transform(entries.get("lidar_to_sensor_transform") or _LIDAR_TO_SENSOR),
        _transform(entries.get("imu_to_sensor_transform") or _IMU_TO_SENSOR),
        float(rate),
    )
    numbers = (sensor.altitudes, sensor.azimuths, sensor.T_sensor_lidar, sensor.T_sensor_imu, np.array(sensor.offset_m))
    is_right = all(np.isfinite(values).all() for values in numbers)
    is_right &= 0 < sensor.beams == len(sensor.azimuths) <= 1024 and 0 < columns <= width <= 65536 and 0 < rate <= 1000
    if not is_right:
        raise ValueError("angles, columns or transforms do not fit each other")
    return sensor


def _transform(numbers: Any) -> Floats:
    """(4, 4) in m of 16 numbers with mm."""
    T = np.array(numbers, np.float64).reshape(4, 4)
    T[:3, 3] *= 1e-3
    return T


def frames_and_times(heads: NDArray[np.uint8]) -> tuple[Longs, Longs]:
    """Frame number (P,) and time of the first column (P,), ns, of packets, from their bytes (P, 10) at `Profile.positions`."""
    frame, time = _numbers(heads[:, :2], np.dtype("<u2")), _numbers(heads[:, 2:], np.dtype("<u8"))
    return frame[:, 0].astype(np.int64), time[:, 0].astype(np.int64)


def points_of(packets: NDArray[np.uint8], sensor: OusterSensor) -> tuple[PointCloud, Longs]:
    """Points of the first returns of packets, column by column, in the sensor's frame, and their times, ns."""
    p = sensor.profile
    body = packets[:, p.head : p.head + sensor.columns * sensor.column_bytes].reshape(-1, sensor.column_bytes)
    status = body[:, p.status % sensor.column_bytes]
    body = body[(status & 1).astype(bool)]
    times = _numbers(body[:, :8], np.dtype("<u8"))[:, 0].astype(np.int64)
    column = _numbers(body[:, 8:10], np.dtype("<u2"))[:, 0].astype(np.float64)
    channels = body[:, p.column_head : p.column_head + sensor.beams * p.channel].reshape(
        len(body), sensor.beams, p.channel
    )
    words = _numbers(channels[..., :4], np.dtype("<u4"))[..., 0]
    ranges = (words & ((1 << p.range_bits) - 1)).astype(np.float64) * (1e-3 * p.range_mm)
    encoder = 2 * np.pi * (1 - column / sensor.width)[:, None]
    azimuth = encoder - sensor.azimuths
    along = ranges - sensor.offset_m
    level = along * np.cos(sensor.altitudes)
    local = np.stack(
        [
            level * np.cos(azimuth) + sensor.offset_m * np.cos(encoder),
            level * np.sin(azimuth) + sensor.offset_m * np.sin(encoder),
            along * np.sin(sensor.altitudes),
        ],
        axis=-1,
    )
    hit = ranges > 0
    rings = np.broadcast_to(np.arange(sensor.beams, dtype=np.uint16), hit.shape)[hit]
    points = se3.apply(sensor.T_sensor_lidar, local[hit])
    cloud = PointCloud(
        points.astype(np.float32), channels[..., p.reflectivity][hit].astype(np.float32), rings=rings.copy()
    )
    return cloud, np.broadcast_to(times[:, None], hit.shape)[hit]


def imu_of(packets: NDArray[np.uint8]) -> ImuStream:
    """Samples of IMU packets (P, 48), in m/s2 and rad/s. The stamps are those of the gyroscope.

    Samples that are not finite are left out, as lost packets would be.
    """
    stamps = _numbers(packets[:, 16:24], np.dtype("<u8"))[:, 0].astype(np.int64)
    values = _numbers(packets[:, 24:48], np.dtype("<f4")).astype(np.float64)
    finite = np.isfinite(values).all(axis=1)
    return ImuStream(stamps[finite], values[finite, :3] * GRAVITY, np.radians(values[finite, 3:]))


def _numbers(data: NDArray[np.uint8], kind: np.dtype[Any]) -> NDArray[Any]:
    """Little-endian numbers made of the bytes along the last axis."""
    return np.ascontiguousarray(data).view(kind)
