"""Loam livox: a sweep in pieces, their motion, and a bag as the Livox driver writes it."""

from __future__ import annotations

import struct
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from lslam.core.config import load_config
from lslam.core.geometry import se3
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.io.formats.state_files import read_state, write_state
from lslam.io.readers import open_sequence
from lslam.odometry import create_odometry
from lslam.odometry.frontend.checkpoints import STATE_CLASSES
from lslam.odometry.frontend.register_scans import estimate
from lslam.odometry.frontend.tracker import ScanInput, Tracker
from lslam.odometry.loam_livox import SLOPE_SHARE, join, line_weights
from lslam.registration.result import RegistrationResult
from lslam.simulation.scenarios import simulate

Floats = NDArray[np.float64]
COUNT = 12
MIDDLES = np.array([0.1, 0.3, 0.5]) / 6


def config_of(*settings: str) -> Any:
    return load_config(None, ["odometry.method=loam-livox", *settings], {})


@cache
def scans() -> tuple[list[Scan], Floats]:
    drive = simulate("urban", seed=2, lidar="livox", count=COUNT, motion_compensated=False)
    assert drive.ground_truth is not None
    return [drive.scan(i) for i in range(COUNT)], drive.ground_truth.poses


def tracked(tracker: Tracker, given: list[Scan]) -> list[ScanResult]:
    return [tracker.track(ScanInput(s.index, s.stamp_ns, s, tracker.odometry.prepare(s))) for s in given]


def error(results: list[ScanResult], truth: Floats) -> float:
    found = se3.relative(results[0].T_world_lidar, results[-1].T_world_lidar)
    return float(np.linalg.norm(se3.relative(found, se3.relative(truth[0], truth[-1]))[:3, 3]))


def test_a_drive_is_followed_and_pieces_estimate_the_motion_within_a_sweep() -> None:
    given, truth = scans()
    tracker = Tracker(create_odometry(config_of()))
    results = tracked(tracker, given)
    assert all(r.status == "ok" and not r.posed_by for r in results)
    assert all(r.covariance is not None and np.linalg.eigvalsh(r.covariance)[0] > 0 for r in results)
    assert error(results, truth) < 0.2
    # The next pose is where this sweep ends.
    moved = se3.relative(tracker.sweep.poses[0], tracker.sweep.poses[-1])
    step = se3.relative(truth[-2], truth[-1])
    assert np.linalg.norm(step[:3, 3]) > 0.3
    np.testing.assert_allclose(moved[:3, 3], step[:3, 3], atol=0.05)


def test_loam_livox_resumes_to_the_last_bit(tmp_path: Path) -> None:
    given, _ = scans()
    whole = Tracker(create_odometry(config_of()))
    tracked(whole, given[:6])
    write_state(tmp_path / "6.npz", whole.state())
    again = Tracker(create_odometry(config_of()))
    again.restore(read_state(tmp_path / "6.npz", STATE_CLASSES))
    for one, other in zip(tracked(whole, given[6:9]), tracked(again, given[6:9]), strict=True):
        np.testing.assert_array_equal(one.T_world_lidar, other.T_world_lidar)
        np.testing.assert_array_equal(one.covariance, other.covariance)


def test_a_spinning_lidar_is_followed_along_its_rings() -> None:
    drive = simulate("block", seed=1, lidar="vlp16", count=COUNT, motion_compensated=False)
    assert drive.ground_truth is not None
    results = tracked(Tracker(create_odometry(config_of())), [drive.scan(i) for i in range(COUNT)])
    assert all(r.status == "ok" for r in results)
    assert error(results, drive.ground_truth.poses) < 0.2


def pieces(poses: list[Floats], ok: tuple[bool, ...] = (True, True, True)) -> list[RegistrationResult]:
    return [
        RegistrationResult(
            p, ok=good, reason="" if good else "lost", covariance=np.eye(6), source_points=100, matched=80
        )
        for p, good in zip(poses, ok, strict=True)
    ]


