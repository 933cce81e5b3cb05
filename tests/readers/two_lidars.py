"""A simulated vehicle with two LiDARs: two drives from one motion, with two mounts."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from bag_builders import START_NS, bag
from numpy.typing import NDArray

from lslam.convert import bag_messages
from lslam.convert.bag_writer import BagWriter
from lslam.geometry import se3
from lslam.simulation.lidar_models import LIDARS
from lslam.simulation.scenarios import SimulatedDrive, simulate
from lslam.types.scan import Scan

# The second one looks back from the other end of the roof, tilted.
T_FRONT_REAR = se3.exp(np.array([-1.6, 0.4, -0.2, 0.0, 0.05, 0.0])) @ se3.exp(np.array([0, 0, 0, 0, 0, 3.0]))
LIDAR = replace(LIDARS["vlp16"], columns=600)


@dataclass(frozen=True)
class Mounted:
    """The motion of a sensor at `T_lidar_sensor` (4, 4) of the LiDAR that `motion` moves."""

    motion: Any
    T_lidar_sensor: NDArray[np.float64]

    def poses(self, times: NDArray[Any]) -> NDArray[np.float64]:
        """(M, 4, 4) T_city_sensor at `times` (M,), s."""
        return np.asarray(self.motion.poses(times) @ self.T_lidar_sensor)


@dataclass(frozen=True)
class TwoLidars:
    """A drive and the scans (front, rear) of both LiDARs."""

    drive: SimulatedDrive
    front: list[Scan]
    rear: list[Scan]


def two_lidars(
    scenario: str = "block", count: int = 20, offset_ns: int = 0, seed: int = 3, compensated: bool = False, **more: Any
) -> TwoLidars:
    """Both scan at the drive's rate; the rear one begins its sweeps `offset_ns` later."""
    front = simulate(scenario, lidar=LIDAR, seed=seed, count=count, motion_compensated=compensated, **more)
    rear: Any = copy.copy(front)
    rear.vehicle = Mounted(front.vehicle, T_FRONT_REAR)
    rear.stamps_ns = front.stamps_ns + offset_ns
    rear._seeds = (*front._seeds, 77)
    rear._roof = None
    # Its last sweep would end after the drive.
    last = count - (1 if offset_ns else 0)
    return TwoLidars(front, [front.scan(k) for k in range(count)], [rear.scan(k) for k in range(last)])


def write_bag(
    path: Path, scans: TwoLidars, kind: str = "mcap", topics: tuple[str, str] = ("/points", "/points"),
    frames: tuple[str, str] = ("front", "rear"), tree: dict[tuple[str, str], NDArray[np.float64]] | None = None,
) -> Path:  # fmt: skip
    """Both LiDARs in the order of their stamps, with /tf_static, by default that from front to rear, and the drive's IMU."""
    imu, T_lidar_imu = scans.drive.imu, scans.drive.calibration.T_lidar_imu
    links = {("front", "rear"): T_FRONT_REAR} if tree is None else tree
    if imu is not None and T_lidar_imu is not None:
        links = {**links, (frames[0], "imu"): T_lidar_imu}

    def fill(writer: BagWriter) -> None:
        if links:
            writer.write("/tf_static", START_NS, bag_messages.transforms(writer.store, START_NS, links))
        if imu is not None:
            for stamp, accel, gyro in zip((START_NS + imu.stamps_ns).tolist(), imu.accel, imu.gyro, strict=True):
                writer.write("/imu", stamp, bag_messages.imu(writer.store, stamp, accel, gyro, "imu"))
        both = [(scan, 0) for scan in scans.front] + [(scan, 1) for scan in scans.rear]
        for scan, which in sorted(both, key=lambda pair: (pair[0].stamp_ns, pair[1])):
            stamped = replace(scan, stamp_ns=START_NS + scan.stamp_ns)
            message = bag_messages.cloud(writer.store, stamped, frames[which])
            writer.write(topics[which], stamped.stamp_ns, message)

    return bag(path, fill, kind)
