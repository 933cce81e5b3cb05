"""A method and a motion model that estimate a window of scans together, over plain values: poses one way, equations back."""

from __future__ import annotations

from lslam.inertial.window_motion import WindowMotion
from lslam.odometry.base import Deskewing, Odometry, Registered, Windowed
from lslam.registration.constant_velocity import MotionModel
from lslam.types.motion_prior import MotionPrior
from lslam.types.scan_result import ScanResult


def weighed(odometry: Deskewing, motion: MotionModel, found: Registered, prior: MotionPrior) -> ScanResult:
    """What the motion model makes of a registration; of a window, once more where that moves its scans."""
    if not (isinstance(odometry, Windowed) and isinstance(motion, WindowMotion)):
        return motion.weigh(found.result, prior)
    motion.take(odometry.equations(found))
    result = motion.weigh(found.result, prior)
    again = odometry.equations_at(motion.stale())
    if not again:
        return result
    motion.take(again)
    return motion.weigh(found.result, prior)


def settle(odometry: Odometry, motion: MotionModel) -> None:
    """Tell the method where the scans of the window lie now."""
    if isinstance(odometry, Windowed):
        odometry.settle(motion.poses() if isinstance(motion, WindowMotion) else {})
