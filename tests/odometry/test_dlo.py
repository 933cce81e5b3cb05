"""DLO: it follows a drive by two registrations of each scan, and the second one is what counts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.config import load_config
from lslam.frontend.register_scans import estimate
from lslam.odometry import create_odometry
from lslam.odometry.dlo import Dlo
from lslam.simulation.scenarios import simulate
from lslam.types.scan_result import ScanResult

COUNT = 40


def dlo() -> Dlo:
    method = create_odometry(load_config(None, ["odometry.method=dlo"], {}))
    assert isinstance(method, Dlo)
    return method


def error_of(results: list[ScanResult], truth: NDArray[np.float64]) -> float:
    """Distance, m, of the last pose from the true one, both from the first scan on."""
    found = np.linalg.inv(results[0].T_world_lidar) @ results[-1].T_world_lidar
    true = np.linalg.inv(truth[0]) @ truth[len(results) - 1]
    return float(np.linalg.norm(found[:3, 3] - true[:3, 3]))


def test_a_drive_is_followed_on_few_keyframes() -> None:
    drive = simulate("residential", seed=3, lidar="vlp16", count=COUNT)
    method = dlo()
    results = list(estimate(drive, method))
    assert all(r.status == "ok" for r in results)
    assert {"scan", "map"} <= set(results[-1].stages)
    assert all(r.covariance is not None for r in results)
    assert drive.ground_truth is not None
    assert error_of(results, drive.ground_truth.poses) < 0.1
    target = method.registration.target.scans
    assert 2 <= len(target.poses) < COUNT  # type: ignore[attr-defined]


def test_the_submap_corrects_what_the_last_scan_alone_gives() -> None:
    """Scan to scan, errors add up: the same drive without its submap ends farther from the truth."""
    drive = simulate("residential", seed=3, lidar="vlp16", count=COUNT)
    assert drive.ground_truth is not None
    truth = drive.ground_truth.poses
    both = error_of(list(estimate(drive, dlo())), truth)
    settings = ["odometry.method=gicp", "registration.target=scan"]
    alone = error_of(list(estimate(drive, create_odometry(load_config(None, settings, {})))), truth)
    assert both < alone
