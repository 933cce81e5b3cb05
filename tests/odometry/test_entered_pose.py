"""Where a scan enters: at the pose that `update` is told, whoever had a say in it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lslam.config.config import Config
from lslam.geometry import se3, so3
from lslam.odometry import create_odometry
from lslam.odometry.base import Deskewing
from lslam.simulation.scenarios import simulate
from lslam.types.motion_prior import MotionPrior


@pytest.mark.parametrize("method", ["gicp", "loam-odom"])
def test_a_scan_enters_where_it_was_put(method: str) -> None:
    """From scan to scan the next one, here the same one, is found where the last was put."""
    config = Config.model_validate({"odometry": {"method": method}, "registration": {"target": "scan"}})
    odometry = create_odometry(config)
    assert isinstance(odometry, Deskewing)
    drive = simulate("block", count=2)
    prior = MotionPrior(np.zeros(1), np.eye(4)[None])
    moved = se3.make(so3.exp(np.array([0.0, 0.01, 0.02])), np.array([0.3, -0.1, 0.05]))
    covariance = 1e-6 * np.eye(6)
    for scan in drive:
        prepared = odometry.prepare(scan)
        found = odometry.register(scan, prepared, prior)
        put = replace(found, T_world_lidar=moved @ found.T_world_lidar, registration_covariance=covariance)
        done = odometry.update(scan, prepared, prior, put)
    again = odometry.register(scan, prepared, MotionPrior(np.zeros(1), put.T_world_lidar[None]))
    np.testing.assert_allclose(again.T_world_lidar, put.T_world_lidar, atol=0.02)
    assert np.linalg.norm(again.T_world_lidar[:3, 3] - found.T_world_lidar[:3, 3]) > 0.2
    assert done.covariance is not None
    assert np.trace(done.covariance) < 1e-4, "what it was said to be known to adds up"
