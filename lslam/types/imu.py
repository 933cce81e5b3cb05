"""Inertial measurements."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class ImuStream:
    """Samples of one IMU in its own frame.

    stamps_ns : (M,) int64; accel : (M, 3) specific force, m/s2, +g up at rest; gyro : (M, 3) rad/s
    hidden : (M, 6) one sigma of what readings at the end of the range lack, of accel and gyro; None where none do
    """

    stamps_ns: NDArray[np.int64]
    accel: NDArray[np.float64]
    gyro: NDArray[np.float64]
    hidden: NDArray[np.float64] | None = None

    def __len__(self) -> int:
        return len(self.stamps_ns)
