"""Where the sensors sit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Calibration:
    """Extrinsics as (4, 4) transforms; None where the recording does not say.

    T_cam0_lidar : KITTI's `Tr`; T_lidar_imu and T_lidar_gnss : IMU and antenna in the LiDAR frame
    """

    T_cam0_lidar: NDArray[np.float64] | None = None
    T_lidar_imu: NDArray[np.float64] | None = None
    T_lidar_gnss: NDArray[np.float64] | None = None
