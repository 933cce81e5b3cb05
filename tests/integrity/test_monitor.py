"""The integrity monitor beside poses that are true, frozen or missing, and from a checkpoint on."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.config.config import Config
from lslam.formats.state_files import read_state, write_state
from lslam.integrity.monitor import IntegrityMonitor, Seen
from lslam.preprocessing.prepare import PreparedPoints
from lslam.simulation.lidar_models import LIDARS
from lslam.simulation.scenarios import simulate
from lslam.types.motion_check import MotionCheck
from lslam.types.motion_prior import MotionPrior
from lslam.types.scan import Scan
from lslam.types.scan_result import ScanResult

Floats = NDArray[np.float64]
COUNT = 27


@cache
def street() -> tuple[tuple[Scan, ...], Floats]:
    """Scans along a street, and their true poses."""
    drive = simulate("street", seed=0, count=COUNT, lidar=replace(LIDARS["vlp16"], columns=600))
    assert drive.ground_truth is not None
    return tuple(drive), drive.ground_truth.poses


def new_monitor() -> IntegrityMonitor:
    return IntegrityMonitor(Config().preprocess, Config().registration)


def see(monitor: IntegrityMonitor, poses: Floats, begin: int = 0, end: int = COUNT, lost: range = range(0)) -> None:
    """Have the monitor see scans at the poses (N, 4, 4) that are claimed for them; those `lost` were not registered."""
    for k, scan in enumerate(street()[0][:end]):
        if k >= begin:
            result = ScanResult(k, scan.stamp_ns, poses[k], "bridged" if k in lost else "ok")
            monitor.see(k, scan, None, result, MotionPrior.at_once(poses[k]))


def test_true_poses_are_confirmed() -> None:
    monitor, (_, true) = new_monitor(), street()
    see(monitor, true)
    assert [(check.first, check.last) for check in monitor.checks] == [(k, k + 5) for k in (1, 6, 11, 16, 21)]
    assert all(check.is_conclusive for check in monitor.checks)
    assert np.abs([check.apart for check in monitor.checks]).max() < 0.05


def test_frozen_poses_are_inconsistent() -> None:
    monitor, (_, true) = new_monitor(), street()
    see(monitor, np.concatenate([true[:12], np.repeat(true[11:12], COUNT - 12, axis=0)]))
    assert np.abs([check.apart for check in monitor.checks[:2]]).max() < 0.05
    for check in monitor.checks[2:]:
        moved = true[check.last, :3, 3] - true[check.first, :3, 3]
        assert check.is_conclusive
        assert np.linalg.norm(check.apart[:3]) == pytest.approx(np.linalg.norm(moved), abs=0.05)


def test_the_first_check_after_failed_scans_is_marked() -> None:
    monitor, (_, true) = new_monitor(), street()
    see(monitor, true, lost=range(8, 10))
    assert [(check.last, check.is_after_break) for check in monitor.checks[:3]] == [(6, False), (10, True), (15, False)]


def test_the_monitor_resumes_to_the_last_bit(tmp_path: Path) -> None:
    whole, again, (_, true) = new_monitor(), new_monitor(), street()
    see(whole, true, end=13)
    write_state(tmp_path / "monitor.npz", whole.state())
    again.restore(read_state(tmp_path / "monitor.npz", (MotionCheck, PreparedPoints, Seen)))
    for monitor in (whole, again):
        see(monitor, true, begin=13)
    assert len(again.checks) == len(whole.checks) == 5
    for one, other in zip(whole.checks, again.checks, strict=True):
        np.testing.assert_equal(vars(other), vars(one))
