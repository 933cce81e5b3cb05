"""Drift added to odometry: it has the configured size."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lslam.backend.added_drift import CAMERA_TO_LIDAR, describe, moved_keyframes, with_drift
from lslam.core.config.backend import DebugConfig
from lslam.core.errors import InputError
from lslam.core.geometry import se3, so3
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.trajectory import Keyframe, Trajectory
from lslam.io.formats.trajectory_lines import write_tum

LINE = se3.make(np.eye(3), np.column_stack([np.linspace(0, 200, 401), np.zeros(401), np.zeros(401)]))
RESULTS = [ScanResult(i, i * 100_000_000, T, covariance=np.eye(6)) for i, T in enumerate(LINE)]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_added_drift_has_the_configured_size(seed: int) -> None:
    straight = with_drift(RESULTS, DebugConfig(drift_deg_per_100m=0, drift_seed=seed))
    assert np.linalg.norm(straight[-1].T_world_lidar[:3, 3] - [200, 0, 0]) == pytest.approx(2.0)
    turned = with_drift(RESULTS, DebugConfig(drift_percent=0, drift_seed=seed))
    assert np.rad2deg(so3.angle(turned[-1].T_world_lidar[:3, :3])) == pytest.approx(1.0)
    tilted = with_drift(
        RESULTS,
        DebugConfig(drift_percent=0, drift_deg_per_100m=0, drift_seed=seed),
        tilt_deg_per_100m=0.5,
    )
    off = so3.log(tilted[-1].T_world_lidar[:3, :3])
    assert np.rad2deg(np.hypot(off[0], off[1])) == pytest.approx(1.0)
    assert off[2] == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_array_equal(turned[0].T_world_lidar, np.eye(4))


def test_seeds_differ_and_repeat() -> None:
    ends = [with_drift(RESULTS, DebugConfig(drift_seed=seed))[-1].T_world_lidar for seed in (0, 0, 1)]
    np.testing.assert_array_equal(ends[0], ends[1])
    assert np.linalg.norm(ends[0] - ends[2]) > 0.1


def test_drift_without_correlation_is_a_random_walk() -> None:
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


def test_a_random_walk_has_the_configured_size_after_a_hundred_metres() -> None:
    """Its variance grows with the way, however that is cut into steps."""
    for every in (1, 8):
        ends = np.stack([
            with_drift(RESULTS[::every], DebugConfig(drift_kind="random-walk", drift_deg_per_100m=0, drift_seed=seed))[-1]
            .T_world_lidar[:3, 3]
            for seed in range(80)
        ])  # fmt: skip
        spread = np.sqrt(((ends - [200, 0, 0]) ** 2).sum(1).mean())
        assert spread == pytest.approx(np.sqrt(2.0), rel=0.15), "1 % of 100 m after 100 m, root two of it after 200"
    turns = [
        with_drift(RESULTS, DebugConfig(drift_kind="random-walk", drift_percent=0, drift_seed=seed))[-1].T_world_lidar
        for seed in range(80)
    ]
    angles = np.rad2deg([so3.log(T[:3, :3])[2] for T in turns])
    assert np.sqrt(np.mean(angles**2)) == pytest.approx(0.5 * np.sqrt(2.0), rel=0.2)
    assert "random walk" in describe(DebugConfig(drift_kind="random-walk"))


@pytest.mark.parametrize("is_camera", [False, True])
def test_recorded_errors_are_those_of_the_run_laid_on_another(is_camera: bool, tmp_path: Path) -> None:
    """Laid on its own truth they give its estimate back; on a run twice as long they begin anew."""
    rng = np.random.default_rng(5)
    step = se3.make(so3.exp(np.array([0.0, 0.0, 0.02])), np.array([0.5, 0.0, 0.0]))
    errors = se3.exp(rng.normal(0, 0.003, (200, 6)))
    real, found = [np.eye(4)], [np.eye(4)]
    for error in errors:
        real.append(real[-1] @ step)
        found.append(found[-1] @ step @ error)
    C = se3.make(CAMERA_TO_LIDAR.T if is_camera else np.eye(3), np.zeros(3))
    stamps = np.arange(201) * 100_000_000
    for name, poses in (("estimate", found), ("truth", real)):
        write_tum(tmp_path / f"{name}.tum", Trajectory(stamps, C @ np.stack(poses) @ se3.inverse(C)))
    config = DebugConfig(
        drift_kind="recorded", drift_recording=(str(tmp_path / "estimate.tum"), str(tmp_path / "truth.tum"))
    )
    results = [ScanResult(i, i * 100_000_000, T) for i, T in enumerate(real)]
    drifted = np.stack([r.T_world_lidar for r in with_drift(results, config)])
    np.testing.assert_allclose(drifted, np.stack(found), atol=1e-5)
    longer = [*real]
    for _ in range(200):
        longer.append(longer[-1] @ step)
    twice = np.stack([
        r.T_world_lidar for r in with_drift([ScanResult(i, i * 100_000_000, T) for i, T in enumerate(longer)], config)
    ])  # fmt: skip
    again = se3.relative(twice[200], twice[200:])
    np.testing.assert_allclose(again, np.stack(found), atol=1e-4)
    assert "estimate.tum" in describe(config)


def test_recorded_errors_need_a_run_that_moved(tmp_path: Path) -> None:
    for name in ("estimate", "truth"):
        write_tum(tmp_path / f"{name}.tum", Trajectory(np.arange(9) * 10**8, np.tile(np.eye(4), (9, 1, 1))))
    files = {"drift_recording": [str(tmp_path / f"{name}.tum") for name in ("estimate", "truth")]}
    with pytest.raises(InputError, match=r"truth\.tum does not move"):
        with_drift(RESULTS, DebugConfig.model_validate({"drift_kind": "recorded", **files}))
    for wrong in ({"drift_kind": "recorded"}, files, {"drift_kind": "random-walk", "drift_memory": 20.0}):
        with pytest.raises(ValueError, match=r"recorded|drift_memory"):
            DebugConfig.model_validate(wrong)


def test_keyframes_follow_their_scans() -> None:
    keyframes = [Keyframe(0, 0, 0, LINE[0]), Keyframe(1, 300, 0, LINE[300], distance=150.0)]
    drifted = with_drift(RESULTS, DebugConfig())
    moved = moved_keyframes(keyframes, drifted)
    np.testing.assert_array_equal(moved[1].T_world_lidar, drifted[300].T_world_lidar)
    assert (moved[1].number, moved[1].distance) == (1, 150.0)
    assert "1 %" in describe(DebugConfig())
