"""Method `icp` behind the Odometry protocol: what it reports, how it gets over bad scans, and that it is deterministic."""

from __future__ import annotations

import copy
import hashlib
import subprocess
import sys
import threading
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.config.config import Config
from lslam.core.geometry import se3
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.odometry import create_odometry
from lslam.odometry.icp import Icp, create
from lslam.odometry.inertial.constant_velocity import ConstantVelocity
from lslam.simulation.scenarios import simulate

Floats = NDArray[np.float64]
BAD = 15


@cache
def block(seed: int = 0) -> tuple[tuple[Scan, ...], Floats]:
    """All 95 scans of the sample drive and their true poses."""
    drive = simulate("block", seed=seed)
    assert drive.ground_truth is not None
    return tuple(drive), drive.ground_truth.poses


def feed(icp: Icp, scan: Scan, prior: MotionPrior) -> ScanResult:
    prepared = icp.prepare(scan)
    return icp.update(scan, prior, icp.register(scan, prepared, prior))


class Driver:
    """The front end's loop with its odometry at hand: predict, prepare, register, correct."""

    def __init__(self) -> None:
        self.icp: Icp = create(Config())
        self.motion = ConstantVelocity()

    def feed(self, scan: Scan) -> ScanResult:
        prior = MotionPrior.at_once(self.motion.predict(scan.stamp_ns))
        result = feed(self.icp, scan, prior)
        self.motion.correct(scan.stamp_ns, result.T_world_lidar)
        return result


@cache
def _warmed() -> Driver:
    driver = Driver()
    scans, _ = block()
    for scan in scans[:BAD]:
        assert driver.feed(scan).status == "ok"
    return driver


def warmed() -> Driver:
    """A driver that has registered the first scans; every test has its own copy."""
    return copy.deepcopy(_warmed())


def metres(result: ScanResult, true_pose: Floats) -> float:
    return float(np.linalg.norm(result.T_world_lidar[:3, 3] - true_pose[:3, 3]))


def test_a_result_carries_the_facts_of_its_scan() -> None:
    scans, truth = block()
    driver = warmed()
    result = driver.feed(scans[BAD])
    assert (result.index, result.stamp_ns, result.status, result.reason) == (BAD, scans[BAD].stamp_ns, "ok", "")
    assert metres(result, truth[BAD]) < 0.03
    assert result.converged
    assert 1 <= result.iterations <= 10
    assert 0 < result.inliers <= result.source_points
    assert 0.5 < result.overlap <= 1.0
    assert 0.01 < result.rmse < 0.1
    assert set(result.stages) == {"register", "update"}
    assert all(seconds > 0 for seconds in result.stages.values())
    own, world = result.registration_covariance, result.covariance
    assert own is not None
    assert world is not None
    assert np.linalg.eigvalsh(own).min() > 0
    assert np.linalg.eigvalsh(world - own).min() > -1e-15


def bad_points(kind: str) -> NDArray[np.float32]:
    rng = np.random.default_rng(1)
    if kind == "noise":
        return rng.uniform(-40, 40, (6400, 3)).astype(np.float32)
    if kind == "nan":
        return np.full((6400, 3), np.nan, np.float32)
    if kind == "far":
        return rng.uniform(1e6, 1e9, (6400, 3)).astype(np.float32)
    if kind == "empty":
        return np.zeros((0, 3), np.float32)
    scans, _ = block()
    return scans[{"kidnapped 20 m": 40, "kidnapped 30 m": 50, "kidnapped 37 m": 60}[kind]].points


@pytest.mark.parametrize("kind", ["noise", "nan", "far", "empty", "kidnapped 20 m", "kidnapped 30 m", "kidnapped 37 m"])
def test_a_bad_scan_is_bridged_without_changing_the_map_and_the_next_is_registered(kind: str) -> None:
    scans, truth = block()
    driver = warmed()
    target = driver.icp.registration.map
    before = copy.deepcopy(target)
    expected = driver.motion.predict(scans[BAD].stamp_ns)
    result = driver.feed(replace(scans[BAD], points=bad_points(kind), intensity=None, rings=None))
    assert result.status == "bridged"
    assert result.reason
    assert not result.converged
    np.testing.assert_array_equal(result.T_world_lidar, expected)
    for name in ("moments", "planes", "keys", "table"):
        np.testing.assert_array_equal(getattr(target.fine, name), getattr(before.fine, name))
    assert result.covariance is not None
    assert np.sqrt(result.covariance[0, 0]) > 0.4
    for k in (BAD + 1, BAD + 2, BAD + 3):
        good = driver.feed(scans[k])
        assert good.status == "ok"
        assert metres(good, truth[k]) < 0.04
        assert good.covariance is not None
        assert np.sqrt(good.covariance[0, 0]) < 0.05


