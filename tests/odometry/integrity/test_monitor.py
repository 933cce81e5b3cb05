"""The integrity monitor beside poses that are true, frozen or missing, and from a checkpoint on."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.config.config import Config
from lslam.core.geometry import se3, so3
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import MotionCheck, ScanResult
from lslam.io.formats.state_files import read_state, write_state
from lslam.odometry.integrity.alerts import alerts
from lslam.odometry.integrity.monitor import IntegrityMonitor, ReferenceScan
from lslam.registration.preprocessing.prepare import PreparedPoints
from lslam.simulation.lidar_models import LIDARS
from lslam.simulation.scenarios import simulate

Floats = NDArray[np.float64]
COUNT = 27


@cache
def street() -> tuple[tuple[Scan, ...], Floats]:
    """Scans along a street, and their true poses."""
    drive = simulate("street", seed=0, count=COUNT, lidar=replace(LIDARS["vlp16"], columns=600))
    assert drive.ground_truth is not None
    return tuple(drive), drive.ground_truth.poses


def new_monitor() -> IntegrityMonitor:
    return IntegrityMonitor(Config().preprocess)


def see(monitor: IntegrityMonitor, poses: Floats, begin: int = 0, end: int = COUNT, lost: range = range(0)) -> None:
    """Have the monitor see scans at the poses (N, 4, 4) that are claimed for them; those `lost` were not registered."""
    for k, scan in enumerate(street()[0][:end]):
        if k >= begin:
            result = ScanResult(k, scan.stamp_ns, poses[k], "bridged" if k in lost else "ok")
            monitor.see(k, scan, None, result, MotionPrior.at_once(poses[k]))


def test_true_poses_are_confirmed() -> None:
    monitor, (_, true) = new_monitor(), street()
    see(monitor, true)
    # Neighbours first, as nobody knows how fast the sensor moves.
    assert [(check.first, check.last) for check in monitor.checks] == [
        (0, 1),
        *((k, k + 5) for k in (1, 6, 11, 16, 21)),
    ]
    assert all(check.is_conclusive for check in monitor.checks)
    assert np.abs([check.apart for check in monitor.checks]).max() < 0.05


def test_frozen_poses_are_inconsistent() -> None:
    monitor, (_, true) = new_monitor(), street()
    see(monitor, np.concatenate([true[:12], np.repeat(true[11:12], COUNT - 12, axis=0)]))
    assert np.abs([check.apart for check in monitor.checks[:3]]).max() < 0.05
    assert len(monitor.checks) == 6
    for check in monitor.checks[3:]:
        moved = true[check.last, :3, 3] - true[check.first, :3, 3]
        assert check.is_conclusive
        assert np.linalg.norm(check.apart[:3]) == pytest.approx(np.linalg.norm(moved), abs=0.05)


def test_the_first_check_after_failed_scans_is_marked() -> None:
    monitor, (_, true) = new_monitor(), street()
    see(monitor, true, lost=range(8, 10))
    assert [(check.last, check.is_after_break) for check in monitor.checks[1:4]] == [
        (6, False),
        (10, True),
        (15, False),
    ]


def test_the_monitor_resumes_to_the_last_bit(tmp_path: Path) -> None:
    whole, again, (_, true) = new_monitor(), new_monitor(), street()
    see(whole, true, end=13)
    write_state(tmp_path / "monitor.npz", whole.state())
    again.restore(read_state(tmp_path / "monitor.npz", (MotionCheck, PreparedPoints, ReferenceScan)))
    for monitor in (whole, again):
        see(monitor, true, begin=13)
    assert len(again.checks) == len(whole.checks) == 6
    for one, other in zip(whole.checks, again.checks, strict=True):
        np.testing.assert_equal(vars(other), vars(one))


def test_scans_that_lie_far_apart_are_compared_within_reach_and_not_from_the_claim_alone() -> None:
    """Every fourth scan of the street, at poses that go sideways and turn from the first scan on."""
    monitor, (scans, true) = new_monitor(), street()
    for k, scan in enumerate(scans[::4]):
        wrong = se3.make(so3.exp(np.array([0.0, 0.0, -0.1 * k])), np.array([0.5 * k, 1.5 * k, 0.0]))
        monitor.see(k, scan, None, ScanResult(k, scan.stamp_ns, wrong), MotionPrior.at_once(wrong))
    assert [(check.first, check.last) for check in monitor.checks] == [(0, 1), (1, 3), (3, 5)]
    for check in monitor.checks:
        moved = se3.relative(true[4 * check.first], true[4 * check.last])
        np.testing.assert_allclose(check.found_motion[:3, 3], moved[:3, 3], atol=0.1)
        assert check.is_conclusive
        assert check.agreement > 2 * check.claimed_agreement


def test_the_first_scan_is_compared_where_no_motion_is_left_in_it() -> None:
    scans, true = street()
    turned = true.copy()
    turned[0] = true[0] @ se3.make(so3.exp(np.array([0.0, 0.0, np.deg2rad(15.0)])), np.zeros(3))
    for times_s, first in ((0.1, (1, 2)), (None, (0, 1))):
        monitor = new_monitor()
        for k in range(3):
            times = None if times_s is None else np.linspace(0, times_s, len(scans[k]), dtype=np.float32)
            scan = replace(scans[k], times=times)
            monitor.see(k, scan, None, ScanResult(k, scan.stamp_ns, turned[k]), MotionPrior.at_once(turned[k]))
        assert (monitor.checks[0].first, monitor.checks[0].last) == first
    assert monitor.checks[0].apart[5] == pytest.approx(np.deg2rad(15.0), abs=np.deg2rad(0.3))
    assert monitor.checks[0].agreement > 1.15 * monitor.checks[0].claimed_agreement


def queue(ahead: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """Points on a road, on the sides of two buses, on a house behind, and on the truck ahead, which is so many m farther."""
    ground, sides = (rng.uniform((-15, -6), (20, 6), (n, 2)) for n in (1500, 1500))
    behind, truck = (rng.uniform((-2.5, -1.5), (2.5, 1.5), (n, 2)) for n in (700, 700))
    parts = [
        np.column_stack([ground, np.full(1500, -1.8)]),
        np.column_stack([0.3 * sides[:, 0], np.where(sides[:, 1] > 0, 2.5, -2.5), 0.25 * sides[:, 1]]),
        np.column_stack([np.full(700, -14.0), behind]),
        np.column_stack([np.full(700, 7.0 + ahead), truck]),
    ]
    cloud = np.concatenate(parts) + rng.normal(0, 0.01, (4400, 3))
    return cloud.astype(np.float32)


def test_a_truck_that_drives_off_leaves_standing_and_moving_open() -> None:
    """The sensor stands; its poses follow the truck, which drives off with 2 m/s2 after a second."""
    monitor, rng = new_monitor(), np.random.default_rng(3)
    count = 34
    ahead = np.maximum(0.1 * np.arange(count) - 1.0, 0.0) ** 2
    for k in range(count):
        claimed = se3.make(np.eye(3), np.array([-ahead[k], 0.0, 0.0]))
        scan = Scan(queue(float(ahead[k]), rng), 100_000_000 * k, k)
        monitor.see(k, scan, None, ScanResult(k, scan.stamp_ns, claimed), MotionPrior.at_once(claimed))
    early = [check for check in monitor.checks if check.last <= 10]
    late = [check for check in monitor.checks if check.first > 10]
    assert all(check.rival is None for check in early)
    assert len(late) == 4
    for check in late:
        assert check.rival is not None
        assert abs(check.found_motion[0, 3] - check.claimed_motion[0, 3]) < 0.02
        assert abs(check.rival[0, 3]) < 0.02
    stamps_ns = 100_000_000 * np.arange(count, dtype=np.int64)
    (alert,) = alerts(monitor.checks, np.column_stack([-ahead, np.zeros(count), np.zeros(count)]), stamps_ns)
    assert (alert.first, alert.last) == (12, 31)
    assert "standing and moving explain the scans about equally well" in alert.why
