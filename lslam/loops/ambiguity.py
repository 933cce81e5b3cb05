"""Perceptual aliasing: several older keyframes that match a new one, which can be at one place only."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lslam.types.constraint import LoopCandidate, LoopStage, Verdict
from lslam.types.trajectory import Keyframe


def resolve_ambiguity(
    examined: list[LoopCandidate], keyframes: Sequence[Keyframe], reach: Callable[[int, int], float]
) -> list[LoopCandidate]:
    """Candidates of one newer keyframe, the most similar first, with at most one loop closure accepted.

    reach : m, gate of odometry between an older and a newer keyframe

    All are rejected when two imply different poses of the keyframe, or when one of them was ambiguous by itself.
    """
    accepted = [c for c in examined if c.is_accepted]
    ambiguous = next((c for c in examined if c.stage == LoopStage.AMBIGUITY), None)
    if accepted and ambiguous is not None:
        return [_ambiguous(c, f"keyframe {ambiguous.a} looks as much alike, and is ambiguous") for c in examined]
    if len(accepted) < 2:
        return examined
    first = accepted[0]
    for other in accepted[1:]:
        gap = float(np.linalg.norm(_put(other, keyframes) - _put(first, keyframes)))
        if gap > reach(min(first.a, other.a), max(first.a, other.a)):
            said = f"keyframes {first.a} and {other.a} fit, at places {gap:.1f} m apart"
            return [_ambiguous(c, said) for c in examined]
    said = f"closed with keyframe {first.a} already"
    extra = {c.a for c in accepted[1:]}
    return [
        replace(c, verdict=Verdict.REJECTED, stage=LoopStage.THINNED, reason=said) if c.a in extra else c
        for c in examined
    ]


def _put(candidate: LoopCandidate, keyframes: Sequence[Keyframe]) -> NDArray[np.float64]:
    """(3,) m in the world, position of the newer keyframe by the loop closure and odometry's pose of the older one."""
    assert candidate.constraint is not None
    return np.asarray((keyframes[candidate.a].T_world_lidar @ candidate.constraint.T_a_b)[:3, 3])


def _ambiguous(candidate: LoopCandidate, reason: str) -> LoopCandidate:
    """The candidate, rejected as ambiguous unless it was rejected before."""
    if not candidate.is_accepted:
        return candidate
    return replace(candidate, verdict=Verdict.REJECTED, stage=LoopStage.AMBIGUITY, reason=reason)
