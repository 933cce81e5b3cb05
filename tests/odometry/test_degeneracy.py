"""Directions that a scan says nothing about: flagged where the world is a corridor, not where it is a town."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from drives import drive, registered
from numpy.typing import NDArray

from lslam.config.config import Config
from lslam.odometry import create_odometry
from lslam.pipeline.front_end import estimate
from lslam.registration.solver import RegistrationResult
from lslam.simulation.scenarios import SimulatedDrive, simulate
from lslam.types.scan_result import ScanResult

Floats = NDArray[np.float64]


def test_the_weak_axis_of_a_corridor_is_its_length() -> None:
    d = drive("corridor", 0, 100, speed=9.0, compensated=True)
    assert share_along(registered(d.points), d.truth) >= 0.95


def test_it_is_so_for_loam_scan_to_scan_too() -> None:
    """Points of one ring, a few decimetres apart, make normals that waver and seem to see along it."""
    drive = simulate("corridor", seed=0, count=90, speed=9.0, start_speed=9.0, motion_compensated=True)
    assert drive.ground_truth is not None
    assert share_along(by_loam_odom(drive), drive.ground_truth.poses) >= 0.95


def share_along(results: Sequence[RegistrationResult | ScanResult], truth: Floats) -> float:
    """Of the poses that are flagged, those whose weak axis is within ten degrees of the corridor's."""
    weak = [(r, T) for r, T in zip(results, truth, strict=True) if len(r.degenerate)]
    assert len(weak) > 10, "between its piers the corridor gives no hold"
    # Rotations are scaled by the lever arm: a twist along the corridor has no other component.
    cosines = [min(float(np.linalg.norm(r.degenerate[:, :3] @ T[:3, 0])), 1.0) for r, T in weak]
    return float(np.mean(np.degrees(np.arccos(cosines)) < 10.0))


def by_loam_odom(drive: SimulatedDrive) -> list[ScanResult]:
    odometry = create_odometry(Config.model_validate({"odometry": {"method": "loam-odom"}}))
    return estimate(drive, odometry, threads=1)


@pytest.mark.parametrize("scenario", ["street", "urban"])
def test_towns_hold_every_direction(scenario: str) -> None:
    d = drive(scenario, 0, 50, compensated=True)
    flagged = [len(r.degenerate) > 0 for r in registered(d.points)]
    assert np.mean(flagged) < 0.02


@pytest.mark.parametrize(("scenario", "lidar"), [("street", "vlp16"), ("urban", None)])
def test_towns_hold_every_direction_of_loam_scan_to_scan(scenario: str, lidar: str | None) -> None:
    results = by_loam_odom(simulate(scenario, seed=1, count=30, lidar=lidar, motion_compensated=True))
    assert not any(len(r.degenerate) for r in results)
