"""When a keyframe joins the target of registration, and when one leaves it."""

from __future__ import annotations

import numpy as np
import pytest
from analytic_scenes import pose_at
from numpy.typing import NDArray

from lslam.core.config.odometry import RegistrationConfig
from lslam.registration.local_map import LastKeyframes
from lslam.registration.preprocessing.prepare import PreparedPoints, small_room
from lslam.registration.registration import Registration

Floats = NDArray[np.float64]


class Listed:
    """A map that notes the x of what lies in it."""

    def __init__(self) -> None:
        self.held: list[float] = []

    def insert(self, points: NDArray[np.float32], source: Floats, T: Floats) -> None:
        self.held.append(float(T[0, 3]))

    def clear(self) -> None:
        self.held = []


POINTS = PreparedPoints(np.zeros((1, 3), np.float32), np.zeros((1, 3)), np.zeros((1, 6)), 1)


@pytest.mark.parametrize(
    ("x", "yaw_deg", "is_new"), [(0.45, 0.0, False), (0.55, 0.0, True), (0.0, 9.0, False), (0.0, 11.0, True)]
)
def test_a_keyframe_is_due_after_a_way_or_a_turn(x: float, yaw_deg: float, is_new: bool) -> None:
    target, listed = LastKeyframes(5, 0.5, float(np.deg2rad(10.0))), Listed()
    for pose in (pose_at(), pose_at((x, 0.0, 0.0), yaw_deg)):
        target.enter(listed, POINTS, pose)  # type: ignore[arg-type]
    assert len(listed.held) == 1 + is_new


def test_the_oldest_leaves_when_there_are_too_many() -> None:
    target, listed = LastKeyframes(3, 0.5, 1.0), Listed()
    for x in (0.0, 1.0, 1.2, 2.0, 3.0, 4.0):
        target.enter(listed, POINTS, pose_at((x, 0.0, 0.0)))  # type: ignore[arg-type]
    assert listed.held == [2.0, 3.0, 4.0]


def test_a_registration_on_arrays_may_have_a_submap() -> None:
    registration = Registration(RegistrationConfig(target="submap"))
    registration.register(small_room())
    assert registration.register(small_room()).ok
    assert len(registration.target.scans.poses) == 1
