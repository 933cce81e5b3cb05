"""imu_states.csv: states in the order of their names, empty where nothing is estimated."""

from __future__ import annotations

import csv
import io

import numpy as np

from lslam.core.types.imu import IMU_STATES, ImuDiagnostics, ImuState
from lslam.core.types.scan_result import ScanResult
from lslam.pipeline.outputs import imu_states_text


def test_a_state_stands_beside_its_sigma_and_scans_without_one_are_left_out() -> None:
    values, sigmas = np.arange(13.0), np.arange(13.0) / 100
    values[9:12] = sigmas[9:12] = np.nan
    with_state = ScanResult(
        index=4,
        stamp_ns=1_700_000_000_123_456_789,
        T_world_lidar=np.eye(4),
        imu=ImuDiagnostics(ImuState(values, sigmas)),
    )
    without = ScanResult(index=5, stamp_ns=1_700_000_000_223_456_789, T_world_lidar=np.eye(4))
    (row,) = csv.DictReader(io.StringIO(imu_states_text([with_state, without])))
    assert (row["index"], row["stamp_ns"]) == ("4", "1700000000123456789")
    for k, name in enumerate(IMU_STATES):
        if name.startswith("mounting"):
            assert (row[name], row[f"{name}_sigma"]) == ("", "")
        else:
            assert (float(row[name]), float(row[f"{name}_sigma"])) == (k, k / 100)
