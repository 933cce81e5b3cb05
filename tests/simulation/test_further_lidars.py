"""Several LiDARs on one simulated vehicle: their rays, their folders, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lslam.core.errors import ConfigError, UsageError
from lslam.core.geometry import se3, so3
from lslam.core.types.scan import Scan
from lslam.io.formats.sequence_toml import read_sequence_toml
from lslam.io.readers import open_sequence
from lslam.simulation.lidar_models import LIDARS
from lslam.simulation.record import MANIFEST, record
from lslam.simulation.scenario_files import find_scenario, parse_scenario, scenario_text
from lslam.simulation.scenarios import SimulatedDrive, simulate

SHARES_TOWNS = True
COUNT = 3
LIDAR = replace(LIDARS["vlp16"], columns=300)
REAR = 'name = "rear", place = [-1.6, 0.4, -0.2], rpy_deg = [0, 3, 172], offset_ms = 50'
TOP = 'name = "top", lidar = "sample", place = [0, 0, 0.5]'


def drive(*mounts: str, count: int = COUNT) -> SimulatedDrive:
    lidars = ", ".join(f"{{{mount}}}" for mount in mounts)
    return simulate("block", seed=3, lidar=LIDAR, count=count, motion_compensated=False, imu="ideal",
                    settings=[f"lidars=[{lidars}]"])  # fmt: skip


def same(a: Scan, b: Scan) -> bool:
    return a.points.tobytes() == b.points.tobytes() and a.stamp_ns == b.stamp_ns


def test_the_leading_lidar_sees_the_same_with_others_beside_it() -> None:
    alone, two, three = drive(), drive(REAR), drive(REAR, TOP)
    assert alone.further == []
    assert same(alone.scan(1), two.scan(1))
    assert same(two.further[0].scan(1), three.further[0].scan(1))


def test_every_ray_of_another_lidar_ends_on_the_town() -> None:
    """From where the mount is at its instant each ray is as long as to the first wall, by the noise of ranges."""
    two = drive(REAR)
    (rear,) = two.further
    T_lidar_other = se3.make(so3.from_euler_rpy(np.radians([0, 3, 172])), np.array([-1.6, 0.4, -0.2]))
    assert rear.stamps_ns.tolist() == [50_000_000, 150_000_000], "a third sweep would end after the drive"
    scan = rear.scan(1)
    assert scan.times is not None
    assert scan.stamp_ns == 150_000_000
    T = two.vehicle.poses(0.15 + scan.times.astype(np.float64)) @ T_lidar_other
    ranges = np.linalg.norm(scan.points, axis=1)
    rays = np.einsum("nij,nj->ni", T[:, :3, :3], scan.points / ranges[:, None])
    far, _ = two.scene.cast(T[:, :3, 3].astype(np.float32), rays.astype(np.float32))
    assert np.median(np.abs(far - ranges)) < LIDAR.range_noise
    assert np.percentile(np.abs(far - ranges), 95) < 4 * LIDAR.range_noise


def test_another_lidar_has_noise_truth_and_extrinsics_of_its_own() -> None:
    twin = drive(f"{REAR[:13]}, place = [0, 0, 0]")
    (other,) = twin.further
    assert abs(len(twin.scan(0)) - len(other.scan(0))) < 0.02 * len(twin.scan(0))
    assert not same(twin.scan(0), other.scan(0))
    two = drive(REAR)
    (rear,) = two.further
    assert rear.ground_truth is not None
    T = two.scenario.lidars[0].T_lidar_other
    poses = two.vehicle.poses(np.array([0.05, 0.15])) @ T
    np.testing.assert_allclose(rear.ground_truth.poses[1], se3.relative(poses[0], poses[1]), atol=1e-9)
    T_lidar_imu, T_rear_imu = two.calibration.T_lidar_imu, rear.calibration.T_lidar_imu
    assert T_lidar_imu is not None
    assert T_rear_imu is not None
    np.testing.assert_allclose(T @ T_rear_imu, T_lidar_imu, atol=1e-12)


def test_folders_say_where_the_others_sit_and_are_read_as_one(tmp_path: Path) -> None:
    three = drive(REAR, TOP)
    done = record(three, tmp_path / "out")
    info = read_sequence_toml(done.sequence / "sequence.toml")
    assert info.lidars is not None
    assert [*info.lidars] == ["rear", "top"]
    np.testing.assert_allclose(info.lidars["rear"], three.scenario.lidars[0].T_lidar_other, atol=1e-15)
    counts = [len(scan) for one in (three, *three.further) for scan in one]
    assert done.points == sum(counts)
    said = json.loads((done.sequence / MANIFEST).read_text(encoding="utf-8"))
    assert {name: len(model["elevations_deg"]) for name, model in said["further_lidars"].items()} == {
        "rear": 16, "top": 16,
    }  # fmt: skip
    merged = open_sequence(tmp_path / "out")
    assert merged.problems == []
    scan = merged.scan(1)
    assert scan.lidars is not None
    assert np.bincount(scan.lidars)[0] == len(three.scan(1))
    np.testing.assert_array_equal(scan.points[: len(three.scan(1))], three.scan(1).points)
    alone = open_sequence(done.sequence / "rear")
    assert alone.stamps_ns.tolist() == three.further[0].stamps_ns.tolist()
    np.testing.assert_array_equal(alone.scan(0).points, three.further[0].scan(0).points)


def test_an_interrupted_simulation_goes_on_to_the_same_bytes(tmp_path: Path) -> None:
    def files(out: Path) -> dict[str, bytes]:
        return {
            str(p.relative_to(out)): p.read_bytes() for p in out.rglob("*") if p.suffix in (".bin", ".npz", ".toml")
        }

    def stop(index: int) -> None:
        if index == 1:
            raise KeyboardInterrupt

    record(drive(REAR), tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        record(drive(REAR), tmp_path / "out", on_scan=stop)
    part = tmp_path / "out" / "sequences" / "00.part"
    assert [len(list((part / folder / "velodyne").iterdir())) for folder in (".", "rear")] == [2, 2]
    record(drive(REAR), tmp_path / "out", resume=True)
    assert files(tmp_path / "out") == files(tmp_path / "whole")


@pytest.mark.parametrize(("mounts", "words"), [
    ((REAR, REAR), "the names of folders differ"),
    ((TOP.replace("top", "velodyne"),), "velodyne and per_point are taken"),
    ((TOP.replace("top", "../top"),), "lidars.0.name: String should match pattern"),
    ((TOP.replace("sample", "vlp61"),), "lidar = 'vlp61'; .*vlp16"),
    ((f"{TOP}, offset_ms = 100",), "an offset_ms is shorter than a sweep, 100 ms"),
    ((f"{TOP}, offset = 5",), "lidars.0.offset: Extra inputs"),
])  # fmt: skip
def test_mounts_that_cannot_be_are_refused(mounts: tuple[str, ...], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        drive(*mounts)


def test_one_scan_leaves_none_for_a_lidar_that_begins_later() -> None:
    with pytest.raises(UsageError, match="rear begins its sweeps 50 ms late: at least two scans are needed"):
        drive(REAR, count=1)


def test_a_scenario_with_two_lidars_is_ready_and_reads_back_from_its_text() -> None:
    scenario = find_scenario("two-lidars")
    assert [mount.name for mount in scenario.lidars] == ["rear"]
    from lslam.core.untrusted import parse_toml

    again = parse_scenario("two-lidars", parse_toml(scenario_text(scenario)))
    assert again == scenario
