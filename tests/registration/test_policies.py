"""Which policies a configuration switches on, and that `pose_source` names the one that found the pose."""

from __future__ import annotations

import numpy as np
import pytest
from analytic_scenes import distance, is_near, pose_at, room, seen_from
from numpy.typing import NDArray
from recovery_drives import driven

from lslam.core.config import load_config
from lslam.core.config.config import Config
from lslam.core.config.odometry import NO_RECOVERY, RecoveryConfig, rest_alone
from lslam.core.geometry import se3
from lslam.registration.policies import AtRest, CoarseToFine, StartSearch, policies_of
from lslam.registration.preprocessing.prepare import prepare_points
from lslam.registration.registration import Registration
from lslam.registration.result import RegistrationResult

Floats = NDArray[np.float64]


def test_each_policy_has_its_switch_and_coarse_to_fine_comes_first() -> None:
    def kinds(config: RecoveryConfig) -> list[type]:
        return [type(policy) for policy in policies_of(config)]

    assert kinds(RecoveryConfig()) == kinds(Config().recovery) == [CoarseToFine, StartSearch, AtRest]
    assert kinds(RecoveryConfig(coarse_to_fine=False)) == [StartSearch, AtRest]
    assert kinds(RecoveryConfig(start_search=False)) == [CoarseToFine, AtRest]
    assert kinds(RecoveryConfig(coarse_to_fine=False, start_search=False, at_rest=False)) == []


def surprised(config: RecoveryConfig) -> tuple[RegistrationResult, Floats]:
    """What is made of three metres and six degrees that the prior does not know, after ten scans; and the true pose."""
    registration, rng = Registration(recovery=config), np.random.default_rng(0)
    for k in range(10):
        assert registration.register(seen_from(room(rng), pose_at((0.1 * k, 0.0, 0.0)))).pose_source == ""
    T = pose_at((1.0, 3.0, 0.0), 6.0)
    return registration.register(seen_from(room(rng), T)), T


def test_coarse_to_fine_recovers_unexpected_motion_where_it_is_on() -> None:
    result, T = surprised(RecoveryConfig())
    assert is_near(T, result.T_world_lidar, 0.01, 0.05)
    assert result.pose_source == "coarse-to-fine"
    lost, T = surprised(RecoveryConfig(coarse_to_fine=False, start_search=False))
    assert distance(T, lost.T_world_lidar)[0] > 0.5
    assert lost.pose_source == ""


@pytest.mark.parametrize("coarse_to_fine", [True, False])
def test_the_start_search_finds_a_far_first_step_where_it_is_on(coarse_to_fine: bool) -> None:
    """Nine metres on a motorway, from one scan to the next."""
    drive = driven("motorway", 0)
    truth = se3.relative(drive.ground_truth.poses[0], drive.ground_truth.poses[3])

    def second(start_search: bool) -> RegistrationResult:
        config = RecoveryConfig(coarse_to_fine=coarse_to_fine, start_search=start_search)
        registration = Registration(recovery=config)
        registration.register(drive.scan(0).points)
        return registration.register(drive.scan(3).points)

    found, lost = second(True), second(False)
    assert found.ok
    assert found.pose_source == "start search"
    assert np.linalg.norm(found.T_world_lidar[:3, 3] - truth[:3, 3]) < 0.1
    assert found.prior_error[0] == pytest.approx(np.linalg.norm(found.T_world_lidar[:3, 3]))
    assert lost.pose_source != "start search"
    assert not lost.ok or np.linalg.norm(lost.T_world_lidar[:3, 3] - truth[:3, 3]) > 1.0


def test_without_policies_registration_is_the_plain_one() -> None:
    bare = RecoveryConfig(coarse_to_fine=False, start_search=False)
    poses = []
    for registration in (Registration(recovery=bare), Registration()):
        rng = np.random.default_rng(0)
        for k in range(8):
            result = registration.register(seen_from(room(rng, 2000), pose_at((0.1 * k, 0.02 * k, 0.0), 0.5 * k)))
        poses.append(result.T_world_lidar)
    np.testing.assert_array_equal(*poses)


def test_with_a_near_prior_no_policy_is_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    for policy in (CoarseToFine, StartSearch):
        monkeypatch.setattr(policy, "recover", lambda *_: pytest.fail("asked"))
    registration = Registration()
    rng = np.random.default_rng(0)
    first, second = (prepare_points(room(rng).astype(np.float32), registration.preprocess, k) for k in range(2))
    registration.update(registration.locate(first, np.eye(4)))
    assert registration.locate(second, pose_at((0.05, 0.0, 0.0)), is_near=True).ok


def test_no_recovery_has_no_policy_and_a_filter_has_the_one_that_the_user_leaves_it() -> None:
    assert not any(value is True for value in NO_RECOVERY.model_dump().values())
    assert policies_of(NO_RECOVERY) == ()
    assert [policy.name for policy in policies_of(rest_alone(RecoveryConfig()))] == ["at rest"]
    assert policies_of(rest_alone(RecoveryConfig(at_rest=False))) == ()


@pytest.mark.parametrize("preset", ["thesis-icp", "thesis-loam", "thesis-loam-map", "hdl"])
def test_a_preset_has_no_policy_that_its_source_has_not(preset: str) -> None:
    recovery = load_config(None, [f"odometry.preset={preset}"], {}).recovery
    assert policies_of(recovery) == ()
