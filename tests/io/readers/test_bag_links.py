"""Extrinsics from /tf: what always says the same is rigid, what moves is named."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from bag_builders import KINDS, START_NS, STEP_NS, SUFFIX, Fill, bag, clouds, imu, together, transforms
from numpy.typing import NDArray

from lslam.core.errors import InputError
from lslam.core.geometry import se3
from lslam.io.readers import open_sequence
from lslam.io.readers.bag import BagSequence
from lslam.pipeline.convert.bag_writer import BagWriter

Pose = NDArray[np.float64]
T_BASE_LIDAR = se3.exp(np.array([0.5, 0, 1.2, 0, 0.1, 0.3]))
T_BASE_IMU = se3.exp(np.array([-0.1, 0.2, 0.4, 0.05, 0, -1.5]))
T_LIDAR_IMU = se3.inverse(T_BASE_LIDAR) @ T_BASE_IMU


def told(pairs: dict[tuple[str, str], Callable[[int], Pose]], count: int = 8, topic: str = "/tf") -> Fill:
    """/tf, all pairs in each message, the k-th by the pair's function of k."""

    def fill(writer: BagWriter) -> None:
        for k in range(count):
            stamp = START_NS + k * STEP_NS
            tree = {pair: pose(k) for pair, pose in pairs.items()}
            writer.write(topic, stamp, writer.messages.transforms(stamp, tree))

    return fill


def fixed(T: Pose) -> Callable[[int], Pose]:
    return lambda _: T


def driving(k: int) -> Pose:
    return se3.exp(np.array([0.3 * k, 0, 0, 0, 0, 0.02 * k]))


def nodding(k: int) -> Pose:
    return T_BASE_LIDAR @ se3.exp(np.array([0, 0, 0, 0, 0.05 * k, 0]))


@pytest.mark.parametrize("kind", KINDS)
def test_what_tf_always_says_alike_is_where_the_imu_sits(tmp_path: Path, kind: str) -> None:
    pairs = {("odom", "base"): driving, ("base", "lidar"): fixed(T_BASE_LIDAR), ("base", "imu"): fixed(T_BASE_IMU)}
    sequence = open_sequence(bag(tmp_path / f"a{SUFFIX[kind]}", together(clouds(3), imu(5), told(pairs)), kind))
    assert isinstance(sequence, BagSequence)
    np.testing.assert_allclose(sequence.calibration.T_lidar_imu, T_LIDAR_IMU, atol=1e-12)
    assert not sequence.problems
    assert not sequence.has_assumed_extrinsics
    assert "extrinsics of the IMU: T_lidar_imu, from /tf, which always says the same of it" in sequence.notes
    assert sequence.uses["/tf"] == "extrinsics"


def test_frames_of_tf_static_have_their_places_in_the_lidar(tmp_path: Path) -> None:
    pairs = {("base", "lidar"): T_BASE_LIDAR, ("base", "mast"): T_BASE_IMU, ("elsewhere", "thing"): np.eye(4)}
    calibration = open_sequence(bag(tmp_path / "a.bag", together(clouds(3), transforms(pairs)))).calibration
    np.testing.assert_allclose(calibration.T_lidar("base"), se3.inverse(T_BASE_LIDAR), atol=1e-12)
    np.testing.assert_allclose(calibration.T_lidar("mast"), T_LIDAR_IMU, atol=1e-12)
    with pytest.raises(InputError, match=r"nothing says where frame thing sits \(known: base, lidar, mast\)"):
        calibration.T_lidar("thing")


