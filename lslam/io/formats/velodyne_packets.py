"""Data packets of Velodyne's VLP-16, Puck Hi-Res, HDL-32E and VLP-32C, by their user manuals.

1206 bytes: 12 blocks of flag, azimuth (0.01 deg) and 32 times distance and reflectivity, then microseconds past the hour, the
return mode and the model. Azimuths count clockwise from the front.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Bools, Longs
from lslam.io.formats.point_cloud import PointCloud

SIZE, BLOCKS, SLOTS = 1206, 12, 32
BLOCK_BYTES = 100
FLAG = (0xFF, 0xEE)
TURN = 36000  # 0.01 deg
HOUR_US = 3_600_000_000
RETURNS = {0x37: "strongest", 0x38: "last", 0x39: "dual"}
DUAL = 0x39


@dataclass(frozen=True)
class VelodyneModel:
    """Properties of a sensor from its manual.

    elevations_deg, turned_deg, raised_mm : of each laser: angle up, angle by which it is ahead of the block's azimuth, height of
        its beam's origin
    block_ns : from one block to the next; slot_ns : (32,) when each slot of a block is measured, from the block's beginning
    unit_m : of distances
    """

    name: str
    elevations_deg: tuple[float, ...]
    turned_deg: tuple[float, ...]
    raised_mm: tuple[float, ...]
    block_ns: int
    slot_ns: tuple[int, ...]
    unit_m: float = 0.002

    @property
    def lasers(self) -> int:
        """Number of beams."""
        return len(self.elevations_deg)

    @property
    def rings(self) -> NDArray[np.uint16]:
        """(lasers,) ring of each, counted from the lowest."""
        return np.argsort(np.argsort(self.elevations_deg)).astype(np.uint16)


_SIXTEEN = tuple(k // 16 * 55_296 + k % 16 * 2_304 for k in range(SLOTS))
_NONE16, _NONE32 = (0.0,) * 16, (0.0,) * 32
MODELS = {
    0x22: VelodyneModel(
        "VLP-16", (-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15), _NONE16,
        (11.2, -0.7, 9.7, -2.2, 8.1, -3.7, 6.6, -5.1, 5.1, -6.6, 3.7, -8.1, 2.2, -9.7, 0.7, -11.2), 110_592, _SIXTEEN,
    ),
    0x24: VelodyneModel(
        "Puck Hi-Res",
        (-10, 0.67, -8.67, 2, -7.33, 3.33, -6, 4.67, -4.67, 6, -3.33, 7.33, -2, 8.67, -0.67, 10), _NONE16,
        (7.4, -0.9, 6.5, -1.8, 5.5, -2.7, 4.6, -3.7, 3.7, -4.6, 2.7, -5.5, 1.8, -6.5, 0.9, -7.4), 110_592, _SIXTEEN,
    ),
    0x21: VelodyneModel(
        "HDL-32E", tuple((-92 + 4 * (k // 2)) / 3 if k % 2 == 0 else (-28 + 4 * (k // 2)) / 3 for k in range(32)),
        _NONE32, _NONE32, 46_080, tuple(1_152 * k for k in range(SLOTS)),
    ),
    0x28: VelodyneModel(
        "VLP-32C",
        (-25, -1, -1.667, -15.639, -11.31, 0, -0.667, -8.843, -7.254, 0.333, -0.333, -6.148, -5.333, 1.333, 0.667, -4,
         -4.667, 1.667, 1, -3.667, -3.333, 3.333, 2.333, -2.667, -3, 7, 4.667, -2.333, -2, 15, 10.333, -1.333),
        (1.4, -4.2, 1.4, -1.4, 1.4, -1.4, 4.2, -1.4, 1.4, -4.2, 1.4, -1.4, 4.2, -1.4, 4.2, -1.4,
         1.4, -4.2, 1.4, -4.2, 4.2, -1.4, 1.4, -1.4, 1.4, -1.4, 1.4, -4.2, 4.2, -1.4, 1.4, -1.4),
        _NONE32, 55_296, tuple(k // 2 * 2_304 for k in range(SLOTS)), 0.004,
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Blocks:
    """Blocks of one return each, in the order they were measured.

    azimuth : (B,) 0.01 deg, unwrapped; times_ns : (B,); ranges, reflectivity : (B, 32) uint16 and uint8 as in the packet
    """

    azimuth: Longs
    times_ns: Longs
    ranges: NDArray[np.uint16]
    reflectivity: NDArray[np.uint8]


def split_blocks(packets: NDArray[np.uint8], azimuth: Longs, times_ns: Longs, model: VelodyneModel) -> Blocks:
    """Blocks of `packets` (P, 1206); azimuth (P,), 0.01 deg, unwrapped, and times_ns (P,), of each packet's first block.

    With two returns per shot only the last is used, the first of each pair of blocks.
    """
    step = 2 if len(packets) and packets[0, 1204] == DUAL else 1
    body = packets[:, : BLOCKS * BLOCK_BYTES].reshape(-1, BLOCKS, BLOCK_BYTES)[:, ::step]
    here = body[..., 2].astype(np.int64) | body[..., 3].astype(np.int64) << 8
    # Within a packet the sensor turns by less than half a revolution.
    unwrapped = azimuth[:, None] + np.concatenate(
        [np.zeros((len(body), 1), np.int64), np.cumsum(np.diff(here, axis=1) % TURN, axis=1)], axis=1
    )
    times = times_ns[:, None] + model.block_ns * np.arange(body.shape[1])
    slots = body[..., 4:].reshape(-1, SLOTS, 3)
    ranges = slots[..., 0].astype(np.uint16) | slots[..., 1].astype(np.uint16) << 8
    is_block = ((body[..., 0] == FLAG[0]) & (body[..., 1] == FLAG[1]) & (here < TURN)).ravel()
    return Blocks(unwrapped.ravel()[is_block], times.ravel()[is_block], ranges[is_block], slots[..., 2][is_block])


def points_of(blocks: Blocks, use: Bools, began: int, model: VelodyneModel) -> tuple[PointCloud, Longs]:
    """Points of the blocks `use` (B,) in the order they were measured, x forward, y left, z up, and their times, ns.

    began : what unwrapped azimuths count from, 0.01 deg

    The azimuth of a slot is that of its block plus the rotation until the slot is measured, interpolated to the azimuth of
    the next block.
    """
    steps, spans = np.diff(blocks.azimuth), np.diff(blocks.times_ns)
    rate = np.where(spans > 0, steps / np.maximum(spans, 1), 0.0)
    rate = np.concatenate([rate, rate[-1:] if len(rate) else [0.0]])
    slot_ns = np.array(model.slot_ns, np.int64)
    laser = np.arange(SLOTS) % model.lasers
    turned = np.array(model.turned_deg)[laser]
    azimuth = np.radians(0.01 * (began + blocks.azimuth[use, None] + rate[use, None] * slot_ns) + turned)
    distance = blocks.ranges[use] * model.unit_m
    elevation = np.radians(model.elevations_deg)[laser]
    level = distance * np.cos(elevation)
    z = distance * np.sin(elevation) + 1e-3 * np.array(model.raised_mm)[laser]
    points = np.stack([level * np.cos(azimuth), -level * np.sin(azimuth), z], axis=-1)
    hit = blocks.ranges[use] > 0
    rings = np.broadcast_to(model.rings[laser], hit.shape)[hit]
    times = (blocks.times_ns[use, None] + slot_ns)[hit]
    cloud = PointCloud(
        points[hit].astype(np.float32), blocks.reflectivity[use][hit].astype(np.float32), rings=rings.copy()
    )
    return cloud, times
