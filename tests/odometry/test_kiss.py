"""Method `kiss-icp`: the package itself on compensated scans, and poses at the scan's stamp on distorted ones."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from drives import ate
from numpy.typing import NDArray

from lslam.core.config.config import Config
from lslam.core.errors import InputError
from lslam.core.geometry import se3
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.odometry.kiss import Kiss, create
from lslam.registration.preprocessing.prepare import gate_points
from lslam.simulation.scenarios import simulate

pytest.importorskip("kiss_icp")
Floats = NDArray[np.float64]
PRIOR = MotionPrior.at_once(np.eye(4))


@cache
def block(motion_compensated: bool, count: int = 40) -> tuple[tuple[Scan, ...], Floats]:
    drive = simulate("block", seed=0, count=count, motion_compensated=motion_compensated)
    assert drive.ground_truth is not None
    return tuple(drive), drive.ground_truth.poses


def adapter_poses(scans: tuple[Scan, ...], method: Kiss | None = None) -> Floats:
    method = method or create(Config())
    results = [method.register(scan, method.prepare(scan), PRIOR) for scan in scans]
    assert all(r.status == "ok" and r.source_points > 0 for r in results)
    return np.stack([r.T_world_lidar for r in results])


def raw_poses(scans: tuple[Scan, ...], max_range: float = 100.0) -> Floats:
    """What the package says when it is called as its own pipeline does."""
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    config: Any = KISSConfig()
    config.data.max_range = max_range
    config.data.deskew = scans[0].times is not None
    config.mapping.voxel_size = max_range / 100.0
    kiss = KissICP(config)
    poses = []
    for scan in scans:
        times = np.zeros(len(scan)) if scan.times is None else scan.times.astype(np.float64)
        span = float(np.ptp(times)) or 1.0
        kiss.register_frame(scan.points.astype(np.float64), (times - times.min()) / span)
        poses.append(np.array(kiss.last_pose))
    return np.stack(poses)


def test_on_compensated_scans_it_is_the_package_itself() -> None:
    scans, truth = block(True)
    poses = adapter_poses(scans)
    np.testing.assert_allclose(poses, raw_poses(scans), atol=1e-12)
    assert ate(poses, truth) < 0.3


def test_a_range_the_user_sets_reaches_the_package_and_no_other_does() -> None:
    scans, _ = block(True)
    user = Config.model_validate({"preprocess": {"range_max": 40.0}})
    np.testing.assert_allclose(adapter_poses(scans[:10], create(user)), raw_poses(scans[:10], 40.0), atol=1e-12)
    untouched = Config.model_validate({"preprocess": {"map_leaf": 0.5}, "registration": {"voxel_size": 2.0}})
    np.testing.assert_allclose(adapter_poses(scans[:10], create(untouched)), raw_poses(scans[:10]), atol=1e-12)


@pytest.mark.parametrize("passed", [0.0, 0.5])
def test_with_point_times_poses_belong_to_the_stamp_of_the_scan(passed: float) -> None:
    """Where its sweep begins, or in its middle: there they err as the package does where it means its poses, at the end.

    The package's world, and its second pose, lie in the middle of a sweep, since it does not deskew the first two.
    """
    scans, _ = block(False)
    drive = simulate("block", seed=0, count=len(scans), motion_compensated=False)
    begin, sweep = 1e-9 * drive.stamps_ns, 0.1

    def true_at(shares: Floats) -> Floats:
        poses = drive.vehicle.poses(begin + sweep * shares)
        return se3.relative(poses[0], poses)

    raw, truth = raw_poses(scans), true_at(np.full(len(scans), passed))
    if passed > 0:
        scans = tuple(
            replace(s, times=None if s.times is None else s.times - np.float32(sweep * passed)) for s in scans
        )
    ours = adapter_poses(scans)
    own, package = ours - truth, raw - true_at(np.where(np.arange(len(scans)) < 2, 0.5, 1.0))
    apart, moved = (np.linalg.norm(poses[:, :3, 3], axis=1) for poses in (own - package, ours - raw))
    # The motion from the stamp to the end is that of the package, whose steps err.
    assert np.median(apart) < 0.15 * np.median(moved)
    # The first step is whole: neither missing nor doubled.
    step = np.linalg.norm(truth[1, :3, 3])
    assert np.linalg.norm(ours[1, :3, 3]) == pytest.approx(step, rel=0.1)
    np.testing.assert_array_equal(ours[0], np.eye(4))
    steps = np.linalg.norm(np.diff(ours[:, :3, 3], axis=0), axis=1)
    true_steps = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1)
    np.testing.assert_allclose(steps[1:6], true_steps[1:6], rtol=0.35)


def test_points_that_are_not_finite_are_dropped_with_their_times() -> None:
    scans, _ = block(False)
    scan = scans[0]
    points = scan.points.copy()
    points[::7] = np.nan
    method = create(Config())
    kept, times = method.prepare(Scan(points, 0, 0, times=scan.times))
    assert len(kept) == len(times) == np.isfinite(points).all(1).sum()
    assert (times.min(), times.max()) == (0.0, 1.0)


def test_an_empty_scan_is_bridged_and_the_next_one_registered() -> None:
    scans, _ = block(True)
    method = create(Config())
    adapter_poses(scans[:5], method)
    empty = Scan(np.zeros((0, 3), np.float32), 500, 5)
    prior = MotionPrior.at_once(np.diag([1.0, 1.0, 1.0, 1.0]))
    result = method.register(empty, method.prepare(empty), prior)
    assert result.status == "bridged"
    assert result.reason == "0 usable points, 60 needed"
    np.testing.assert_array_equal(result.T_world_lidar, prior.pose)
    assert method.register(scans[5], method.prepare(scans[5]), PRIOR).status == "ok"


def test_an_empty_first_scan_does_not_stop_it() -> None:
    scans, _ = block(True)
    method = create(Config())
    empty = Scan(np.full((3, 3), np.nan, np.float32), 0, 0)
    assert method.register(empty, method.prepare(empty), PRIOR).status == "bridged"
    assert method.register(scans[1], method.prepare(scans[1]), PRIOR).status == "ok"


def test_an_empty_first_scan_does_not_switch_deskewing_off() -> None:
    scans, _ = block(False)
    method = create(Config())
    empty = Scan(np.zeros((0, 3), np.float32), 0, 0, times=np.zeros(0, np.float32))
    method.register(empty, method.prepare(empty), PRIOR)
    np.testing.assert_allclose(adapter_poses(scans[:8], method), adapter_poses(scans[:8]), atol=1e-12)


def test_the_error_about_a_missing_package_names_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "kiss_icp.kiss_icp", None)
    with pytest.raises(InputError, match="pip install kiss-icp"):
        create(Config())


def test_what_the_user_takes_out_is_taken_out_of_kiss_too() -> None:
    scans, _ = block(True)
    everything, _ = create(Config()).prepare(scans[0])
    options: tuple[dict[str, Any], ...] = (
        {"remove_ground": True},
        {"denoise": True},
        {"ego_box": (-10.0, 10.0, -10.0, 10.0, -3.0, 3.0)},
    )
    for option in options:
        config = Config.model_validate({"preprocess": option})
        kept, _ = create(config).prepare(scans[0])
        np.testing.assert_array_equal(kept, scans[0].points[gate_points(scans[0].points, config.preprocess)])
        assert 0 < len(kept) < len(everything)


def test_points_beyond_its_range_are_no_registration() -> None:
    """The package answers with its own prediction, which looks like a pose."""
    scans, _ = block(True)
    method = create(Config())
    adapter_poses(scans[:5], method)
    far = replace(scans[5], points=scans[5].points * np.float32(1e3))
    result = method.register(far, method.prepare(far), PRIOR)
    assert (result.status, result.converged) == ("bridged", False)
    assert "usable points, 60 needed" in result.reason