def test_tf_fills_in_what_tf_static_leaves_open_and_does_not_overrule_it(tmp_path: Path) -> None:
    wrong = fixed(T_BASE_LIDAR @ driving(3))
    rest = {("base", "lidar"): wrong, ("base", "imu"): fixed(T_BASE_IMU)}
    path = bag(
        tmp_path / "a.bag", together(clouds(3), imu(5), transforms({("base", "lidar"): T_BASE_LIDAR}), told(rest))
    )
    np.testing.assert_allclose(open_sequence(path).calibration.T_lidar_imu, T_LIDAR_IMU, atol=1e-12)
    whole = transforms({("base", "lidar"): T_BASE_LIDAR, ("base", "imu"): T_BASE_IMU})
    sequence = open_sequence(bag(tmp_path / "b.bag", together(clouds(3), imu(5), whole, told(rest))))
    np.testing.assert_allclose(sequence.calibration.T_lidar_imu, T_LIDAR_IMU, atol=1e-12)
    assert isinstance(sequence, BagSequence)
    assert "/tf" not in sequence.uses
    (problem,) = sequence.problems
    assert (
        problem
        == "/tf says another thing of base -> lidar than /tf_static, 0.900 m and 3.4 deg apart: /tf_static counts"
    )


@pytest.mark.parametrize(
    ("lidar", "count", "words"),
    [
        (nodding, 8, "base -> lidar, which changes on /tf (0.000 m and 20.1 deg apart)"),
        (fixed(T_BASE_LIDAR), 1, "base -> lidar, which /tf says only once"),
    ],
)
def test_a_link_that_moves_or_is_told_once_is_named_and_not_used(
    tmp_path: Path, lidar: Callable[[int], Pose], count: int, words: str
) -> None:
    pairs = {("odom", "base"): driving, ("base", "lidar"): lidar}
    still = told({("base", "imu"): fixed(T_BASE_IMU)}, topic="/robot/tf")
    sequence = open_sequence(bag(tmp_path / "a.bag", together(clouds(3), imu(5), told(pairs, count), still)))
    np.testing.assert_array_equal(sequence.calibration.T_lidar_imu, np.eye(4))
    (problem,) = sequence.problems
    assert f"extrinsics: the way from frame lidar to imu leads over {words}, so the IMU is taken to sit" in problem


def test_rounding_and_play_do_not_count(tmp_path: Path) -> None:
    def shaking(k: int) -> Pose:
        return T_LIDAR_IMU @ se3.exp(np.array([2e-4, 0, -1e-4, 1e-4, 0, 0]) * (k % 3))

    sequence = open_sequence(bag(tmp_path / "a.bag", together(clouds(3), imu(5), told({("lidar", "imu"): shaking}))))
    np.testing.assert_allclose(sequence.calibration.T_lidar_imu, T_LIDAR_IMU, atol=1e-3)
    assert not sequence.problems


def test_tf_static_that_contradicts_itself_is_named(tmp_path: Path) -> None:
    first = transforms({("lidar", "imu"): T_LIDAR_IMU @ se3.exp(np.array([0.25, 0, 0, 0, 0, 0]))})
    path = bag(tmp_path / "a.bag", together(clouds(3), imu(5), first, transforms({("lidar", "imu"): T_LIDAR_IMU})))
    sequence = open_sequence(path)
    np.testing.assert_allclose(sequence.calibration.T_lidar_imu, T_LIDAR_IMU, atol=1e-12)
    (problem,) = sequence.problems
    assert (
        problem == "/tf_static says more than one thing of lidar -> imu, 0.250 m and 0.0 deg apart: the last one counts"
    )


def test_truth_of_a_body_is_carried_along_tf(tmp_path: Path) -> None:
    def poses(writer: BagWriter) -> None:
        for k in range(4):
            stamp = START_NS + k * STEP_NS
            message = writer.messages.odometry(stamp, driving(k), "world", "base")
            writer.write("/gt", stamp, message)
            writer.write("/other/gt", stamp, message)

    sequence = open_sequence(
        bag(tmp_path / "a.bag", together(clouds(4), poses, told({("base", "lidar"): fixed(T_BASE_LIDAR)})))
    )
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.poses[3], driving(3) @ T_BASE_LIDAR, atol=1e-9)
    assert any("/gt, the first of 2: /other/gt left out" in note for note in sequence.notes)
