"""When a scan becomes a keyframe."""

from __future__ import annotations

import numpy as np
import pytest

from lslam.core.config.backend import KeyframesConfig
from lslam.core.geometry import se3
from lslam.core.types.scan_result import ScanResult, Status
from lslam.odometry.frontend.keyframing import KeyframeSelector

CONFIG = KeyframesConfig(distance=2.0, angle_deg=15.0)


def result(i: int, x: float = 0.0, yaw_deg: float = 0.0, status: Status = "ok") -> ScanResult:
    pose = se3.exp(np.array([0, 0, 0, 0, 0, np.deg2rad(yaw_deg)]))
    pose[0, 3] = x
    return ScanResult(i, 1000 * i, pose, status, covariance=np.eye(6) * i)


def chosen(results: list[ScanResult], selector: KeyframeSelector | None = None) -> list[int]:
    selector = selector or KeyframeSelector(CONFIG)
    found = [selector.consider(i, r) for i, r in enumerate(results)]
    return [k.scan for k in found if k is not None]


def test_a_keyframe_each_two_metres() -> None:
    assert chosen([result(i, 0.75 * i) for i in range(10)]) == [0, 3, 6, 9]


def test_a_keyframe_each_fifteen_degrees_though_nothing_moves() -> None:
    assert chosen([result(i, 0.0, 4.0 * i) for i in range(12)]) == [0, 4, 8]


def test_a_static_sensor_makes_one_keyframe() -> None:
    assert chosen([result(i, 0.01 * (i % 2)) for i in range(50)]) == [0]


@pytest.mark.parametrize("status", ["bridged", "skipped"])
def test_only_registered_scans(status: Status) -> None:
    results = [result(0, 0.0, 0.0, status), result(1, 0.5), result(2, 3.0, 0.0, status), result(3, 3.2)]
    assert chosen(results) == [1, 3]


def test_a_keyframe_has_its_pose_and_distance_travelled() -> None:
    selector = KeyframeSelector(CONFIG)
    results = [result(0), result(1, 1.5), result(2, 0.0), result(3, 2.5)]
    first, *_, last = (selector.consider(i, r) for i, r in enumerate(results))
    assert first is not None
    assert last is not None
    assert (first.number, first.scan, first.distance) == (0, 0, 0.0)
    assert (last.number, last.scan, last.stamp_ns, last.distance) == (1, 3, 3000, 1.5 + 1.5 + 2.5)
    np.testing.assert_array_equal(last.T_world_lidar, results[3].T_world_lidar)
    np.testing.assert_array_equal(np.asarray(last.covariance), np.eye(6) * 3)


@pytest.mark.parametrize("at", [0, 1, 7, 19])
def test_keyframe_selection_resumes_to_the_last_bit(at: int) -> None:
    results = [result(i, 0.7 * i, 3.0 * i, "skipped" if i < 2 else "ok") for i in range(40)]
    whole = KeyframeSelector(CONFIG)
    expected = [whole.consider(i, r) for i, r in enumerate(results)]
    before, after = KeyframeSelector(CONFIG), KeyframeSelector(CONFIG)
    for i in range(at):
        before.consider(i, results[i])
    after.restore(before.state())
    for i in range(at, len(results)):
        found, wanted = after.consider(i, results[i]), expected[i]
        assert (found is None) == (wanted is None)
        if found is not None and wanted is not None:
            assert (found.number, found.scan, found.distance) == (wanted.number, wanted.scan, wanted.distance)
