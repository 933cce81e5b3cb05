"""The front end: order, bridging, stopping, and the same results with and without reading ahead."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from stub_sequences import Standstill, Stub, noise, sample, with_points

from lslam.core.config import Config, load_config
from lslam.core.geometry import se3
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult, Status
from lslam.core.types.sequence import select
from lslam.odometry import create_odometry
from lslam.odometry.frontend.register_scans import PRIOR_COVARIANCE, diverges, estimate, read_ahead, to_trajectory
from lslam.simulation.scenarios import SimulatedDrive, simulate


def outcomes(*runs: tuple[Status, int]) -> list[ScanResult]:
    statuses = [status for status, times in runs for _ in range(times)]
    return [ScanResult(i, i, np.eye(4), status) for i, status in enumerate(statuses)]


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_scans_come_in_order_and_not_far_ahead(threads: int) -> None:
    stub = Stub([Scan(np.ones((3, 3), np.float32), i, i) for i in range(20)])
    for expected, loaded in enumerate(read_ahead(stub, lambda scan: scan.index * 2, threads)):
        assert (loaded.index, loaded.prepared) == (expected, 2 * expected)
        assert len(stub.reads) <= expected + 5, "the whole recording must not pile up in memory"
    assert stub.reads == list(range(20))


def test_leaving_early_leaves_no_thread_behind() -> None:
    stub = Stub([Scan(np.ones((3, 3), np.float32), i, i) for i in range(1000)])
    ahead = read_ahead(stub, None, 2)
    next(ahead)
    ahead.close()  # type: ignore[attr-defined]
    assert not any(thread.name.startswith("lslam-read") for thread in threading.enumerate())
    assert len(stub.reads) < 10


def test_the_next_scan_is_read_while_this_one_is_worked_on() -> None:
    for threads, ahead in ((1, False), (2, True)):
        read = threading.Event()
        stub = Stub(
            [Scan(np.ones((3, 3), np.float32), i, i) for i in range(10)],
            on_read=lambda index, read=read: read.set() if index == 1 else None,  # type: ignore[misc]
        )
        scans = read_ahead(stub, None, threads)
        next(scans)
        assert read.wait(5.0 if ahead else 0.1) == ahead
        scans.close()  # type: ignore[attr-defined]


def test_what_cannot_be_read_is_bridged_by_the_motion_prior() -> None:
    stub = sample(12)
    stub.scans[6] = "000006.bin: 1001 bytes are not whole points"
    stub.scans[9] = Scan(np.zeros((0, 3), np.float32), 900_000_000, 9)
    results = estimate(stub, create_odometry(Config()))
    assert [r.status for r in results] == ["ok"] * 6 + ["skipped"] + ["ok"] * 2 + ["skipped"] + ["ok"] * 2
    assert results[6].reason.startswith("000006.bin")
    assert "no points" in results[9].reason
    assert stub.ground_truth is not None
    off = np.linalg.norm([r.T_world_lidar[:3, 3] for r in results] - stub.ground_truth.positions, axis=1)
    assert off[[6, 9]].max() < 0.15, "constant velocity for one scan"
    assert off[-1] < 0.05, "and back on the map afterwards"


def test_a_bad_scan_of_a_part_keeps_its_number_in_the_recording() -> None:
    stub = sample(12)
    stub.scans[7] = "gone"
    results = estimate(select(stub, start=1, skip_frames=2), Standstill())
    assert [r.index for r in results] == [1, 3, 5, 7, 9, 11]
    assert results[3].status == "skipped"


def test_noise_is_bridged_and_leaves_the_map_alone() -> None:
    stub = with_points(sample(12), 6, noise(0))
    clean, dirty = (estimate(s, create_odometry(Config())) for s in (sample(12), stub))
    assert dirty[6].status == "bridged"
    assert dirty[6].reason
    assert [r.status for r in dirty[7:]] == ["ok"] * 5
    assert np.linalg.norm(dirty[-1].T_world_lidar[:3, 3] - clean[-1].T_world_lidar[:3, 3]) < 0.02


def test_points_that_are_none_do_not_hurt() -> None:
    clean = sample(8)
    dirty = replace(clean, scans=list(clean.scans))
    for i, scan in enumerate(clean.scans):
        assert isinstance(scan, Scan)
        bad = np.array([[np.nan] * 3, [np.inf, 0, 0], [0, 0, 0], [-np.inf, np.nan, 1], [3e38, 3e38, 3e38]], np.float32)
        dirty.scans[i] = Scan(np.concatenate([bad, scan.points, bad]), scan.stamp_ns, i)
    a, b = (estimate(s, create_odometry(Config())) for s in (clean, dirty))
    for one, other in zip(a, b, strict=True):
        assert other.status == "ok"
        np.testing.assert_allclose(one.T_world_lidar, other.T_world_lidar, atol=2e-3)


@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0])
def test_a_scan_of_nothing_but_invalid_points_is_bridged(value: float) -> None:
    results = estimate(with_points(sample(8), 5, np.full((500, 3), value, np.float32)), create_odometry(Config()))
    assert [r.status for r in results] == ["ok"] * 5 + ["bridged"] + ["ok"] * 2
    assert "0 usable points" in results[5].reason


def test_stops_when_asked_and_otherwise_after_the_last_scan() -> None:
    assert len(estimate(Stub(["gone"] * 50), Standstill())) == 50
    assert len(estimate(sample(10), Standstill(), should_stop=lambda: True)) == 1


def test_diverged_means_that_no_frame_holds_half_of_the_scans() -> None:
    assert not diverges(outcomes(("ok", 2), ("skipped", 1), ("bridged", 1)))
    assert diverges(outcomes(("ok", 1), ("skipped", 3), ("bridged", 1)))
    assert not diverges(outcomes(("ok", 30), ("bridged", 25))), "however many fail in a row"
    assert diverges(outcomes(("skipped", 1)))
    elsewhere = [replace(r, frame=1) for r in outcomes(("ok", 6))]
    assert diverges([*outcomes(("ok", 4)), *elsewhere])
    assert not diverges([*outcomes(("ok", 6)), *elsewhere])


def test_a_skipped_scan_is_more_doubtful_than_the_one_before() -> None:
    known = ScanResult(0, 0, np.eye(4), covariance=np.eye(6) * 1e-4)
    skipped = ScanResult(1, 100, np.eye(4), "skipped", "gone")
    trajectory = to_trajectory([known, skipped, skipped, known], "icp")
    assert trajectory.covariances is not None
    one = np.eye(6) * 1e-4
    np.testing.assert_allclose(
        trajectory.covariances, np.stack([one, one + PRIOR_COVARIANCE, one + 2 * PRIOR_COVARIANCE, one])
    )
    assert to_trajectory([skipped], "kiss-icp").covariances is None
    assert (trajectory.source, trajectory.stamps_ns.tolist()) == ("icp", [0, 100, 100, 0])


def test_distorted_scans_are_deskewed_twice_and_the_first_one_too() -> None:
    """Round a block, rays fired on the way: centimetres become millimetres."""
    drives = [
        simulate("block", seed=seed, count=20, speed=10.0, start_speed=6.0, motion_compensated=False, lidar="vlp16")
        for seed in range(3)
    ]

    def off(drive: SimulatedDrive, *settings: str) -> NDArray[np.float64]:
        results = estimate(drive, create_odometry(load_config(None, list(settings), {})))
        assert all(r.status == "ok" for r in results)
        poses, truth = np.stack([r.T_world_lidar for r in results]), drive.ground_truth.poses
        steps = se3.relative(se3.relative(truth[:-1], truth[1:]), se3.relative(poses[:-1], poses[1:]))
        return np.asarray(np.linalg.norm(steps[:, :3, 3], axis=1))

    # Steps tell what the map holds; its tilt, a milliradian by the first sweep's own acceleration, adds up along the way.
    deskewed, distorted = (
        [off(drive, *settings) for drive in drives] for settings in ([], ["preprocess.deskew=false"])
    )
    # The second scan makes no good of a first one that is left as it was.
    assert np.max(deskewed) < 0.02
    assert np.median(deskewed) < 0.004
    assert np.median(deskewed) < 0.4 * np.median(distorted)
