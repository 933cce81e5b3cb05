"""imu_states.csv: what was known of the IMU after each scan, a value and its standard deviation side by side."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from lslam.types.imu_state import IMU_STATES
from lslam.types.scan_result import ScanResult


def imu_states_text(results: Iterable[ScanResult]) -> str:
    """A row per scan that has an `ImuState`; a state that is not estimated is empty. SI units, radians."""
    header = ["index", "stamp_ns", *(column for name in IMU_STATES for column in (name, f"{name}_sigma"))]
    rows = [",".join(header)]
    for r in results:
        if r.imu is not None:
            pairs = np.stack([r.imu.values, r.imu.sigmas], axis=1).ravel()
            rows.append(",".join([str(r.index), str(r.stamp_ns), *("" if np.isnan(v) else f"{v:.7g}" for v in pairs)]))
    return "\n".join(rows) + "\n"
