"""Somebody else's odometry: the poses of a trajectory file, so that loops, graph, map and report can be had of it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.errors import InputError, UsageError
from lslam.core.geometry.se3 import poses_at
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan, Span
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.state import Stateful
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.odometry.base import Traits
from lslam.odometry.inertial.constant_velocity import MotionModel
from lslam.registration.preprocessing.deskew import knots_over

if TYPE_CHECKING:
    from lslam.core.config.config import Config


# Between poses farther apart than so many typical steps there is a gap; beyond the ends one scan's sweep may reach.
GAP_STEPS, GAP_S = 2.5, 0.25


class GivenMotion(Stateful, MotionModel):
    """Motion model that interpolates the poses of a trajectory."""

    def __init__(self, trajectory: Trajectory) -> None:
        self.trajectory = trajectory
        step = float(np.median(np.diff(trajectory.stamps_ns)))
        self._gap_ns = max(GAP_STEPS * step, 1e9 * GAP_S)

    @property
    def is_known(self) -> bool:
        """From the first scan on."""
        return True

    def covers(self, stamp_ns: int) -> bool:
        """Whether the trajectory has a pose at the stamp, or poses before and after it without a gap.

        Its ends reach a millisecond farther, since the stamps of files are rounded.
        """
        stamps = self.trajectory.stamps_ns
        right = int(np.searchsorted(stamps, stamp_ns))
        if right < len(stamps) and stamps[right] == stamp_ns:
            return True
        if 0 < right < len(stamps):
            return bool(stamps[right] - stamps[right - 1] <= self._gap_ns)
        # A millisecond: stamps of files are rounded.
        return bool(min(abs(int(stamps[0]) - stamp_ns), abs(int(stamps[-1]) - stamp_ns)) <= 1_000_000)

    def sweep(self, stamp_ns: int, span: Span) -> MotionPrior:
        """Poses over the `span` of the sweep; the one at the stamp when it takes no time."""
        times = knots_over(span)
        instants = stamp_ns + np.round(1e9 * times).astype(np.int64)
        return MotionPrior(times, poses_at(self.trajectory.stamps_ns, self.trajectory.poses, instants))

    def refine(self, prior: MotionPrior, stamp_ns: int, pose: Floats) -> MotionPrior:
        """The prior unchanged, since nothing was registered."""
        return prior

    def rewind(self, stamp_ns: int, pose: Floats, span: Span) -> MotionPrior:
        """Motion within the sweep of the first scan, as by `sweep`; there is no state to reset."""
        return self.sweep(stamp_ns, span)

    def correct(
        self, stamp_ns: int, pose: Floats, prior: MotionPrior | None = None, has_registration: bool = True
    ) -> None:
        """Nothing to learn."""


class GivenPoses(Traits, Stateful):
    """Takes each scan's pose from a trajectory, which has to be of the LiDAR (`pipeline.job.bind` ensures that)."""

    deskew = "by the motion of the given trajectory"
    ignores_prior = True

    def __init__(self, trajectory: Trajectory) -> None:
        self.trajectory = trajectory
        self.motion = GivenMotion(trajectory)

    def register(self, scan: Scan, prepared: None, prior: MotionPrior) -> ScanResult:
        """The trajectory's pose at the scan's stamp; `bridged` where it has a gap."""
        covered = self.motion.covers(scan.stamp_ns)
        return ScanResult(
            index=scan.index,
            stamp_ns=scan.stamp_ns,
            T_world_lidar=self.motion.sweep(scan.stamp_ns, Span()).pose,
            status="ok" if covered else "bridged",
            reason="" if covered else "the given trajectory has no pose at this time",
            source_points=len(scan),
        )


def create(config: Config) -> GivenPoses:
    """Create the method with the poses of `odometry.poses`.

    Raises UsageError without a file, InputError for one that cannot be read.
    """
    if not config.odometry.poses:
        raise UsageError("method poses needs a trajectory: name its file with --poses")
    path = Path(config.odometry.poses)
    trajectory = read_trajectory(path)
    if not trajectory.has_rotations:
        raise InputError(
            f"{path} has positions without rotations: scans cannot be placed by them; --poses needs rotations, and as ground "
            "truth (--gt) it scores positions"
        )
    if len(trajectory) < 2:
        raise UsageError(f"{path} holds {len(trajectory)} pose; a trajectory for --poses needs two")
    return GivenPoses(trajectory)
