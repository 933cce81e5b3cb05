"""Ambiguity and throttling: at most one loop closure per keyframe, none where places repeat."""

from __future__ import annotations

import numpy as np
from known_town import keyframes_of, pose

from lslam.backend.loops.gating import LoopThrottle, resolve_ambiguity
from lslam.core.types.constraint import Constraint, LoopCandidate, Verdict

KEYFRAMES = keyframes_of(np.array([pose(10.0 * k, 0) for k in range(9)]))


def candidate(a: int, x: float, verdict: Verdict = "accepted", stage: str = "agreement") -> LoopCandidate:
    """That puts keyframe 8 at x = `x` m."""
    T = np.linalg.inv(KEYFRAMES[a].T_world_lidar) @ pose(x, 0)
    reason = "" if verdict == "accepted" else "as the test wants"
    return LoopCandidate(a, 8, 1.0, 0.1, verdict, stage, reason, constraint=Constraint(a, 8, T, np.eye(6)))


def settled(*candidates: LoopCandidate, reach: float = 2.0) -> list[tuple[str, str]]:
    return [(c.verdict, c.stage) for c in resolve_ambiguity(list(candidates), KEYFRAMES, lambda older, newer: reach)]


def test_candidates_that_agree_leave_the_most_similar() -> None:
    assert settled(candidate(2, 21.0), candidate(4, 22.0)) == [("accepted", "agreement"), ("rejected", "thinned")]


def test_candidates_that_contradict_leave_none() -> None:
    assert settled(candidate(2, 21.0), candidate(4, 35.0)) == [("rejected", "ambiguity")] * 2
    # Where odometry may be as wrong between the two old keyframes, they do not.
    assert settled(candidate(2, 21.0), candidate(4, 35.0), reach=20.0)[0] == ("accepted", "agreement")


def test_the_gate_is_that_between_the_two_older_keyframes() -> None:
    asked: list[tuple[int, int]] = []

    def reach(older: int, newer: int) -> float:
        asked.append((older, newer))
        return 2.0

    resolve_ambiguity([candidate(4, 35.0), candidate(2, 21.0)], KEYFRAMES, reach)
    assert asked == [(2, 4)]


def test_an_ambiguous_candidate_rejects_the_others() -> None:
    both = settled(candidate(4, 35.0, "rejected", "ambiguity"), candidate(2, 21.0))
    assert both == [("rejected", "ambiguity")] * 2


def test_a_candidate_rejected_otherwise_does_not() -> None:
    both = settled(candidate(4, 35.0, "rejected", "overlap"), candidate(2, 21.0))
    assert both == [("rejected", "overlap"), ("accepted", "agreement")]
    assert settled(candidate(2, 21.0)) == [("accepted", "agreement")]
    assert settled() == []


def test_throttling_slows_down_while_nothing_changes() -> None:
    pace, tried = LoopThrottle(4.0), []
    for distance in np.arange(0, 60, 1.0):
        if pace.is_due(distance):
            tried.append(float(distance))
            pace.observe(distance, "rejected" if distance < 30 else "accepted")
    assert tried == [0, 4, 12, 24, 36, 40, 48]
    assert not pace.is_due(59)
    pace.reset()
    assert pace.is_due(59)


def test_no_spacing_tries_everything() -> None:
    pace = LoopThrottle(0.0)
    for distance in (0.0, 0.0, 1.0):
        assert pace.is_due(distance)
        pace.observe(distance, "accepted")
