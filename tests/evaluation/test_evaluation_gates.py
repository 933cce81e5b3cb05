"""Where the comparison of trajectories draws its lines: just inside and just outside of each."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from evaluation_drives import STEP_NS, drive
from numpy.typing import NDArray

from lslam.core.errors import InputError
from lslam.core.geometry import se3, so3
from lslam.core.types.trajectory import Trajectory
from lslam.evaluation.associate import _peaks, associate, estimate_offset
from lslam.evaluation.frames import R_BODY_CAMERA, body_rotation, main_axis, reconcile
from lslam.evaluation.thesis import planar

Floats = NDArray[np.float64]


def straight(xy: Floats, yaw: Floats) -> Floats:
    """Poses (N, 4, 4) at places (N, 2) with headings (N,)."""
    poses = np.tile(np.eye(4), (len(xy), 1, 1))
    poses[:, :2, 3] = xy
    poses[:, 0, 0], poses[:, 0, 1] = np.cos(yaw), -np.sin(yaw)
    poses[:, 1, 0], poses[:, 1, 1] = np.sin(yaw), np.cos(yaw)
    return poses


def test_the_deviations_of_the_second_thesis_are_those_of_all_poses() -> None:
    """Errors of 0, 1 and 3 m lie 1.2472 m about their mean when divided by their number; by one less it were 1.5275 m."""
    truth = straight(np.array([[0.0, 0], [2, 0], [4, 0]]), np.zeros(3))
    aside = planar(straight(np.array([[0.0, 0], [2, 1], [4, 3]]), np.zeros(3)), truth)
    assert (aside.ate_mean, aside.ate_std) == pytest.approx((4 / 3, np.sqrt(14) / 3))
    assert (aside.rpe_translation_mean, aside.rpe_translation_std) == pytest.approx((1.5, 0.5))
    assert aside.spacing == pytest.approx(2.0)
    turned = planar(straight(truth[:, :2, 3], np.array([0.0, 0.1, 0.4])), truth)
    assert (turned.rpe_rotation_mean, turned.rpe_rotation_std) == pytest.approx((0.2, 0.1))


@pytest.mark.parametrize(("truth_ms", "is_interpolated"), [(59, True), (61, False)])
def test_truth_is_interpolated_where_it_is_clearly_denser(truth_ms: int, is_interpolated: bool) -> None:
    """Estimates lie 100 ms apart: at three fifths of that begins what pays."""
    truth = drive(400, step_ns=truth_ms * 1_000_000)
    estimate = drive(150, start_ns=3_000_000)
    assert ("interpolated" in associate(estimate, truth, max_diff=0.05).recipe) == is_interpolated


@pytest.mark.parametrize(("hole_ms", "is_bridged"), [(49, True), (51, False)])
def test_a_hole_of_five_intervals_is_the_longest_that_is_bridged(hole_ms: int, is_bridged: bool) -> None:
    """Truth every 10 ms; the pose at 1 s lies in a hole farther from its edges than stamps may differ."""
    times = np.arange(300) * 10
    inside = (times > 1000 - hole_ms / 2) & (times < 1000 + hole_ms / 2)
    kept = np.sort(
        np.concatenate([times[~inside] * 1_000_000, [(2000 - hole_ms) * 500_000, (2000 + hole_ms) * 500_000]])
    )
    truth = replace(drive(len(kept)), stamps_ns=kept.astype(np.int64))
    assert np.diff(kept).max() == hole_ms * 1_000_000
    stamps = np.array([500_500_000, 1_000_000_000, 1_500_500_000, 2_000_500_000], np.int64)
    found = associate(replace(drive(4), stamps_ns=stamps), truth, max_diff=0.01)
    assert "interpolated" in found.recipe
    assert (1_000_000_000 in found.stamps_ns) == is_bridged


@pytest.mark.parametrize(
    ("degrees", "axis"),
    [(0, "+x"), (36, "+x"), (38, None), (52, None), (54, "+y"), (126, "+y"), (144, "-x"), (180, "-x")],
)
def test_a_body_that_goes_askew_advances_along_no_axis(degrees: float, axis: str | None) -> None:
    """Four fifths of the way along an axis are 36.9 deg off it."""
    direction = np.array([np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))])
    assert main_axis(straight(np.outer(np.arange(20.0), direction), np.zeros(20))) == axis


@pytest.mark.parametrize(("forward", "axis"), [(92, "+x"), (88, None)])
def test_a_body_that_goes_to_and_fro_advances_along_no_axis(forward: int, axis: str | None) -> None:
    """Of 100 steps as many less one go ahead as are said, and the others back: 0.84 or 0.76 of the way is left."""
    steps = np.where(np.arange(100) < forward, 1.0, -1.0)
    x = np.concatenate([[0.0], np.cumsum(steps)])
    assert main_axis(straight(np.column_stack([x, 0 * x]), 0 * x)) == axis


def test_bodies_that_never_move_together_have_no_rotation_between_them() -> None:
    """One drives off when the other has come to rest: no motion is shared, and nothing is divided by that."""
    k = np.arange(60)
    early = straight(np.column_stack([np.minimum(k, 30), 0 * k]), np.minimum(k, 30) / 20)
    late = straight(np.column_stack([np.maximum(k, 30), 0 * k]), np.maximum(k, 30) / 20)
    assert body_rotation(early, late) is None
    np.testing.assert_allclose(body_rotation(early, early), np.eye(3), atol=1e-12)


@pytest.mark.parametrize(("degrees", "is_determined"), [(22.0, False), (26.0, True)])
def test_bodies_that_move_to_either_side_have_a_rotation_between_them(degrees: float, is_determined: bool) -> None:
    """Without a turn, a fifth of what goes ahead must go aside: steps 24.1 deg to the left and right of it."""
    aside = np.deg2rad(degrees) * np.where(np.arange(60) % 2, 1.0, -1.0)
    places = np.cumsum(np.column_stack([np.cos(aside), np.sin(aside)]), axis=0)
    truth = straight(places, np.zeros(60))
    mounted = so3.from_euler_rpy(np.array([0.4, -0.3, 1.2]))
    estimate = truth.copy()
    estimate[:, :3, :3] = mounted.T
    found = body_rotation(estimate, truth)
    assert (found is not None) == is_determined
    if found is not None:
        np.testing.assert_allclose(found, mounted, atol=1e-9)


@pytest.mark.parametrize("is_camera", [(True, False), (False, True)])
def test_the_trajectory_in_the_camera_frame_is_named(is_camera: tuple[bool, bool]) -> None:
    """And converted to the other, when the calibration is known."""
    k = np.arange(60)
    lidar = straight(np.column_stack([k, 5 * np.cos(k / 15)]), np.arctan2(-np.sin(k / 15) / 3, np.ones(60)))
    T_cam0_lidar = se3.make(R_BODY_CAMERA.T, np.array([0.1, -0.2, -0.3]))
    camera = T_cam0_lidar @ lidar @ se3.inverse(T_cam0_lidar)
    given = [camera if is_one else lidar for is_one in is_camera]
    who, other = ("estimate", "ground truth") if is_camera[0] else ("ground truth", "estimate")
    fact = f"{who} is in the camera frame (advances along +z), {other} in the LiDAR frame (advances along +x)"
    unknown, known = (reconcile(*given, ("unknown", "unknown"), T) for T in (None, T_cam0_lidar))
    assert unknown.faults[0].startswith(f"WRONG FRAMES: {fact}")
    assert known.faults == unknown.notes == []
    assert known.notes == [f"{fact}: {who} converted to the LiDAR with T_cam0_lidar"]
    np.testing.assert_allclose([known.estimate, known.truth], [lidar, lidar], atol=1e-9)


def paced(speeds: Floats) -> Trajectory:
    """A straight drive at so many m/s, a pose every 0.1 s."""
    x = np.concatenate([[0.0], np.cumsum(0.1 * speeds)])
    poses = straight(np.column_stack([x, 0 * x]), 0 * x)
    return Trajectory(np.arange(len(x), dtype=np.int64) * STEP_NS, poses)


@pytest.mark.parametrize(("other_noise", "is_refused"), [(0.085, True), (0.105, False)])
def test_an_ambiguous_time_offset_is_not_reported(other_noise: float, is_refused: bool) -> None:
    """Two laps at one rhythm: the estimate is off the first by noise of 0.08 m/s and off the second by its own.

    Their mean squares differ by 1.13 or 1.72; a fifth more is what it takes to tell.
    """
    rng = np.random.default_rng(5)
    k = np.arange(300)
    rhythm = 5 + 2 * np.sin(2 * np.pi * k / 97) + np.sin(2 * np.pi * k / 41)
    slow = np.convolve(rng.normal(size=400), np.ones(20), "valid")[:300]
    slow /= slow.std()
    first, second = rhythm + 0.08 * slow, rhythm - other_noise * slow
    truth = paced(np.concatenate([first, second]))
    estimate = paced(rhythm)
    if is_refused:
        with pytest.raises(InputError, match=r"fit alike; give the offset in seconds"):
            estimate_offset(estimate, truth)
    else:
        assert estimate_offset(estimate, truth)[0] == pytest.approx(0, abs=STEP_NS // 2)


def test_a_time_offset_is_found_through_noise_and_from_a_second_of_motion() -> None:
    """Places with noise of 5 cm every 0.1 s are speeds with noise of 0.7 m/s; a walker's speed changes within half a second."""
    rng, k = np.random.default_rng(1), np.arange(400)
    for wobble, amplitude, noise in ((59, 0.5, 0.05), (9, 0.8, 0.0)):
        speeds = 2 + amplitude * np.sin(2 * np.pi * (k + 3 * np.sin(k / 40)) / wobble)
        truth = paced(speeds)
        poses = truth.poses.copy()
        poses[:, :3, 3] += noise * rng.normal(size=(len(poses), 3))
        estimate = replace(truth, poses=poses, stamps_ns=truth.stamps_ns - 7 * STEP_NS)
        assert estimate_offset(estimate, truth)[0] == pytest.approx(7 * STEP_NS, abs=STEP_NS)


@pytest.mark.parametrize(("good", "poor", "chosen"), [(3, 5, 3), (19, 5, 19), (30, 0, 20)])
def test_shifts_that_are_refined_fit_well_and_are_twenty_at_most(good: int, poor: int, chosen: int) -> None:
    """Scores are 0.8 at least, and no two within a second of each other."""
    scores = np.concatenate([np.linspace(0.95, 0.8, good), np.linspace(0.799, 0.5, poor)])
    lags = 11 * np.arange(good + poor)
    assert _peaks(scores, lags) == list(range(chosen))
    assert _peaks(np.array([0.9, 0.95, 0.85]), np.array([0, 10, 21])) == [1, 2]
