"""The benchmark of speed: what its peers compute is what their own interfaces compute, and what is timed is theirs alone."""

from __future__ import annotations

import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam import Registration
from lslam.core.config import Config, load_config
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.io.readers import open_sequence
from lslam.odometry.inertial.constant_velocity import ConstantVelocity
from lslam.odometry.open3d import create as create_open3d
from lslam.odometry.small_gicp import create as create_small_gicp

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "benchmarks"))

import peers  # noqa: E402
import speed_tables  # noqa: E402

Floats = NDArray[np.float64]
Reference = Callable[[list[Scan]], Floats]
COUNT = 6


@pytest.fixture(scope="module")
def scans() -> list[Scan]:
    """Of the sample: each half a metre on, with times that a sensor would have given them."""
    sequence = open_sequence(ROOT / "sample_data")
    found = [sequence.scan(i) for i in range(COUNT)]
    return [Scan(s.points, s.stamp_ns, s.index, times=np.linspace(0, 0.1, len(s), dtype=np.float32)) for s in found]


def still(scans: list[Scan]) -> list[Scan]:
    return [Scan(s.points, k * peers.SCAN_NS, k) for k, s in enumerate(scans)]


def by_registration(scans: list[Scan]) -> Floats:
    registration = Registration()
    return np.stack([registration.register(scan.points).T_world_lidar for scan in scans])


def by_kiss(scans: list[Scan]) -> Floats:
    from kiss_icp.config import load_config as load_kiss_config
    from kiss_icp.kiss_icp import KissICP

    config = load_kiss_config(None)
    config.data.deskew = scans[0].times is not None
    kiss, poses = KissICP(config), []
    for scan in scans:
        times = np.zeros(len(scan)) if scan.times is None else 10.0 * scan.times.astype(np.float64)
        kiss.register_frame(scan.points.astype(np.float64), times)
        poses.append(np.array(kiss.last_pose))
    return np.stack(poses)


def by_genz(scans: list[Scan]) -> Floats:
    from genz_icp.config import GenZConfig
    from genz_icp.genz_icp import GenZICP

    config = GenZConfig()
    config.data.deskew = scans[0].times is not None
    genz, poses = GenZICP(config), []
    for scan in scans:
        times = np.zeros(0) if scan.times is None else 10.0 * scan.times.astype(np.float64)
        genz.register_frame(scan.points.astype(np.float64), times)
        poses.append(np.array(genz.last_pose))
    return np.stack(poses)


def by_rko(scans: list[Scan]) -> Floats:
    from rko_lio.config import LIOConfig
    from rko_lio.lio import LIO

    lio, poses = LIO(LIOConfig(deskew=scans[0].times is not None)), []
    for scan in scans:
        times = np.zeros(len(scan)) if scan.times is None else scan.times.astype(np.float64)
        stamps = scan.stamp_ns + np.round(1e9 * times).astype(np.int64)
        lio.register_scan(scan.points.astype(np.float64), stamps, np.eye(4))
        poses.append(np.array(lio.pose()))
    return np.stack(poses)


def by_baseline(method: Any, scans: list[Scan]) -> Floats:
    motion, poses = ConstantVelocity(), []
    for scan in scans:
        prior = MotionPrior.at_once(motion.predict(scan.stamp_ns))
        poses.append(method.register(scan, method.prepare(scan), prior).T_world_lidar)
        motion.correct(scan.stamp_ns, poses[-1])
    return np.stack(poses)


def by_small_gicp(scans: list[Scan]) -> Floats:
    return by_baseline(create_small_gicp(load_config(None, [f"input.threads={peers.CORES}"], {})), scans)


def by_open3d(scans: list[Scan]) -> Floats:
    return by_baseline(create_open3d(Config()), scans)


def by_pairs(scans: list[Scan]) -> Floats:
    """small_gicp's plainest call, on arrays."""
    import small_gicp

    clouds = [scan.points[np.linalg.norm(scan.points, axis=1) < 100] for scan in scans]
    poses, step = [np.eye(4)], np.eye(4)
    for before, now in pairwise(clouds):
        step = small_gicp.align(before, now, step, downsampling_resolution=0.25).T_target_source
        poses.append(poses[-1] @ step)
    return np.stack(poses)


def by_voxels(scans: list[Scan]) -> Floats:
    import small_gicp

    model, poses = small_gicp.GaussianVoxelMap(1.0), [np.eye(4), np.eye(4)]
    for k, scan in enumerate(scans):
        near = scan.points[np.linalg.norm(scan.points, axis=1) < 100].astype(np.float64)
        source, _ = small_gicp.preprocess_points(near, downsampling_resolution=0.25)
        guess = poses[-1] @ np.linalg.inv(poses[-2]) @ poses[-1]
        poses.append(np.array(small_gicp.align(model, source, guess).T_target_source) if k else np.eye(4))
        model.insert(source, poses[-1])
    return np.stack(poses[2:])


