"""The gates of the detector: odometry's bound on a pose, the headings tried, and the axes of the constraint."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from known_town import keyframes_of, pose
from numpy.typing import NDArray

from lslam.backend.loops.detector import LEAST_REACH, TURN_STEP, WIDEST_TURN, Detector
from lslam.backend.loops.gating import RelativeUncertainty, SharedResults
from lslam.backend.loops.scan_context import SECTORS, PlaceMatch
from lslam.backend.loops.verify import Verification, Verifier, is_elsewhere
from lslam.core.config.backend import LoopsConfig
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.geometry import se3, so3
from lslam.core.types.constraint import LoopCandidate, LoopStage, Verdict
from lslam.core.types.scan_result import StageClock
from lslam.registration.result import RegistrationResult

Floats = NDArray[np.float64]
# Sigmas of odometry: 2 m along x, 0.5 m across, and three degrees.
UNCERTAINTY = RelativeUncertainty(np.diag([4.0, 0.25, 0.25])[None], np.deg2rad([3.0]))
EXPECTED = np.array([10.0, 0.0, 0.0])


def detector(**settings: float) -> Detector:
    poses = np.array([pose(0, 0, 90), pose(10, 0, 90)])
    return Detector(
        keyframes_of(poses), lambda _: np.zeros((0, 3), np.float32), LoopsConfig(**settings), RegistrationConfig()
    )  # type: ignore[arg-type]


def found(shift: tuple[float, float], turn_deg: float = 0.0) -> Verification:
    R = so3.exp(np.array([0, 0, np.deg2rad(turn_deg)]))
    return Verification("agreement", "", se3.make(R, EXPECTED + np.array([*shift, 0.0])), np.diag([1.0, 2, 3, 4, 5, 6]))


@pytest.mark.parametrize(
    ("shift", "turn_deg", "said"),
    [
        ((5.9, 0.0), 0.0, ""),
        ((6.2, 0.0), 0.0, "odometry would be wrong by 6.2 m"),
        ((0.0, 1.7), 0.0, ""),
        ((0.0, 1.9), 0.0, "odometry would be wrong by 1.9 m"),
        ((0.0, 0.0), 8.9, ""),
        ((0.0, 0.0), 9.1, "odometry would be wrong by 9.1 deg"),
    ],
)
def test_a_pose_beyond_three_sigmas_of_odometry_is_none(shift: tuple[float, float], turn_deg: float, said: str) -> None:
    """`LEAST_REACH` is 1 m at three sigmas: it adds 1/9 m2 to the variances."""
    assert LEAST_REACH == 1.0
    assert detector()._beyond(found(shift, turn_deg), EXPECTED, UNCERTAINTY) == said


@pytest.mark.parametrize(
    ("shift", "turn_deg", "is_out"),
    [(0.95, 0.0, False), (1.05, 0.0, True), (0.0, 1.9, False), (0.0, 2.1, True)],
)
def test_the_gate_is_at_least_a_metre_and_two_degrees(shift: float, turn_deg: float, is_out: bool) -> None:
    """Two registrations of one place differ by as much."""
    sure = RelativeUncertainty(1e-8 * np.eye(3)[None], np.array([1e-8]))
    gate = detector()
    assert bool(gate._beyond(found((0.0, shift), turn_deg), EXPECTED, sure)) == is_out
    assert gate._reach(sure) == 1.0
    assert gate._turn(sure) == pytest.approx(np.deg2rad(2.0))


def test_a_radius_is_the_limit_in_every_direction() -> None:
    gate = detector(radius=3.0)
    assert gate._reach(UNCERTAINTY) == 3.0
    for shift, said in (((0.0, 2.9), ""), ((2.9, 0.0), ""), ((3.1, 0.0), "odometry would be wrong by 3.1 m")):
        assert gate._beyond(found(shift), EXPECTED, UNCERTAINTY) == said


def test_headings_tried_are_odometrys_or_else_the_descriptors() -> None:
    match = PlaceMatch(0, 0.1, yaw=2.0)
    near, wide = detector()._yaws(match, np.deg2rad(5.0)), detector()._yaws(match, 1.01 * WIDEST_TURN)
    for yaws, centre, spread in ((near, 0.0, np.deg2rad(5.0)), (wide, 2.0, np.pi / SECTORS)):
        assert yaws.mean() == pytest.approx(centre)
        assert np.diff(yaws) == pytest.approx(TURN_STEP)
        assert spread <= yaws.max() - centre < spread + 2 * TURN_STEP


def test_a_constraint_is_in_the_axes_of_the_keyframes() -> None:
    """Both head north, so that 10 m east are 10 m to their right; what is uncertain along x is so across them."""
    constraint = detector()._constraint(0, 1, found((0.0, 0.0)))
    assert constraint is not None
    np.testing.assert_allclose(constraint.T_a_b, se3.make(np.eye(3), np.array([0.0, -10.0, 0.0])), atol=1e-12)
    np.testing.assert_allclose(constraint.covariance, np.diag([2.0, 1, 3, 5, 4, 6]), atol=1e-12)
    assert detector()._constraint(0, 1, Verification("overlap", "nothing stands up there")) is None


FORWARD = RegistrationResult(pose(3, 1, 20), covariance=np.diag([1e-4] * 3 + [1e-6] * 3))


def chosen(distances: list[float], where: list[float], **settings: float) -> tuple[list[int], int | None]:
    """Which of older keyframes at x = `where` m are compared with a newer one at the second of them that is so unlike them.

    And which one is fallen back on when none of these fits. It has been half a kilometre away meanwhile.
    """
    count = len(distances)
    keyframes = keyframes_of(np.array([pose(x, 0) for x in [*where, 500.0, where[1]]]))
    chooser = Detector(keyframes, lambda _: np.zeros((0, 3), np.float32), LoopsConfig(**settings), RegistrationConfig())  # type: ignore[arg-type]

    class Looks:
        def add(self, number: int, points: NDArray[np.float32]) -> None:
            pass

        def nearest(self, number: int, others: NDArray[np.int64], turn: float) -> list[PlaceMatch]:
            return [
                PlaceMatch(int(k), distances[int(k)], 0.0)
                for k in np.array(others)[np.argsort(np.array(distances)[others])]
            ]

    chooser.index = Looks()  # type: ignore[assignment]
    matches, fallback = chooser._choose(count + 1, np.arange(count))
    return [match.number for match in matches], next((match.number for match in fallback()), None)


def alike(distances: list[float], apart: float = 20.0, **settings: float) -> list[int]:
    return chosen(distances, [apart * k for k in range(len(distances))], **settings)[0]


def test_descriptors_half_as_far_again_as_the_best_are_no_candidates() -> None:
    """Odometry is lost after a kilometre, so that looks decide: what looks nearly as much alike must be asked too."""
    assert alike([0.20, 0.10, 0.145, 0.155]) == [1, 2]
    assert alike([0.11, 0.10, 0.12, 0.13]) == [1, 0, 2]
    # Not beyond what may be the same place at all, and not twice what is one place.
    assert alike([0.20, 0.10, 0.145, 0.155], max_descriptor_distance=0.14) == [1]
    assert alike([0.20, 0.10, 0.145, 0.155], apart=7.9) == [1]
    assert alike([0.20, 0.10, 0.145, 0.155], apart=8.1) == [1, 2]


@pytest.mark.parametrize(("x", "fallback"), [(6.9, None), (7.1, 1)])
def test_odometrys_nearest_keyframe_is_the_fallback_candidate(x: float, fallback: int | None) -> None:
    """Within half of what two passes of a street lie apart it is the same place: here within 4 m of x = 3 m."""
    assert chosen([0.3, 0.3, 0.1], [0.0, 3.0, x]) == ([2], fallback)


def test_one_keyframe_per_four_metres_is_compared() -> None:
    """Of those at 5 and 6 m the second is not compared, however much it looks alike, and that at 3 m only as the nearest."""
    assert chosen([0.3, 0.3, 0.2, 0.01], [0.0, 3.0, 5.0, 6.0]) == ([2], None)
    assert chosen([0.3, 0.1, 0.2, 0.01], [0.0, 3.0, 5.0, 6.0]) == ([1], None)


@pytest.mark.parametrize(("shift", "stage"), [(0.5, "agreement"), (60.0, "gate")])
def test_what_fits_and_is_too_far_from_odometry_is_refused_by_the_gate(shift: float, stage: str) -> None:
    gate = detector()
    gate.uncertainty.between = lambda b, older: UNCERTAINTY  # type: ignore[method-assign]
    gate._submaps = SharedResults(lambda number: None)  # type: ignore[assignment, arg-type, return-value]

    class Finds:
        def verify(self, a: object, b: object, expected: Floats, reach: float, yaws: Floats) -> Verification:
            return replace(found((0, 0)), T_a_b=se3.make(np.eye(3), expected + np.array([shift, 0, 0])))

    gate.verifier = Finds()  # type: ignore[assignment]
    candidate = gate._examine(PlaceMatch(0, 0.1, 0.0), 1)
    assert candidate.stage == stage
    assert candidate.verdict == ("accepted" if stage == "agreement" else "rejected")
    assert bool(candidate.reason) == (stage == "gate")


@pytest.mark.parametrize(
    ("verdict", "stage", "is_asked"),
    [
        (Verdict.ACCEPTED, LoopStage.AGREEMENT, False),
        (Verdict.REJECTED, LoopStage.AMBIGUITY, False),
        (Verdict.REJECTED, LoopStage.OVERLAP, True),
    ],
)
def test_the_fallback_candidate_is_tried_after_rejections_without_ambiguity(
    verdict: Verdict, stage: LoopStage, is_asked: bool
) -> None:
    """Where a place fits twice, no other can be told from it either."""
    gate = detector()
    gate._choose = lambda b, older: ([PlaceMatch(0, 0.1, 0.0)], lambda: [PlaceMatch(1, 0.2, 0.0)])  # type: ignore[method-assign]
    gate._examine = lambda match, b: LoopCandidate(match.number, b, 0.0, match.distance, verdict, stage)  # type: ignore[method-assign]
    examined = gate._examine_all(2, np.arange(2), StageClock())
    assert [(c.a, c.verdict, c.stage) for c in examined] == [(a, verdict, stage) for a in range(1 + is_asked)]


def agree(gap: tuple[float, ...], **settings: float) -> Verification:
    """Two registrations that differ by the twist `gap`."""
    backward = RegistrationResult(se3.inverse(se3.exp(-np.array(gap)) @ FORWARD.T_world_lidar))
    return Verifier(LoopsConfig(**settings), RegistrationConfig())._agree(Verification("overlap"), FORWARD, backward)  # type: ignore[arg-type]


def test_a_closure_is_the_mean_of_both_registrations_with_their_difference_as_sigma() -> None:
    gap = (0.12, -0.06, 0.04, 0.0, 0.003, -0.004)
    closure = agree(gap)
    assert (closure.stage, closure.reason) == ("agreement", "")
    assert closure.T_a_b is not None
    assert closure.covariance is not None
    np.testing.assert_allclose(closure.T_a_b, se3.exp(-0.5 * np.array(gap)) @ FORWARD.T_world_lidar, rtol=0, atol=1e-12)
    expected = [1e-4 + 0.01**2 + 0.14**2 / 3] * 3 + [1e-6 + np.deg2rad(0.02) ** 2 + 0.005**2 / 3] * 3
    np.testing.assert_allclose(closure.covariance, np.diag(expected), rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize(
    ("gap", "is_said"),
    [
        ((0.19, 0, 0, 0, 0, 0), False),
        ((0, 0.21, 0, 0, 0, 0), True),
        ((0, 0, 0, 0, 0, np.deg2rad(0.49)), False),
        ((0, 0, 0, 0, np.deg2rad(0.51), 0), True),
    ],
)
def test_registrations_that_differ_close_nothing(gap: tuple[float, ...], is_said: bool) -> None:
    found = agree(gap)
    assert found.stage == "agreement"
    assert found.reason.startswith("old to new and new to old differ by ") == is_said


def test_a_failed_registration_back_is_reported() -> None:
    verifier = Verifier(LoopsConfig(), RegistrationConfig())
    lost = RegistrationResult(se3.inverse(FORWARD.T_world_lidar), ok=False, reason="only 3 points match")
    assert verifier._agree(Verification("overlap"), FORWARD, lost).reason == "new to old: only 3 points match"
    mute = replace(lost, reason="")
    assert verifier._agree(Verification("overlap"), FORWARD, mute).reason == "new to old: nothing matches"


@pytest.mark.parametrize(
    ("x", "yaw_deg", "expected"), [(0.9, 0, False), (1.1, 0, True), (0.0, 4.5, False), (0.0, 5.5, True)]
)
def test_poses_differ_from_a_metre_or_five_degrees(x: float, yaw_deg: float, expected: bool) -> None:
    assert is_elsewhere(pose(0, 0), pose(x, 0, yaw_deg)) == expected
