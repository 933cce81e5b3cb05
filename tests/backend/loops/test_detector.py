"""Loop closures of drives through a known town: found when drifted, in both directions, and none where there is none."""

from __future__ import annotations

import logging
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from known_town import Points, keyframes_of, pose, round_the_square, seen, terrace, town
from numpy.typing import NDArray

from lslam.backend.kernels import bev, gating
from lslam.backend.keyframes.store import KeyframeStore
from lslam.backend.loops import PlaceMatch
from lslam.backend.loops.detector import Detector
from lslam.backend.loops.find_loops import find_loops, warm_up
from lslam.core.config.backend import LoopsConfig
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.geometry import se3, so3
from lslam.core.kernels import gauss_newton, gaussians, residuals, transform
from lslam.core.types.constraint import LoopCandidate
from lslam.registration.preprocessing.ground import Z

Floats = NDArray[np.float64]


def drifted(true: Floats, scale: float = 0.01, turn_deg: float = 0.5) -> Floats:
    """Odometry of a drive: 1 % too long and 0.5 deg per 100 m too far to the left."""
    poses = [true[0]]
    for before, after in pairwise(true):
        step = se3.relative(before, after)
        length = float(np.linalg.norm(step[:3, 3]))
        step[:3, 3] *= 1 + scale
        bend = se3.make(so3.exp(np.array([0, 0, np.deg2rad(turn_deg) * length / 100])), np.zeros(3))
        poses.append(poses[-1] @ step @ bend)
    return np.array(poses)


def detect(
    world: Floats, true: Floats, odometry: Floats, up: Floats = Z, **settings: float
) -> list[LoopCandidate]:  # fmt: skip
    def cloud(number: int) -> Points:
        return seen(world, true[number], np.random.default_rng(number))

    config = LoopsConfig.model_validate(settings)
    return Detector(keyframes_of(odometry), cloud, config, RegistrationConfig(), up=up).find()


def accepted(candidates: list[LoopCandidate]) -> list[LoopCandidate]:
    return [c for c in candidates if c.verdict == "accepted"]


def errors(candidates: list[LoopCandidate], true: Floats) -> Floats:
    """(C, 2) m and deg of the closures against the truth."""
    found = []
    for c in candidates:
        assert c.constraint is not None
        delta = se3.relative(se3.relative(true[c.a], true[c.b]), c.constraint.T_a_b)
        found.append((np.linalg.norm(delta[:3, 3]), np.rad2deg(so3.angle(delta[:3, :3]))))
    return np.array(found).reshape(-1, 2)


@pytest.mark.parametrize("tilt_deg", [0.0, 28.0, 90.0, 180.0])
def test_finds_where_a_drive_comes_round_again(tilt_deg: float) -> None:
    mounting = pose(0, 0, pitch_deg=tilt_deg)
    mounting[:3, 3] = 0
    true = np.array([round_the_square(d) for d in np.arange(0, 430, 5.0)]) @ mounting
    # The world is the LiDAR's at the first scan, as tilted as that.
    up = Z if tilt_deg < 45 else true[0, 2, :3]
    world, true = se3.apply(se3.inverse(true[0]), town()), se3.relative(true[0], true)
    candidates = detect(world, true, drifted(true), up)
    closures = accepted(candidates)
    assert len(closures) >= 6
    assert all(c.reason == "" and c.a < c.b for c in closures)
    assert (errors(closures, true) < (0.05, 0.1)).all()
    for c in closures:
        assert c.constraint is not None
        T = se3.relative(true[c.a], true[c.b])
        error = np.concatenate(
            [c.constraint.T_a_b[:3, 3] - T[:3, 3], so3.log(c.constraint.T_a_b[:3, :3] @ T[:3, :3].T)]
        )
        assert error @ np.linalg.solve(c.constraint.covariance, error) / 6 < 6
    assert {c.stage for c in candidates if c.verdict == "rejected"} <= {
        "thinned",
        "overlap",
        "registration",
        "ambiguity",
    }


