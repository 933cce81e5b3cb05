"""DLO: it follows a drive by two registrations of each scan, and the second one is what counts."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from lslam.core.config import load_config
from lslam.core.types.scan_result import ScanResult
from lslam.odometry import create_odometry
from lslam.odometry.dlo import Dlo
from lslam.odometry.frontend.register_scans import estimate
from lslam.simulation.scenarios import SimulatedDrive, simulate

COUNT = 40


def dlo(*settings: str) -> Dlo:
    method = create_odometry(load_config(None, ["odometry.method=dlo", *settings], {}))
    assert isinstance(method, Dlo)
    return method


def error_of(results: list[ScanResult], truth: NDArray[np.float64]) -> float:
    """Distance, m, of the last pose from the true one, both from the first scan on."""
    found = np.linalg.inv(results[0].T_world_lidar) @ results[-1].T_world_lidar
    true = np.linalg.inv(truth[0]) @ truth[len(results) - 1]
    return float(np.linalg.norm(found[:3, 3] - true[:3, 3]))


@cache
def drive() -> SimulatedDrive:
    return simulate("residential", seed=3, lidar="vlp16", count=COUNT)


@cache
def followed() -> tuple[Dlo, list[ScanResult]]:
    method = dlo()
    return method, list(estimate(drive(), method))


def true_poses() -> NDArray[np.float64]:
    truth = drive().ground_truth
    assert truth is not None
    return truth.poses


def test_a_drive_is_followed_on_few_keyframes() -> None:
    method, results = followed()
    assert all(r.status == "ok" for r in results)
    assert {"scan", "map"} <= set(results[-1].stages)
    assert all(r.covariance is not None for r in results)
    assert error_of(results, true_poses()) < 0.1
    target = method.registration.target.scans
    assert 2 <= len(target.poses) < COUNT  # type: ignore[attr-defined]


def test_the_submap_corrects_what_the_last_scan_alone_gives() -> None:
    """Scan to scan, errors add up: the same drive without its submap ends farther from the truth."""
    both = error_of(followed()[1], true_poses())
    settings = ["odometry.method=gicp", "registration.target=scan"]
    alone = error_of(list(estimate(drive(), create_odometry(load_config(None, settings, {})))), true_poses())
    assert both < alone


def test_a_start_at_thirty_metres_a_second_is_found_by_the_search() -> None:
    motorway = simulate(
        "motorway", seed=1, lidar="hdl64", count=5, speed=30.0, start_speed=30.0, motion_compensated=True
    )
    truth = motorway.ground_truth
    assert truth is not None
    found, blind = (list(estimate(motorway, dlo(f"recovery.start_search={word}"))) for word in ("true", "false"))
    assert error_of(found, truth.poses) < 0.1
    assert error_of(blind, truth.poses) > 5.0
