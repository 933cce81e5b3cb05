"""Readings of a vehicle's wheels."""

from __future__ import annotations

from dataclasses import dataclass

from lslam.core.types.arrays import Floats, Longs


@dataclass(frozen=True)
class WheelStream:
    """Speeds of a vehicle by its wheels.

    stamps_ns : (M,) int64, increasing; speed : (M,) m/s, forwards; yaw_rate : (M,) rad/s, None where it was not measured
    T_lidar_base : (4, 4) the frame of which they are the speeds, x forward and z up; None where nothing says where it sits
    """

    stamps_ns: Longs
    speed: Floats
    yaw_rate: Floats | None = None
    T_lidar_base: Floats | None = None

    def __len__(self) -> int:
        return len(self.stamps_ns)
