"""A method and a motion model that estimate a window of scans together, over plain values: poses one way, equations back."""

from __future__ import annotations

from lslam.core.types.motion_prior import MotionPrior
from lslam.odometry.base import Deskewing, Odometry, Windowed
from lslam.odometry.inertial.constant_velocity import MotionModel
from lslam.odometry.inertial.window_motion import WindowMotion
from lslam.registration.solver import RegistrationResult


def fuse(
    odometry: Deskewing, motion: MotionModel, stamp_ns: int, result: RegistrationResult, prior: MotionPrior
) -> RegistrationResult:
    """The registration fused with the motion model; of a window, once more where that moves its scans."""
    if not (isinstance(odometry, Windowed) and isinstance(motion, WindowMotion)):
        return motion.fuse(stamp_ns, result, prior)
    motion.take(odometry.equations(stamp_ns, result))
    fused = motion.fuse(stamp_ns, result, prior)
    again = odometry.equations_at(motion.stale())
    if not again:
        return fused
    motion.take(again)
    return motion.fuse(stamp_ns, result, prior)


def settle(odometry: Odometry, motion: MotionModel) -> None:
    """Tell the method where the scans of the window lie now."""
    if isinstance(odometry, Windowed):
        odometry.settle(motion.poses() if isinstance(motion, WindowMotion) else {})