# The interface, whether the scans hold motion, and how far sums in another order may lead, m: twice the same may be as far apart.
SAME = {
    "icp": (by_registration, False, 1e-12),
    "kiss-icp": (by_kiss, False, 1e-9),
    "kiss-icp, distorted": (by_kiss, True, 1e-9),
    "kiss-icp-python": (by_kiss, False, 1e-9),
    "genz-icp": (by_genz, False, 0.05),
    "genz-icp, distorted": (by_genz, True, 0.05),
    "rko-lio": (by_rko, False, 1e-6),
    "rko-lio, distorted": (by_rko, True, 1e-6),
    "small-gicp": (by_small_gicp, False, 1e-3),
    "small-gicp-scans": (by_pairs, False, 1e-3),
    "small-vgicp": (by_voxels, False, 1e-3),
    "open3d-gicp": (by_open3d, False, 1e-3),
}
PACKAGES = {"genz-icp": "genz_icp", "rko-lio": "rko_lio", "small-gicp": "small_gicp"}


@pytest.mark.parametrize("name", SAME)
def test_a_peer_finds_what_its_own_interface_finds(
    name: str, scans: list[Scan], request: pytest.FixtureRequest
) -> None:
    reference, is_distorted, tolerance = SAME[name]
    method = name.partition(",")[0]
    if method in PACKAGES:
        pytest.importorskip(PACKAGES[method])
    if method == "open3d-gicp":
        request.getfixturevalue("open3d")
    given = scans if is_distorted else still(scans)
    peer = peers.PEERS[method](peers.Beginning(given[: peers.LOOKED_AT]))
    poses, seconds = peers.timed(peer, given)
    np.testing.assert_allclose(poses, reference(given), atol=tolerance)
    # It moved, or they would agree on nothing.
    assert np.linalg.norm(poses[-1, :3, 3]) > 1.0
    assert seconds.shape == (COUNT, 2)
    # A clock of the CPU may stand still for a whole tick of the machine, and so for one scan.
    assert (seconds >= 0).all()
    assert (seconds[1:].sum(axis=0) > 0).all()


class Clock:
    """Both clocks of `time`, which go on when they are told to."""

    def __init__(self) -> None:
        self.wall, self.cpu = 100.0, 50.0

    def spend(self, wall: float, cpu: float) -> None:
        self.wall, self.cpu = self.wall + wall, self.cpu + cpu

    def perf_counter(self) -> float:
        return self.wall

    def process_time(self) -> float:
        return self.cpu


class Slow:
    """Converts for 5 s and registers for 2, one of them a conversion that cannot be done before; with two threads."""

    threads = 2

    def __init__(self, clock: Clock) -> None:
        self.clock = clock

    def convert(self, scan: Scan) -> Scan:
        self.clock.spend(5, 5)
        return scan

    def register(self, converted: Scan) -> Floats:
        self.clock.spend(2, 3)
        return np.eye(4)

    def convert_within(self, converted: Scan) -> None:
        self.clock.spend(1, 1)


def test_conversions_are_not_timed(scans: list[Scan], monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    monkeypatch.setattr(peers, "time", clock)
    _, seconds = peers.timed(Slow(clock), scans)
    np.testing.assert_allclose(seconds, [[1.0, 2.0]] * COUNT)


def test_drive_takes_clouds_that_come_one_by_one(scans: list[Scan]) -> None:
    poses, seconds = peers.drive("icp", (scan.points for scan in scans))
    np.testing.assert_allclose(poses, by_registration(scans), atol=1e-12)
    assert len(seconds) == COUNT


def rounds(*medians: float) -> speed_tables.Rounds:
    """Of a hundred scans and one slow one each; the CPU takes twice as long."""
    walls = [np.array([m] * 100 + [10 * m]) for m in medians]
    return speed_tables.Rounds(tuple(np.stack([w, 2 * w], axis=1) for w in walls), 2)


def test_ratios_are_taken_round_by_round() -> None:
    # The machine was half as fast in the second round: medians of each over the rounds would say 0.75 / 1.5 too, but spread.
    found = {"icp": rounds(0.01, 0.02, 0.01), "kiss-icp": rounds(0.02, 0.04, 0.05), "ndt": rounds(0.1, 0.1, 0.1)}
    assert list(speed_tables.rows_of_ratios("street", found)) == [
        ["street", "icp", "kiss-icp", "0.50 (0.20 to 0.50)", "0.50 (0.20 to 0.50)"]
    ]
    assert list(speed_tables.rows_of_times("street", found))[1] == [
        "street", "kiss-icp", "2", "40.0", "40.0", "1.00", "80.0",
    ]  # fmt: skip


def test_processes_are_set_beside_the_first() -> None:
    found = {"ours": np.array([[1.0, 2.0], [3.0, 2.0]]), "theirs": np.array([[2.0, 8.0], [2.0, 4.0]])}
    assert list(speed_tables.rows_of_processes("street", found)) == [
        ["street", "ours", "2.00", "2.00", "", ""],
        ["street", "theirs", "2.00", "6.00", "1.00 (0.50 to 1.50)", "0.38 (0.25 to 0.50)"],
    ]


def test_every_benchmark_competitor_is_a_peer() -> None:
    assert set(speed_tables.RIVALS) <= set(peers.OURS)
    assert {peer for some in speed_tables.RIVALS.values() for peer in some} == set(peers.PEERS) - set(peers.OURS)
    assert {row[0] for row in speed_tables.PUBLISHED} <= set(peers.OURS)
