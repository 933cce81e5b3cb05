"""A simulated vehicle with two LiDARs, distorted scans: merged they are followed no worse than one, by any way into lslam."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from two_lidars import WAYS, merged, two_lidars

import lslam
from lslam.core.config import load_config
from lslam.core.types.sequence import Sequence
from lslam.registration.preprocessing.views import RINGS_APART
from lslam.simulation.scenarios import SimulatedDrive

SHARES_TOWNS = True
COUNT = 12
HALF_MS = 50.0


@cache
def drive(offset_ms: float) -> SimulatedDrive:
    return two_lidars("block", COUNT, offset_ms, imu="icm20948")


def ate(sequence: Sequence, method: str, uses_imu: bool) -> float:
    """m, against the simulated truth; every scan is registered."""
    settings = [f"odometry.method={method}", f"imu.use={str(uses_imu).lower()}", "map.write=false", "report.html=false",
                "loops.use=false"]  # fmt: skip
    outcome = lslam.run(sequence, load_config(None, settings, {}))
    assert [result.status for result in outcome.record.results] == ["ok"] * len(sequence)
    assert outcome.evaluation is not None
    error = outcome.evaluation.scores["ate"]["se3"].translation
    assert error is not None
    return float(error.rmse)


@cache
def ate_of_one(method: str, uses_imu: bool) -> float:
    return ate(drive(0.0), method, uses_imu)


@pytest.fixture(scope="module")
def read(tmp_path_factory: pytest.TempPathFactory) -> Callable[[float, str, str], Sequence]:
    """`read(offset_ms, way, kind)`: the drive of both, written once for all methods."""
    return cache(lambda offset_ms, way, kind: merged(drive(offset_ms), tmp_path_factory.mktemp("merged"), way, kind))


FOLDERS, FRAMES, TOPICS = (0.0, "folders", ""), (HALF_MS, "frames", "mcap"), (HALF_MS, "topics", "bag")


@pytest.mark.parametrize(
    ("written", "method", "uses_imu"),
    [
        (FOLDERS, "icp", False), (TOPICS, "icp", False), (FRAMES, "icp", True), (TOPICS, "loam", True),
    ],
)  # fmt: skip
def test_two_lidars_are_no_worse_than_one(
    read: Callable[[float, str, str], Sequence], written: tuple[float, str, str], method: str, uses_imu: bool
) -> None:
    sequence = read(*written)
    assert not sequence.problems
    assert ate(sequence, method, uses_imu) < 1.5 * ate_of_one(method, uses_imu) + 0.005


def test_a_drive_that_begins_in_a_turn_is_followed_from_its_first_scan(tmp_path: Path) -> None:
    """At 50 deg/s two LiDARs that look opposite ways see a wall 2.5 deg apart: undeskewed clouds have it twice."""
    sequence = merged(two_lidars("walk", 6), tmp_path)
    settings = ["odometry.method=icp", "map.write=false", "report.html=false", "loops.use=false"]
    outcome = lslam.run(sequence, load_config(None, settings, {}))
    assert [result.status for result in outcome.record.results] == ["ok"] * 6
    assert outcome.evaluation is not None
    error = outcome.evaluation.scores["ate"]["se3"].translation
    assert error is not None
    assert error.rmse < 0.05
    alone = lslam.run(sequence, load_config(None, [*settings, "input.threads=1"], {}))
    for a, b in zip(outcome.record.results, alone.record.results, strict=True):
        np.testing.assert_array_equal(a.T_world_lidar, b.T_world_lidar)


@pytest.mark.parametrize("way", WAYS)
def test_every_point_lies_where_it_was_measured(tmp_path: Path, way: str) -> None:
    """By the true poses at the instants that the merged scans state, the rear LiDAR's points are those of its own scans."""
    two = drive(HALF_MS)
    (rear,), (mount,) = two.further, two.scenario.lidars
    sequence = merged(two, tmp_path, way)
    in_merged, in_own = [], []
    for k in range(3, 9):
        scan = sequence.scan(k)
        assert scan.times is not None
        assert scan.rings is not None
        T = two.vehicle.poses(1e-9 * scan.stamp_ns + scan.times.astype(np.float64))
        places = np.einsum("nij,nj->ni", T[:, :3, :3], scan.points.astype(np.float64)) + T[:, :3, 3]
        in_merged.append(places[scan.rings >= RINGS_APART])
    for k in range(1, 10):
        scan = rear.scan(k)
        assert scan.times is not None
        T = two.vehicle.poses(1e-9 * scan.stamp_ns + scan.times.astype(np.float64)) @ mount.T_lidar_other
        in_own.append(np.einsum("nij,nj->ni", T[:, :3, :3], scan.points) + T[:, :3, 3])
    apart, nearest = cKDTree(np.concatenate(in_own)).query(np.concatenate(in_merged))
    assert apart.max() < 1e-4
    assert len(np.unique(nearest)) == len(nearest), "none is there twice"
