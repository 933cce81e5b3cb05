"""A simulated vehicle with two LiDARs, distorted scans: merged they are followed no worse than one, by any way into lslam."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from bag_builders import START_NS
from test_merged_lidars import folder_of
from two_lidars import T_FRONT_REAR, TwoLidars, two_lidars, write_bag

import lslam
from lslam.config import load_config
from lslam.formats.stamped_csv import write_imu_csv
from lslam.readers import open_sequence
from lslam.types.scan import Scan
from lslam.types.sequence import Sequence
from lslam.types.trajectory import Trajectory

SHARES_TOWNS = True
COUNT = 12
HALF_NS = 50_000_000


@cache
def drive(offset_ns: int) -> TwoLidars:
    return two_lidars("block", COUNT, offset_ns, imu="icm20948")


def truth_of(two: TwoLidars, epoch_ns: int) -> Trajectory:
    truth = two.drive.ground_truth
    assert truth is not None
    return replace(truth, stamps_ns=truth.stamps_ns + epoch_ns)


def opened(path: Path, two: TwoLidars, way: str) -> tuple[Sequence, int]:
    """The merged sequence, and what its stamps are later by than those of the drive."""
    if way == "frames":
        return open_sequence(write_bag(path / "a.mcap", two), lidar_frame="all"), START_NS
    if way == "topics":
        topics = ("/front/points", "/rear/points")
        return open_sequence(write_bag(path / "a.bag", two, "bag", topics), lidar_topic=",".join(topics)), START_NS
    T_lidar_imu, imu = two.drive.calibration.T_lidar_imu, two.drive.imu
    assert T_lidar_imu is not None
    assert imu is not None
    folder_of(path / "rear", two.rear)
    places = f'[lidars]\n"../rear" = {T_FRONT_REAR.tolist()}\n[extrinsics]\nT_lidar_imu = {T_lidar_imu.tolist()}\n'
    folder = folder_of(path / "front", two.front, places)
    write_imu_csv(folder / "imu.csv", imu)
    return open_sequence(folder), 0


def ate(sequence: Sequence, truth: Trajectory, method: str, uses_imu: bool) -> float:
    """m, against the simulated truth; every scan is registered."""
    settings = [f"odometry.method={method}", f"imu.use={str(uses_imu).lower()}", "map.write=false", "report.html=false",
                "loops.use=false"]  # fmt: skip
    outcome = lslam.run(sequence, load_config(None, settings, {}), ground_truth=truth)
    assert [result.status for result in outcome.record.results] == ["ok"] * COUNT
    assert outcome.evaluation is not None
    error = outcome.evaluation.scores["ate"]["se3"].translation
    assert error is not None
    return float(error.rmse)


@cache
def ate_of_one(method: str, uses_imu: bool) -> float:
    return ate(drive(0).drive, truth_of(drive(0), 0), method, uses_imu)


@pytest.mark.parametrize(("method", "uses_imu"), [("icp", False), ("icp", True), ("loam", True)])
@pytest.mark.parametrize(("offset_ns", "way"), [(0, "folders"), (HALF_NS, "frames"), (HALF_NS, "topics")])
def test_two_lidars_are_no_worse_than_one(
    tmp_path: Path, offset_ns: int, way: str, method: str, uses_imu: bool
) -> None:
    sequence, epoch_ns = opened(tmp_path, drive(offset_ns), way)
    assert not sequence.problems
    error = ate(sequence, truth_of(drive(offset_ns), epoch_ns), method, uses_imu)
    assert error < 1.5 * ate_of_one(method, uses_imu) + 0.005


def test_a_drive_that_begins_in_a_turn_is_followed_from_its_first_scan(tmp_path: Path) -> None:
    """At 50 deg/s two LiDARs that look opposite ways see a wall 2.5 deg apart: undeskewed clouds have it twice."""
    two = two_lidars("walk", 6, 0)
    sequence = open_sequence(write_bag(tmp_path / "a.mcap", two), lidar_frame="all")
    settings = ["odometry.method=icp", "map.write=false", "report.html=false", "loops.use=false"]
    outcome = lslam.run(sequence, load_config(None, settings, {}), ground_truth=truth_of(two, START_NS))
    assert [result.status for result in outcome.record.results] == ["ok"] * 6
    assert outcome.evaluation is not None
    error = outcome.evaluation.scores["ate"]["se3"].translation
    assert error is not None
    assert error.rmse < 0.05
    alone = lslam.run(sequence, load_config(None, [*settings, "input.threads=1"], {}))
    for a, b in zip(outcome.record.results, alone.record.results, strict=True):
        np.testing.assert_array_equal(a.T_world_lidar, b.T_world_lidar)


def in_the_city(two: TwoLidars, scan: Scan) -> np.ndarray:
    """(N, 3) where the points of a merged scan lie, by the true pose at the instant of each."""
    assert scan.times is not None
    poses = two.drive.vehicle.poses(1e-9 * (scan.stamp_ns - START_NS) + scan.times.astype(np.float64))
    return np.asarray(np.einsum("nij,nj->ni", poses[:, :3, :3], scan.points.astype(np.float64)) + poses[:, :3, 3])


def test_every_point_lies_where_it_was_measured(tmp_path: Path) -> None:
    """By the true poses at the instants that the merged scans state, the rear LiDAR's points are those of its own scans."""
    two = drive(HALF_NS)
    sequence = open_sequence(write_bag(tmp_path / "a.mcap", two), lidar_frame="all")
    merged = [sequence.scan(k) for k in range(3, 9)]
    places = np.concatenate([in_the_city(two, scan)[scan.rings >= 512] for scan in merged])  # type: ignore[operator]
    own = []
    for scan in two.rear[1:10]:
        assert scan.times is not None
        at = 1e-9 * scan.stamp_ns + scan.times.astype(np.float64)
        poses = two.drive.vehicle.poses(at) @ T_FRONT_REAR
        own.append(np.einsum("nij,nj->ni", poses[:, :3, :3], scan.points) + poses[:, :3, 3])
    from scipy.spatial import cKDTree

    apart, nearest = cKDTree(np.concatenate(own)).query(places)
    assert apart.max() < 1e-4
    assert len(np.unique(nearest)) == len(places), "none is there twice"