def test_scans_from_elsewhere_are_rejected_by_a_young_map() -> None:
    """Few points agree with a young map, and of those from elsewhere hardly fewer than of the map's own second scan."""
    scans, truth = block()
    driver = Driver()
    for k in range(9):
        elsewhere = [i for i in range(k + 20, 95, 17) if np.linalg.norm(truth[i, :3, 3] - truth[k, :3, 3]) > 12]
        for i in elsewhere[: 2 if k > 2 else 0]:
            prior = MotionPrior.at_once(driver.motion.predict(scans[k].stamp_ns))
            carried = driver.icp.register(scans[i], driver.icp.prepare(scans[i]), prior)
            assert not carried.ok, (k, i)
        assert driver.feed(scans[k]).status == "ok"


def test_five_bad_scans_in_a_row_are_bridged_by_constant_velocity() -> None:
    scans, truth = block()
    driver = warmed()
    for k in range(BAD, BAD + 5):
        assert driver.feed(replace(scans[k], points=bad_points("noise"))).status == "bridged"
    found = driver.feed(scans[BAD + 5])
    assert found.status == "ok"
    assert metres(found, truth[BAD + 5]) < 0.05


def test_scans_of_another_place_are_bridged_before_they_are_accepted() -> None:
    scans, _ = block()
    driver = warmed()
    statuses = [
        driver.feed(replace(scans[k], stamp_ns=scans[k - 25].stamp_ns)).status for k in range(BAD + 25, BAD + 32)
    ]
    assert statuses[:2] == ["bridged", "bridged"]


def test_preparation_does_not_depend_on_other_scans() -> None:
    scans, _ = block()
    used, fresh = warmed().icp, create(Config())
    for k in (0, 30):
        a, b = used.prepare(scans[k]), fresh.prepare(scans[k])
        assert a.source.tobytes() == b.source.tobytes()
        assert a.map_points.tobytes() == b.map_points.tobytes()


def test_warming_up_leaves_no_trace() -> None:
    warm, cold = create(Config()), create(Config())
    warm.warm_up()
    assert len(warm.registration.map) == 0
    scans, _ = block()
    prior = MotionPrior.at_once(np.eye(4))
    for k in (0, 1):
        a, b = (feed(icp, scans[k], prior) for icp in (warm, cold))
        assert a.T_world_lidar.tobytes() == b.T_world_lidar.tobytes()


def digest(count: int = 12) -> str:
    """Of poses and covariances of the first scans, scans being prepared ahead by another thread."""
    scans, _ = block()
    driver = Driver()
    prepared: dict[int, object] = {}
    thread = threading.Thread(target=lambda: prepared.update({s.index: driver.icp.prepare(s) for s in scans[:count]}))
    thread.start()
    thread.join()
    out = hashlib.sha256()
    for scan in scans[:count]:
        result = driver.feed(scan)
        out.update(result.T_world_lidar.tobytes() + np.asarray(result.covariance).tobytes())
    return out.hexdigest()


@pytest.mark.unperturbed
@pytest.mark.usefixtures("starts_sought_anew")
def test_the_same_drive_gives_the_same_bytes_twice_and_in_another_process() -> None:
    expected = digest()
    assert digest() == expected
    code = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); import test_icp as t; print(t.digest())"
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert other.stdout.strip() == expected


def test_the_configuration_reaches_the_method() -> None:
    config = Config.model_validate(
        {"registration": {"voxel_size": 1.1}, "preprocess": {"map_leaf": 0.4, "range_max": 50}}
    )
    icp = create_odometry(config)
    assert isinstance(icp, Icp)
    assert icp.registration.map.fine.size == 1.1
    assert icp.registration.map.fine.reach == pytest.approx(60.0)
    assert icp.registration.preprocess.map_leaf == 0.4


def test_world_covariance_grows_with_the_way_driven() -> None:
    driver = warmed()
    scans, _ = block()
    first = driver.feed(scans[BAD]).covariance
    for k in range(BAD + 1, BAD + 25):
        last = driver.feed(scans[k]).covariance
    assert first is not None
    assert last is not None
    assert np.trace(last[3:, 3:]) > 1.2 * np.trace(first[3:, 3:])
    assert np.linalg.norm(se3.relative(np.eye(4), driver.motion.predict(0))[:3, 3]) > 10.0


def test_a_restart_keeps_the_accumulation_of_covariances() -> None:
    """From scan to scan every registration's error enters in full, before a restart and after it."""
    scans, _ = block()
    traces = []
    for is_restarted in (False, True):
        icp = create(Config.model_validate({"registration": {"target": "scan"}}))
        if is_restarted:
            icp.restart()
        motion = ConstantVelocity()
        for scan in scans[:6]:
            result = feed(icp, scan, MotionPrior.at_once(motion.predict(scan.stamp_ns)))
            motion.correct(scan.stamp_ns, result.T_world_lidar)
        assert result.covariance is not None
        traces.append(float(np.trace(result.covariance)))
    assert traces[0] == traces[1]
