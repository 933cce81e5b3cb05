"""The pose at which a scan enters the map: that of `update`, whichever stage decided it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.config.config import Config
from lslam.geometry import se3, so3
from lslam.odometry import create_odometry
from lslam.odometry.base import Deskewing, Searching
from lslam.simulation.scenarios import simulate
from lslam.types.motion_prior import MotionPrior
from lslam.types.scan import Scan
from lslam.types.scan_result import ScanResult


@pytest.mark.parametrize("method", ["gicp", "loam-odom"])
def test_a_scan_enters_the_map_at_the_pose_of_the_update(method: str) -> None:
    """From scan to scan the next one, here the same one, is found where the last was put."""
    config = Config.model_validate({"odometry": {"method": method}, "registration": {"target": "scan"}})
    odometry = create_odometry(config)
    assert isinstance(odometry, Deskewing)
    drive = simulate("block", count=2)
    prior = MotionPrior.at_once(np.eye(4))
    moved = se3.make(so3.exp(np.array([0.0, 0.01, 0.02])), np.array([0.3, -0.1, 0.05]))
    covariance = 1e-6 * np.eye(6)
    for scan in drive:
        prepared = odometry.prepare(scan)
        registered = odometry.register(scan, prepared, prior)
        found = registered.result
        put = replace(found, T_world_lidar=moved @ found.T_world_lidar, registration_covariance=covariance)
        done = odometry.update(prior, replace(registered, result=put))
    again = odometry.register(scan, prepared, MotionPrior.at_once(put.T_world_lidar)).result
    np.testing.assert_allclose(again.T_world_lidar, put.T_world_lidar, atol=0.02)
    assert np.linalg.norm(again.T_world_lidar[:3, 3] - found.T_world_lidar[:3, 3]) > 0.2
    assert done.covariance is not None
    assert np.trace(done.covariance) < 1e-4, "what it was said to be known to adds up"


def before_the_third(method: str) -> tuple[Searching, Any, Scan, NDArray[np.float64]]:
    """A method that knows two scans of a drive, its registration, the third scan, and the true poses (3, 4, 4)."""
    odometry = create_odometry(Config.model_validate({"odometry": {"method": method}}))
    assert isinstance(odometry, Searching)
    drive = simulate("block", count=3, lidar="vlp16")
    assert drive.ground_truth is not None
    for scan, pose in zip(list(drive)[:2], drive.ground_truth.poses, strict=False):
        prior, prepared = MotionPrior.at_once(pose), odometry.prepare(scan)
        odometry.update(prior, odometry.register(scan, prepared, prior))
    return odometry, vars(odometry)["registration"], drive.scan(2), drive.ground_truth.poses


def scans_in(registration: Any) -> int:
    """How many scans the map of a registration took, that of features or of all points."""
    state = registration.state()
    return int(state["_inserted" if "_inserted" in state else "inserted"])


@pytest.mark.parametrize("method", ["icp", "loam"])
def test_a_rejected_scan_enters_at_the_prior_and_does_not_change_the_thresholds(method: str) -> None:
    """The third scan is found a metre from its prior: believed, that opens the kernel; denied, it enters at the prior."""
    odometry, registration, scan, (_, before, _) = before_the_third(method)
    prepared, prior = odometry.prepare(scan), MotionPrior.at_once(before)
    registered = odometry.register(scan, prepared, prior)
    found = registered.result
    assert (found.status, round(found.prior_error[0])) == ("ok", 1)
    known = registration.threshold.width, registration.agreement.usual
    entered = scans_in(registration)
    put = replace(found, status="bridged", T_world_lidar=prior.pose, registration_covariance=1e-6 * np.eye(6))
    done = odometry.update(prior, replace(registered, result=put))
    np.testing.assert_array_equal(done.T_world_lidar, prior.pose)
    assert scans_in(registration) == entered + 1
    assert (registration.threshold.width, registration.agreement.usual) == known
    odometry.update(prior, registered)
    assert (registration.threshold.width, registration.agreement.usual) != known


@pytest.mark.parametrize("method", ["icp", "loam"])
def test_with_a_near_prior_no_recovery_is_tried(method: str) -> None:
    """The third scan, expected two metres beside it: it is found all the same, but not near there."""
    odometry, registration, scan, (*_, true) = before_the_third(method)
    prepared = odometry.prepare(scan)

    def off_by(y: float, z: float = 0.0) -> MotionPrior:
        return MotionPrior.at_once(true @ se3.make(np.eye(3), np.array([0, y, z])))

    def error(result: ScanResult) -> float:
        return float(np.linalg.norm(result.T_world_lidar[:3, 3] - true[:3, 3]))

    found, count = odometry.register(scan, prepared, off_by(2.0)), scans_in(registration)
    assert error(found.result) < 0.05
    # LOAM's widest planes reach so far, or nearly, by the noise of the scans; what they find is right.
    beside = odometry.register_near(scan, prepared, off_by(2.0), found).result
    assert (beside.status, error(beside) < 0.05) in [("bridged", False), ("ok", True)][: 2 if method == "loam" else 1]
    assert odometry.register_near(scan, prepared, off_by(4.0), found).result.status == "bridged"
    near = odometry.register_near(scan, prepared, off_by(0.05), found).result
    assert (near.status, error(near) < 0.05) == ("ok", True)
    lost = odometry.register_near(scan, prepared, off_by(0.0, 500.0), found)
    assert lost.result.status == "bridged"
    odometry.update(off_by(0.0), replace(lost, result=found.result))
    assert scans_in(registration) == count + 1, "what `register` found is what enters"
