"""Every tightly coupled method has a motion model of its own, and no other method has."""

from __future__ import annotations

from lslam.config.odometry import TIGHTLY_COUPLED
from lslam.frontend.motion_models import MOTION_MODELS
from lslam.odometry import METHODS


def test_tightly_coupled_methods_are_those_with_a_motion_model_of_their_own() -> None:
    assert set(MOTION_MODELS) == set(TIGHTLY_COUPLED)
    assert set(TIGHTLY_COUPLED) <= set(METHODS)
