"""Methods `small-gicp` and `open3d-gicp`: accurate on a drive, faithful to their packages, and never garbage."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import small_gicp
from drives import ate, standing
from numpy.typing import NDArray

from lslam.core.config.config import Config
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.odometry import create_odometry
from lslam.odometry.frontend.register_scans import estimate
from lslam.registration.preprocessing.prepare import clean_points
from lslam.simulation.scenarios import simulate

Floats = NDArray[np.float64]
BASELINES = ("small-gicp", "open3d-gicp")
# m of ATE over 36 m of the sample's block, a sparse LiDAR of 16 rings; open3d-gicp keeps no map.
BOUNDS = {"small-gicp": 0.03, "open3d-gicp": 0.4}


def created(method: str) -> Any:
    return create_odometry(Config.model_validate({"odometry": {"method": method}}))


@cache
def block(count: int = 40) -> tuple[tuple[Scan, ...], Floats]:
    drive = simulate("block", seed=0, count=count)
    assert drive.ground_truth is not None
    return tuple(drive), drive.ground_truth.poses


@cache
def results(method: str) -> list[ScanResult]:
    return estimate(simulate("block", seed=0, count=40), created(method))


def at(pose: Floats) -> MotionPrior:
    return MotionPrior.at_once(pose)


@pytest.fixture(autouse=True)
def loadable(request: pytest.FixtureRequest) -> None:
    """Open3D, where it is asked for."""
    spec = getattr(request.node, "callspec", None)
    if spec is not None and spec.params.get("method") == "open3d-gicp":
        request.getfixturevalue("open3d")


@pytest.mark.parametrize("method", BASELINES)
def test_a_drive_is_followed_and_standing_still_would_not_pass(method: str) -> None:
    found, (_, truth) = results(method), block()
    assert all(r.status == "ok" and r.inliers > 30 and 0 < r.overlap <= 1 for r in found)
    assert np.array_equal(found[0].T_world_lidar, np.eye(4))
    assert ate(np.stack([r.T_world_lidar for r in found]), truth) < BOUNDS[method]
    assert ate(standing(truth), truth) > 10 * BOUNDS[method]


def test_small_gicp_is_the_package_itself() -> None:
    scans, truth = block()
    method = created("small-gicp")
    for scan, pose in zip(scans[:1], truth, strict=False):
        method.register(scan, method.prepare(scan), at(pose))
    prior = truth[3]
    ours = method.register(scans[3], method.prepare(scans[3]), at(prior)).T_world_lidar

    def covered(points: Floats) -> Any:
        return small_gicp.preprocess_points(points, downsampling_resolution=0.3, num_threads=2)

    clouds = [covered(clean_points(scans[i].points, Config().preprocess).astype(np.float64))[0] for i in (0, 3)]
    target, tree = covered(clouds[0].points()[:, :3])
    theirs = small_gicp.align(target, clouds[1], tree, prior, max_correspondence_distance=1.0, num_threads=2)
    np.testing.assert_allclose(ours, theirs.T_target_source, atol=1e-6)
    assert np.linalg.norm(ours[:3, 3] - truth[3][:3, 3]) < 0.02


def test_small_gicp_removes_old_keyframes() -> None:
    method = created("small-gicp")
    points = np.random.default_rng(0).uniform(-5, 5, (500, 3))
    for i in range(15):
        method._insert(points, np.diag([1.0, 1, 1, 1]) + np.eye(4, k=3) * i)
    assert len(method._clouds) == 10
    assert method._clouds[0][:, 0].mean() == pytest.approx(5.0 + points[:, 0].mean())


@pytest.mark.parametrize("method", BASELINES)
@pytest.mark.parametrize("bad", ["empty", "nan", "far away", "noise in the sky"])
def test_a_bad_scan_is_bridged_and_the_next_one_registered(method: str, bad: str) -> None:
    scans, truth = block()
    made = created(method)
    for i in range(3):
        assert made.register(scans[i], made.prepare(scans[i]), at(truth[i])).status == "ok"
    points = {
        "empty": np.zeros((0, 3), np.float32),
        "nan": np.full((500, 3), np.nan, np.float32),
        "far away": scans[3].points + np.float32(1e4),
        "noise in the sky": np.random.default_rng(0).uniform(50, 57, (2000, 3)).astype(np.float32),
    }[bad]
    scan = replace(scans[3], points=points, intensity=None, rings=None, times=None)
    result = made.register(scan, made.prepare(scan), at(truth[3]))
    assert (result.status, result.converged) == ("bridged", False)
    assert result.reason
    np.testing.assert_array_equal(result.T_world_lidar, truth[3])
    after = made.register(scans[4], made.prepare(scans[4]), at(truth[4]))
    assert after.status == "ok"
    assert np.linalg.norm(after.T_world_lidar[:3, 3] - truth[4][:3, 3]) < 0.1


@pytest.mark.parametrize("method", BASELINES)
def test_an_impossible_jump_is_rejected(method: str) -> None:
    scans, truth = block()
    config = Config.model_validate({"odometry": {"method": method}, "registration": {"max_jump_m": 0.2}})
    made: Any = create_odometry(config)
    made.register(scans[0], made.prepare(scans[0]), at(truth[0]))
    off = truth[1].copy()
    off[0, 3] += 0.6
    result = made.register(scans[1], made.prepare(scans[1]), at(off))
    assert result.status == "bridged"
    assert "impossible jump" in result.reason
