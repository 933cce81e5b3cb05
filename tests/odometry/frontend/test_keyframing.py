"""Keyframes made during a run: which, of what, and the same with and without a thread."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from stub_sequences import sample

import lslam
from lslam.backend.keyframes.store import KeyframeStore
from lslam.core.config import Config, load_config
from lslam.core.errors import OutputError
from lslam.core.geometry import se3
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.odometry import create_odometry
from lslam.odometry.frontend.keyframing import Keyframing, keyframe_cloud
from lslam.odometry.frontend.register_scans import estimate
from lslam.registration.preprocessing.views import with_rings
from lslam.simulation.scenarios import simulate

AT_ONCE = MotionPrior.at_once(np.eye(4))


def config_of(*settings: str) -> Config:
    return load_config(settings=settings, environ={})


def test_a_run_keeps_its_keyframes(tmp_path: Path) -> None:
    outcome = lslam.run(sample(25), out=tmp_path / "out")
    store = KeyframeStore(tmp_path / "out" / "keyframes")
    assert outcome.record.manifest["keyframes"] == {"count": len(store), "bytes": store.size}
    assert 5 < len(store) < 25
    results = outcome.record.results
    for keyframe in store.keyframes:
        result = results[keyframe.scan]
        np.testing.assert_array_equal(keyframe.T_world_lidar, result.T_world_lidar)
        np.testing.assert_array_equal(np.asarray(keyframe.covariance), np.asarray(result.covariance))
        assert keyframe.stamp_ns == result.stamp_ns
    steps = [
        float(np.linalg.norm(b.T_world_lidar[:3, 3] - a.T_world_lidar[:3, 3]))
        for a, b in zip(store.keyframes, store.keyframes[1:], strict=False)
    ]
    assert min(steps) >= 2.0
    assert max(steps) < 4.5, "no scan that was due is left out"


@pytest.mark.usefixtures("starts_sought_anew")
def test_the_thread_changes_no_byte(tmp_path: Path) -> None:
    for threads in (1, 2):
        settings = (f"input.threads={threads}", "map.write=false", "report.html=false")
        lslam.run(sample(15), config_of(*settings), out=tmp_path / str(threads))
    # The state of odometry has the seconds of each scan.
    files = sorted(f for f in (tmp_path / "1" / "keyframes").iterdir() if f.name != "odometry.npz")
    assert len(files) > 4
    for file in files:
        assert file.read_bytes() == (tmp_path / "2" / "keyframes" / file.name).read_bytes()


@pytest.mark.parametrize(("method", "share"), [("icp", 0.2), ("loam", 0.35), ("small-gicp", 0.2), ("kiss-icp", 0.7)])
def test_distorted_scans_become_straight_clouds_of_every_method(method: str, share: float) -> None:
    """As the true motion would have it; also the first, taken at a speed that nobody knew yet.

    kiss-icp deskews neither of its first two scans and is off in the next ones.
    """
    drive = simulate("block", count=8, speed=12.0, start_speed=12.0, motion_compensated=False)
    assert drive.ground_truth is not None
    poses = drive.ground_truth.poses
    config = config_of(f"odometry.method={method}", "input.rings=elevation")
    store = KeyframeStore()
    with Keyframing(store, config) as keyframing:
        estimate(with_rings(drive, "auto"), create_odometry(config), keyframing=keyframing)
        keyframing.finalise()
    assert [k.scan for k in store.keyframes[:3]] == [0, 2, 4]
    knots = np.linspace(0, 1, 33)
    for keyframe in store.keyframes[:3]:
        step = se3.log(se3.relative(poses[keyframe.scan], poses[keyframe.scan + 1]))
        scan = drive.scan(keyframe.scan)
        truth = MotionPrior(0.1 * knots, se3.exp(knots[:, None] * step))
        whole, crooked = (keyframe_cloud(scan, m, config.preprocess) for m in (truth, AT_ONCE))
        error, before = (mean_distance(cloud, whole) for cloud in (store.points(keyframe.number), crooked))
        assert error < share * before, f"keyframe {keyframe.number}: {error:.3f} m, not deskewed {before:.3f} m"


def mean_distance(points: NDArray[np.float32], others: NDArray[np.float32]) -> float:
    return float(np.mean(cKDTree(others).query(points)[0]))


@pytest.mark.parametrize("threads", [1, 2])
def test_a_store_that_cannot_be_written_ends_the_run(tmp_path: Path, threads: int) -> None:
    (tmp_path / "file").write_text("")
    scan = Scan(np.random.default_rng(0).uniform(-9, 9, (500, 3)).astype(np.float32), 0, 0)
    keyframing = Keyframing(KeyframeStore(tmp_path / "file" / "keyframes"), config_of(f"input.threads={threads}"))

    def use() -> None:
        with keyframing:
            keyframing.see(0, scan, ScanResult(0, 0, np.eye(4)), AT_ONCE)
            keyframing.finalise()

    with pytest.raises(OutputError, match="cannot be written"):
        use()