def test_finds_the_way_back_in_the_other_direction() -> None:
    there = [pose(x, -46) for x in np.arange(-40, 41, 4.0)]
    back = [pose(x, -43, yaw_deg=180) for x in np.arange(40, -41, -4.0)]
    true = np.array(there + back)
    closures = accepted(detect(town(), true, drifted(true)))
    assert len(closures) >= 5
    assert (errors(closures, true) < (0.05, 0.1)).all()
    assert all(so3.angle(c.constraint.T_a_b[:3, :3]) > 3 for c in closures if c.constraint is not None)


def test_no_candidate_on_a_way_that_never_returns() -> None:
    true = np.array([pose(x, 0) for x in np.arange(0, 160, 4.0)])
    assert detect(terrace(), true, drifted(true)) == []


def test_no_false_closure_in_a_terrace_though_odometry_is_off_by_a_house() -> None:
    there = [pose(x, 0) for x in np.arange(20, 141, 4.0)]
    back = [pose(x, 2, yaw_deg=180) for x in np.arange(140, 19, -4.0)]
    true = np.array(there + back)
    odometry = true.copy()
    odometry[len(there) :, 0, 3] += 14.0
    candidates = detect(terrace(), true, odometry, drift_percent=15.0)
    assert sum(c.stage == "ambiguity" for c in candidates) >= 5
    assert (errors(accepted(candidates), true) < (0.05, 0.1)).all()


def test_nothing_comes_of_a_sensor_carried_to_another_town() -> None:
    start = np.array([round_the_square(d) for d in np.arange(0, 150, 5.0)])
    far = np.array([pose(1000 + x, 0) for x in np.arange(20, 140, 5.0)])
    true = np.concatenate([start, far])
    world = np.concatenate([town(), terrace() + np.array([1000, 0, 0])])
    # Odometry did not notice and believes to be where it began.
    odometry = true.copy()
    odometry[len(start) :, :3, 3] += start[0, :3, 3] - far[0, :3, 3]
    assert accepted(detect(world, true, odometry)) == []


def test_a_gate_that_excludes_the_truth_rejects() -> None:
    true = np.array([round_the_square(d) for d in np.arange(0, 390, 5.0)])
    odometry = drifted(true)
    odometry[60:, 0, 3] += 30.0
    assert accepted(detect(town(), true, odometry)) == []


def test_radius_takes_the_place_of_the_covariance() -> None:
    true = np.array([round_the_square(d) for d in np.arange(0, 400, 5.0)])
    odometry = drifted(true)
    away = np.linalg.norm(odometry[-8:, :3, 3] - odometry[:8, :3, 3], axis=1).min()
    assert accepted(detect(town(), true, odometry, radius=12.0))
    assert detect(town(), true, odometry, radius=0.3 * float(away)) == []


def test_empty_clouds_and_few_keyframes() -> None:
    true = np.array([round_the_square(d) for d in np.arange(0, 390, 6.0)])
    empty = np.zeros((0, 3), np.float32)
    candidates = Detector(keyframes_of(true), lambda _: empty, LoopsConfig(), RegistrationConfig()).find()
    assert candidates
    assert not accepted(candidates)
    for count in (0, 1, 2):
        assert Detector(keyframes_of(true[:count]), lambda _: empty, LoopsConfig(), RegistrationConfig()).find() == []


def test_covariances_of_odometry_widen_the_search() -> None:
    true = np.array([round_the_square(d) for d in np.arange(0, 400, 5.0)])
    odometry = true.copy()
    odometry[40:, :3, 3] += (9.0, 4.0, 1.0)
    sure = keyframes_of(odometry)
    unsure = [replace(k, covariance=np.diag([0.05] * 3 + [1e-6] * 3) * k.distance) for k in sure]
    world = town()

    def cloud(number: int) -> Points:
        return seen(world, true[number], np.random.default_rng(number))

    config = LoopsConfig(drift_percent=0.1, drift_deg=0.0)
    assert not accepted(Detector(sure, cloud, config, RegistrationConfig()).find())
    closures = accepted(Detector(unsure, cloud, config, RegistrationConfig()).find())
    assert closures
    assert (errors(closures, true) < (0.05, 0.1)).all()


