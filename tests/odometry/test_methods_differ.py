"""No two methods give one trajectory, and no method is posed by another one."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from lslam.core.config import load_config
from lslam.core.config.odometry import TIGHTLY_COUPLED
from lslam.odometry import METHODS, create_odometry
from lslam.odometry.frontend.register_scans import estimate
from lslam.simulation.scenarios import simulate

FOREIGN = {"kiss-icp", "small-gicp", "open3d-gicp", "poses"}
# On scans without times a sweep has one pose, and `ct-icp` is `icp` to the last bit.
ALIKE = {("ct-icp", "icp")}
# Their own ways of looking twice.
OWN = {"", "less planar points", "coarse-to-fine", "start search"}


@pytest.mark.quick
def test_no_two_methods_give_the_same_trajectory() -> None:
    drive = simulate("block", seed=1, lidar="vlp16", count=12, motion_compensated=True)
    trajectories = {}
    # Without an IMU a tightly coupled method is what it is built on.
    for method in sorted(set(METHODS) - FOREIGN - set(TIGHTLY_COUPLED)):
        results = estimate(drive, create_odometry(load_config(None, [f"odometry.method={method}"], {})))
        assert {r.posed_by for r in results} <= OWN, method
        trajectories[method] = np.stack([r.T_world_lidar for r in results])
    assert len(trajectories) >= 10
    for one, other in combinations(trajectories, 2):
        off = np.abs(trajectories[one] - trajectories[other]).max()
        assert (off == 0) if (one, other) in ALIKE else (off > 1e-6), f"{one} and {other}"
