"""Odometry that runs away on purpose, by as much as it says."""

from __future__ import annotations

import numpy as np
import pytest

from lslam.config.debug import DebugConfig
from lslam.geometry import se3, so3
from lslam.pipeline.drift import describe, moved_keyframes, with_drift
from lslam.types.keyframe import Keyframe
from lslam.types.scan_result import ScanResult

LINE = se3.make(np.eye(3), np.column_stack([np.linspace(0, 200, 401), np.zeros(401), np.zeros(401)]))
RESULTS = [ScanResult(i, i * 100_000_000, T, covariance=np.eye(6)) for i, T in enumerate(LINE)]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_it_drifts_by_what_was_asked_for(seed: int) -> None:
    straight = with_drift(RESULTS, DebugConfig(drift_deg_per_100m=0, drift_seed=seed))
    assert np.linalg.norm(straight[-1].T_world_lidar[:3, 3] - [200, 0, 0]) == pytest.approx(2.0)
    turned = with_drift(RESULTS, DebugConfig(drift_percent=0, drift_seed=seed))
    assert np.rad2deg(so3.angle(turned[-1].T_world_lidar[:3, :3])) == pytest.approx(1.0)
    tilted = with_drift(
        RESULTS,
        DebugConfig(drift_percent=0, drift_deg_per_100m=0, drift_tilt_deg_per_100m=0.5, drift_seed=seed),
    )
    off = so3.log(tilted[-1].T_world_lidar[:3, :3])
    assert np.rad2deg(np.hypot(off[0], off[1])) == pytest.approx(1.0)
    assert off[2] == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_array_equal(turned[0].T_world_lidar, np.eye(4))


def test_seeds_differ_and_repeat() -> None:
    ends = [with_drift(RESULTS, DebugConfig(drift_seed=seed))[-1].T_world_lidar for seed in (0, 0, 1)]
    np.testing.assert_array_equal(ends[0], ends[1])
    assert np.linalg.norm(ends[0] - ends[2]) > 0.1


def test_drift_that_forgets_is_a_random_walk() -> None:
    """Its variance grows with the way, 2 L W (1 - L / W) times the squared rate for a memory L that is short beside W."""
    memory, way = 5.0, 200.0
    settings = [
        DebugConfig(drift_memory=memory, drift_deg_per_100m=0, drift_percent=1.0, drift_seed=seed) for seed in range(60)
    ]
    ends = np.stack([with_drift(RESULTS[::4], config)[-1].T_world_lidar[:3, 3] for config in settings])
    spread = np.sqrt(((ends - [way, 0, 0]) ** 2).sum(1).mean())
    assert spread == pytest.approx(0.01 * np.sqrt(2 * memory * way * (1 - memory / way)), rel=0.15)
    assert "anew after some 5 m" in describe(settings[0])
    assert "steadily" in describe(DebugConfig())


def test_keyframes_follow_their_scans() -> None:
    keyframes = [Keyframe(0, 0, 0, LINE[0]), Keyframe(1, 300, 0, LINE[300], distance=150.0)]
    drifted = with_drift(RESULTS, DebugConfig())
    moved = moved_keyframes(keyframes, drifted)
    np.testing.assert_array_equal(moved[1].T_world_lidar, drifted[300].T_world_lidar)
    assert (moved[1].number, moved[1].distance) == (1, 150.0)
    assert "1 %" in describe(DebugConfig())