def test_joins_the_clouds_of_a_store(caplog: pytest.LogCaptureFixture) -> None:
    true = np.array([round_the_square(d) for d in np.arange(0, 400, 5.0)])
    world, store = town(), KeyframeStore()
    for keyframe in keyframes_of(drifted(true)):
        cloud = seen(world, true[keyframe.number], np.random.default_rng(keyframe.number))
        store.add(keyframe, cloud[keyframe.number % 5 :: 5])
    with caplog.at_level(logging.INFO, "lslam"):
        candidates = find_loops(store, LoopsConfig(), RegistrationConfig())
    closures = accepted(candidates)
    assert len(closures) >= 3
    tried = [c for c in candidates if c.stage != "thinned"]
    assert len(tried) < len(candidates)
    assert caplog.messages == [
        f"loop closures: {len(closures)} of {len(tried)} candidates accepted, {len(store)} keyframes"
    ]
    assert (errors(closures, true) < (0.1, 0.1)).all()


def test_after_a_warm_start_nothing_is_left_to_compile() -> None:
    warm_up(LoopsConfig())
    kernels: list[Any] = [bev.polar_image, gaussians.insert, gaussians.coarsen, residuals.linearise,
                          gauss_newton.step, gating.gate, transform.transform]  # fmt: skip
    before = [len(kernel.signatures) for kernel in kernels]
    assert all(before)
    true = np.array([round_the_square(d) for d in np.arange(0, 380, 10.0)])
    assert accepted(detect(town(), true, drifted(true)))
    assert [len(kernel.signatures) for kernel in kernels] == before


def test_compares_places_in_a_level_world() -> None:
    mounting = pose(0, 0, roll_deg=20, pitch_deg=25)
    mounting[:3, 3] = 0
    level = np.array([round_the_square(d) for d in np.arange(0, 380, 10.0)]) @ mounting
    world, true = se3.apply(se3.inverse(level[0]), town()), se3.relative(level[0], level)

    def cloud(number: int) -> Points:
        return seen(world, true[number], np.random.default_rng(number))

    detector = Detector(keyframes_of(true), cloud, LoopsConfig(), RegistrationConfig())
    assert accepted(detector.find())
    for keyframe, expected in zip(detector.keyframes, level, strict=True):
        assert np.rad2deg(np.arccos(keyframe.T_world_lidar[2, :3] @ expected[2, :3])) < 1.5


def test_threads_change_no_candidate(monkeypatch: pytest.MonkeyPatch) -> None:
    """Verdicts change on the way, so keyframes are verified ahead that are never due."""
    true = np.array([round_the_square(d) for d in np.arange(0, 560, 5.0)])
    world, odometry = town(), drifted(true)

    def cloud(number: int) -> Points:
        # From time to time there is nothing to see.
        return seen(world, true[number], np.random.default_rng(number))[:: 1 if number % 5 else 400]

    def found(threads: int) -> tuple[list[str], int]:
        detector = Detector(keyframes_of(odometry), cloud, LoopsConfig(), RegistrationConfig())
        verified: list[int] = []
        examine = detector._examine

        def note(match: PlaceMatch, b: int) -> LoopCandidate:
            verified.append(b)
            return examine(match, b)

        monkeypatch.setattr(detector, "_examine", note)
        return [repr(candidate) for candidate in detector.find(threads=threads)], len(set(verified))

    (alone, least), (together, more) = found(1), found(4)
    assert alone == together
    assert len({repr(c).partition("stage=")[2][:30] for c in alone}) > 2, "verdicts of several kinds are needed"
    assert more > least
