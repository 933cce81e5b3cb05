"""The motion model of a run with an IMU: what the module of a tightly coupled method makes, or that of a loosely coupled IMU."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from importlib import import_module

from lslam.core.config import Config
from lslam.odometry import METHODS
from lslam.odometry.inertial.fusion import InertialMotion
from lslam.odometry.inertial.initialise import InertialStart


def motion_of(opening: InertialStart, config: Config) -> InertialMotion:
    """The motion model that the method asks for: `create_motion` of its module, where it has one."""
    create: Callable[[InertialStart, Config], InertialMotion] = InertialMotion.of
    if config.odometry.method in METHODS:
        module, _ = METHODS[config.odometry.method]
        create = getattr(import_module(module), "create_motion", create)
    return create(opening, config)


def copy_of(motion: InertialMotion, opening: InertialStart, config: Config) -> InertialMotion:
    """A second model of the same IMU that goes on where `motion` is."""
    other = motion_of(opening, config)
    other.restore(deepcopy(motion.state()))
    return other
