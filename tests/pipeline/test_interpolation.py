"""Scans that were not registered lie between those that were, where no IMU and no wheels know better."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stub_sequences import sample

import lslam
from lslam.core.arrays import Floats
from lslam.core.config import load_config
from lslam.core.geometry import se3
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.pipeline.odometry_pass import interpolate_gaps

BAD = slice(20, 24)


def braking_in_a_bend(count: int = 40) -> Floats:
    """(N, 4, 4) poses at 10 Hz of a car that brakes at 3 m/s2 while it turns by 20 deg/s."""
    t = 0.1 * np.arange(count)
    ahead, turn = 13.0 * t - 1.5 * t**2, np.deg2rad(20.0) * t
    path = np.cumsum(
        np.diff(ahead, prepend=0.0)[:, None] * np.stack([np.cos(turn), np.sin(turn), 0 * t], axis=1), axis=0
    )
    return np.stack([se3.exp(np.array([0, 0, 0, 0, 0, a])) for a in turn]) + np.pad(
        path[:, :, None], ((0, 0), (0, 1), (3, 0))
    )


def results(frame_after: int = 0) -> tuple[list[ScanResult], Floats]:
    """Those of the drive, in which scans are bridged by constant velocity, and its true poses."""
    truth = braking_in_a_bend()
    poses, step = truth.copy(), se3.relative(truth[BAD.start - 2], truth[BAD.start - 1])
    for k in range(BAD.start, BAD.stop):
        poses[k] = poses[k - 1] @ step
    made = [
        ScanResult(k, 100_000_000 * k, pose, "bridged" if BAD.start <= k < BAD.stop else "ok")
        for k, pose in enumerate(poses)
    ]
    return [replace(r, frame=frame_after) if r.index >= BAD.stop else r for r in made], truth


def off(found: list[ScanResult], truth: Floats) -> float:
    """m, largest error of the scans that were not registered."""
    poses = np.stack([r.T_world_lidar for r in found])
    return float(np.linalg.norm((poses - truth)[BAD, :3, 3], axis=1).max())


def test_bridged_scans_lie_on_the_course_between_those_before_and_after() -> None:
    bridged, truth = results()
    found = interpolate_gaps(bridged)
    assert off(bridged, truth) > 0.25
    assert off(found, truth) < 0.03
    assert [r.status for r in found] == [r.status for r in bridged]
    for k in (*range(BAD.start), *range(BAD.stop, 40)):
        assert found[k] is bridged[k]


def test_nothing_is_drawn_from_one_frame_to_another_nor_beyond_the_last_scan() -> None:
    for given in (results(frame_after=1)[0], results()[0][: BAD.stop]):
        assert interpolate_gaps(given) == given


def test_a_course_that_turns_back_does_not_swing_out_over_a_long_gap() -> None:
    made, _ = results()
    there = [made[0], *made[:5], *(replace(r, status="skipped") for r in made[5:35]), made[4], made[3]]
    given = [replace(r, index=k, stamp_ns=100_000_000 * k) for k, r in enumerate(there)]
    xs = [r.T_world_lidar[0, 3] for r in interpolate_gaps(given)]
    assert max(xs) <= made[4].T_world_lidar[0, 3] + 1e-9


def test_scans_without_points_in_a_bend_are_where_the_sensor_was() -> None:
    drive = sample(60)
    for k in range(20, 23):
        drive.scans[k] = Scan(np.zeros((0, 3), np.float32), 100_000_000 * k, k)
    settings = ["map.write=false", "loops.use=false", "report.html=false"]
    evaluation = lslam.run(drive, load_config(None, settings, {})).evaluation
    assert evaluation is not None
    assert evaluation.ate["se3"].translation.max == pytest.approx(0.0, abs=0.02)  # type: ignore[union-attr]
