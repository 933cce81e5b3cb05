"""Coarse to fine: the result of larger consensus is taken, and only with usual agreement once the speed is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from analytic_scenes import pose_at, room, seen_from
from numpy.typing import NDArray
from perturbed_scans import with_other_noise
from recovery_drives import driven

from lslam.core.config.odometry import RecoveryConfig
from lslam.core.geometry import se3
from lslam.registration.preprocessing.prepare import PreparedPoints, prepare_points
from lslam.registration.registration import Registration
from lslam.registration.result import RegistrationResult
from lslam.simulation.scenarios import simulate

Floats = NDArray[np.float64]
# Coarse to fine alone, so that no search decides instead.
ALONE = RecoveryConfig(start_search=False)


def aside(result: RegistrationResult, share: float, y: float = 0.05) -> RegistrationResult:
    """A result `y` m aside, with which a share of the points agrees."""
    moved = result.T_world_lidar @ se3.make(np.eye(3), np.array([0.0, y, 0.0]))
    return replace(result, T_world_lidar=moved, inliers=int(share * result.source_points), matched=result.source_points)


@pytest.mark.parametrize(("coarse", "is_taken"), [(0.9, True), (0.7, False)])
def test_coarse_to_fine_is_accepted_only_with_usual_agreement(
    coarse: float, is_taken: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What hides the map from the fine registration, as passers-by do, hides it from the coarse one, which knows no better."""
    drive = simulate("block", count=8, motion_compensated=True)
    registration = Registration()
    last = [registration.register(drive.scan(i).points) for i in range(8)][-1]
    assert registration.history.starting == 0
    points = prepare_points(drive.scan(7).points, registration.preprocess, 7)
    found, other = aside(last, 0.6, 0.0), aside(last, coarse)
    monkeypatch.setattr(registration.target, "align", lambda *_: found)
    monkeypatch.setattr(registration.target, "coarse_to_fine", lambda *_: other)
    registration.history.agreement.usual = 1.0
    located = registration.locate(points, last.T_world_lidar)
    assert (located.T_world_lidar is other.T_world_lidar) == is_taken
    assert located.pose_source == ("coarse-to-fine" if is_taken else "")


def begun() -> tuple[Registration, PreparedPoints, RegistrationResult]:
    """A registration that knows one scan of the room, the next one, and the result with which it agrees best."""
    registration, rng = Registration(recovery=ALONE), np.random.default_rng(0)
    registration.register(room(rng).astype(np.float32))
    points = prepare_points(seen_from(room(rng), pose_at((0.1, 0.0, 0.0))), registration.preprocess, 1)
    return registration, points, registration.locate(points, np.eye(4))


@pytest.mark.parametrize(
    ("fine", "coarse", "is_taken"), [(0.6, 0.7, True), (0.7, 0.6, False), (0.7, 0.7, False), (0.01, 0.6, True)]
)
def test_at_the_start_the_result_with_the_larger_consensus_is_taken(
    fine: float, coarse: float, is_taken: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also the only one that does not fail: of 1 % nothing is believed where nearly all agree on the room's own walls."""
    registration, points, known = begun()
    assert registration.history.starting > 0
    near, far = aside(known, fine, 0.0), aside(known, coarse)
    monkeypatch.setattr(registration.target, "align", lambda *_: near)
    monkeypatch.setattr(registration.target, "coarse_to_fine", lambda *_: far)
    located = registration.locate(points, np.eye(4))
    assert located.ok
    assert (located.T_world_lidar is far.T_world_lidar) == is_taken
    assert located.pose_source == ("coarse-to-fine" if is_taken else "")
    assert located.iterations == near.iterations + far.iterations


def test_a_coarse_result_that_fails_is_not_taken_however_many_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    registration, points, known = begun()
    near, far = aside(known, 0.6, 0.0), aside(known, 0.9, 1.1 * registration.config.max_jump_m)
    monkeypatch.setattr(registration.target, "align", lambda *_: near)
    monkeypatch.setattr(registration.target, "coarse_to_fine", lambda *_: far)
    located = registration.locate(points, np.eye(4))
    assert located.ok
    assert located.T_world_lidar is near.T_world_lidar


def test_coarse_to_fine_is_not_tried_after_a_confident_result(monkeypatch: pytest.MonkeyPatch) -> None:
    registration, rng = Registration(), np.random.default_rng(0)
    for k in range(8):
        registration.register(seen_from(room(rng), pose_at((0.1 * k, 0.0, 0.0))))
    monkeypatch.setattr(registration.target, "coarse_to_fine", lambda *_: pytest.fail("asked"))
    assert registration.register(seen_from(room(rng), pose_at((0.8, 0.0, 0.0)))).pose_source == ""


def test_a_standing_start_on_few_planes_does_not_slide() -> None:
    """A motorway under sixteen rings: from metres off the few planes of one scan drew the next to a false place.

    By the noise of the first scan the others stand .005 to .113 m off, one in twenty beyond .1 m.
    """
    usual = simulate("motorway", seed=0, count=3, lidar="os1-16", motion_compensated=True, static_start=0.5)
    np.testing.assert_allclose(usual.ground_truth.poses[1], usual.ground_truth.poses[0], atol=1e-9)
    slid = []
    for drive in (usual, *(with_other_noise(usual, noise) for noise in range(1, 5))):
        registration = Registration(recovery=ALONE)
        registration.register(drive.scan(0).points)
        points = prepare_points(drive.scan(1).points, registration.preprocess, 1)
        wide = registration.target.coarse_to_fine(points, np.eye(4))
        results = [wide, *(registration.register(drive.scan(i).points) for i in (1, 2))]
        assert all(result.ok for result in results)
        slid.append([np.linalg.norm(result.T_world_lidar[:3, 3]) for result in results])
    assert np.median(slid, axis=0).max() < 0.03
    assert np.sort(np.max(slid, axis=1))[-2] < 0.1
    assert np.max(slid) < 0.3


@pytest.mark.parametrize(("seed", "first"), [(0, 10), (1, 5)])
def test_missing_scans_do_not_misplace_the_next_ones(seed: int, first: int) -> None:
    # A metre and more beyond the prior a fine map holds a scan by its own rings, with two thirds of the usual points.
    drive = driven("urban", seed)
    registration = Registration()
    for i in (*range(first, first + 9), first + 11, first + 14, first + 15):
        result = registration.register(drive.scan(i).points)
        truth = se3.relative(drive.ground_truth.poses[first], drive.ground_truth.poses[i])
        assert result.ok
        assert np.linalg.norm(result.T_world_lidar[:3, 3] - truth[:3, 3]) < 0.03
