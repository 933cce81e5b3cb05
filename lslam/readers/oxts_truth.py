"""Ground truth of a KITTI raw drive: OXTS samples as LiDAR poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.formats.oxts_files import POS_ACC, ROLL, YAW, Oxts
from lslam.geometry import geodesy, se3, so3
from lslam.geometry.interpolate import poses_at
from lslam.readers.ground_truth import Voice
from lslam.types.trajectory import Trajectory

# Above this the reference is worse than LiDAR odometry over the length of a drive.
_POOR_M = 0.2
# How far a scan may lie before the first or after the last OXTS sample: one period.
_BEYOND_NS = 100_000_000


def oxts_truth(
    oxts: Oxts, scan_stamps_ns: NDArray[np.int64], T_lidar_imu: NDArray[np.float64] | None, voice: Voice
) -> Trajectory | None:
    """LiDAR poses at the stamps of the scans, in the frame of the first; None, with the reason said, when something is missing.

    As the devkit's convertOxtsToPose (R = Rz(yaw) Ry(pitch) Rx(roll)), but with positions in a transverse Mercator
    projection at the first fix: the devkit's spherical one stretches Karlsruhe by 0.1 to 0.2 %.
    """
    if oxts.stamps_ns is None or len(oxts.stamps_ns) < 2:
        return None
    if T_lidar_imu is None:
        voice.problems.append("OXTS is no ground truth here: calib_imu_to_velo.txt is missing, so its place is unknown")
        return None
    keep = np.concatenate([[True], oxts.stamps_ns[1:] > np.maximum.accumulate(oxts.stamps_ns)[:-1]])
    stamps, values = oxts.stamps_ns[keep], oxts.values[keep]
    if len(stamps) < 2:
        voice.problems.append("OXTS is no ground truth here: its stamps do not increase")
        return None
    if len(scan_stamps_ns) and (
        scan_stamps_ns[-1] < stamps[0] - _BEYOND_NS or scan_stamps_ns[0] > stamps[-1] + _BEYOND_NS
    ):
        voice.problems.append("OXTS is no ground truth here: it shares no time with the scans")
        return None
    positions = geodesy.to_local(values[:, :3], values[0, :3])
    T_enu_imu = se3.make(so3.from_euler_rpy(values[:, ROLL : YAW + 1]), positions)
    T_enu_lidar = T_enu_imu @ se3.inverse(T_lidar_imu)
    at = stamps
    if not np.isin(scan_stamps_ns, stamps).all():
        # LiDAR and OXTS have their own clocks' ticks: 5 ms apart are 7 cm at 15 m/s.
        at = scan_stamps_ns[(scan_stamps_ns >= stamps[0] - _BEYOND_NS) & (scan_stamps_ns <= stamps[-1] + _BEYOND_NS)]
        T_enu_lidar = poses_at(stamps, T_enu_lidar, at)
        voice.notes.append("OXTS poses are interpolated to the stamps of the scans")
    poses = se3.normalise(se3.inverse(T_enu_lidar[0]) @ T_enu_lidar)
    accuracy = float(np.median(values[:, POS_ACC]))
    voice.notes.append(
        "ground truth from OXTS (attitude and position, transverse Mercator at the first fix) as LiDAR poses; its own "
        f"pos_acc: median {accuracy:.2f} m, worst {values[:, POS_ACC].max():.2f} m"
    )
    if accuracy > _POOR_M:
        voice.notes.append(
            f"OXTS positions are poor (pos_acc median {accuracy:.2f} m): position errors against them say more about GNSS than "
            "about SLAM, trust rotation and short relative errors"
        )
    return Trajectory(at, poses, "lidar", True, None, "oxts")