def test_pieces_that_agree_move_the_sweep_and_pieces_that_differ_bend_it() -> None:
    times = np.linspace(0, 0.1, 33)
    prior = MotionPrior(times, se3.exp(times[:, None] * np.array([10.0, 0, 0, 0, 0, 1.0])))
    off = se3.exp(np.array([0.1, -0.2, 0.05, 0.01, 0.0, -0.02]))
    located, sweep = join(pieces([prior.pose @ off] * 3), MIDDLES, prior)
    np.testing.assert_allclose(located.T_world_lidar, off, atol=1e-12)
    np.testing.assert_allclose(sweep.poses, off @ prior.poses, atol=1e-12)
    assert located.matched == 240
    # Independent thirds: the line's variance at the begin, 3/2 sweeps of a piece before its middle.
    assert located.covariance is not None
    np.testing.assert_allclose(located.covariance, np.eye(6) * (1 / 3 + (1.5 * SLOPE_SHARE) ** 2 / 2), atol=1e-12)
    # 0.3 m/s faster than the prior says.
    faster = [se3.exp(np.array([0.3 * t, 0, 0, 0, 0, 0])) for t in MIDDLES]
    located, sweep = join(pieces(faster), MIDDLES, prior)
    at = 0.3 * (0.05 + SLOPE_SHARE * (times - 0.05))
    np.testing.assert_allclose(sweep.poses[:, 0, 3], prior.poses[:, 0, 3] + at, atol=1e-12)
    np.testing.assert_allclose(located.T_world_lidar, sweep.pose, atol=1e-12)


def test_a_piece_may_fail_and_half_of_them_may_not() -> None:
    prior = MotionPrior(np.linspace(0, 0.1, 33), np.tile(np.eye(4), (33, 1, 1)))
    off = se3.exp(np.array([0.1, 0, 0, 0, 0, 0]))
    located, sweep = join(pieces([off, np.eye(4), off], (True, False, True)), MIDDLES, prior)
    assert located.ok
    np.testing.assert_allclose(sweep.poses, np.tile(off, (33, 1, 1)), atol=1e-12)
    located, sweep = join(pieces([off, np.eye(4), off], (True, False, False)), MIDDLES, prior)
    assert not located.ok
    assert located.reason == "lost"
    assert sweep is prior
    np.testing.assert_allclose(line_weights(MIDDLES, np.linspace(0, 0.1, 5)).sum(axis=1), 1.0)


POINT = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line"
CUSTOM = (
    "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
    "livox_ros_driver/CustomPoint[] points"
)
ROW = np.dtype("<u4, <f4, <f4, <f4, u1, u1, u1")


def custom_message(scan: Scan) -> bytes:
    """A CustomMsg of ROS 1 in its bytes."""
    assert scan.times is not None
    assert scan.intensity is not None
    assert scan.rings is not None
    rows = np.zeros(len(scan), ROW)
    columns = [
        np.round(scan.times * 1e9),
        *scan.points.T,
        np.round(scan.intensity * 100),
        np.full(len(scan), 16),
        scan.rings,
    ]
    for name, values in zip(ROW.names or (), columns, strict=True):
        rows[name] = values
    seconds, ns = divmod(scan.stamp_ns, 10**9)
    head = struct.pack("<III", scan.index, seconds, ns) + struct.pack("<I", 11) + b"livox_frame"
    return head + struct.pack("<QIBBBBI", scan.stamp_ns, len(scan), 1, 0, 0, 0, len(scan)) + rows.tobytes()


def test_a_bag_of_the_livox_driver_is_run_like_the_scans_it_was_made_of(tmp_path: Path) -> None:
    given, truth = scans()
    store = get_typestore(Stores.ROS1_NOETIC)
    kind = "livox_ros_driver/msg/CustomMsg"
    store.register(get_types_from_msg(POINT, "livox_ros_driver/msg/CustomPoint"))
    store.register(get_types_from_msg(CUSTOM, kind))
    start = 1_700_000_000_000_000_000
    with Writer(tmp_path / "a.bag") as writer:
        connection = writer.add_connection("/livox/lidar", kind, typestore=store)
        for scan in given:
            later = replace(scan, stamp_ns=start + scan.stamp_ns)
            writer.write(connection, later.stamp_ns, custom_message(later))
    sequence = open_sequence(tmp_path / "a.bag")
    assert len(sequence) == COUNT
    results = list(estimate(sequence, create_odometry(config_of())))
    assert all(r.status == "ok" for r in results)
    assert error(results, truth) < 0.2
    once = tracked(Tracker(create_odometry(config_of())), given)
    np.testing.assert_allclose(results[-1].T_world_lidar, once[-1].T_world_lidar, atol=0.02)
