"""Stamped poses of a run, its keyframes, and its segments."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lslam.core.arrays import Floats, Longs


@dataclass(frozen=True)
class Trajectory:
    """Poses of one body in one world.

    stamps_ns : (N,) int64; poses : (N, 4, 4) float64 T_world_body; frame : the body, `lidar`, `cam0`, `imu` or `unknown`
    has_stamps : False when the file format has no time and stamps merely count scans at 10 Hz
    covariances : (N, 6, 6) float64 of t' = t + d[:3], R' = exp(d[3:]) R in world axes, m2 and rad2, or None
    source : file or method the poses come from
    has_rotations : False for positions alone, as of a prism or RTK; the poses' rotations are then identity and mean nothing
    notes : what the reader chose and left out
    """

    stamps_ns: Longs
    poses: Floats
    frame: str = "lidar"
    has_stamps: bool = True
    covariances: Floats | None = None
    source: str = ""
    has_rotations: bool = True
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def positions(self) -> Floats:
        """(N, 3) positions, m."""
        return self.poses[:, :3, 3]

    @property
    def path_lengths(self) -> Floats:
        """(N,) distance travelled up to each pose, m; starts at 0."""
        steps = np.linalg.norm(np.diff(self.positions, axis=0), axis=1)
        return np.concatenate([np.zeros(min(len(self), 1)), np.cumsum(steps)])

    def select(self, index: Any) -> Trajectory:
        """The trajectory of the poses at `index` (a slice, indices or a mask)."""
        return replace(
            self,
            stamps_ns=self.stamps_ns[index],
            poses=self.poses[index],
            covariances=None if self.covariances is None else self.covariances[index],
        )


@dataclass(frozen=True)
class Keyframe:
    """A node of the pose graph; its cloud lies in the keyframe store.

    number : 0, 1, 2, ... among the keyframes
    scan : position of its scan among the scans of the run (not the scan's number in the recording)
    T_world_lidar : (4, 4) odometry pose at the scan's stamp
    covariance : (6, 6) of the pose in the world, t' = t + d[:3], R' = exp(d[3:]) R in world axes, m2 and rad2, or None
    distance : m travelled since the start of the run
    """

    number: int
    scan: int
    stamp_ns: int
    T_world_lidar: Floats
    covariance: Floats | None = None
    distance: float = 0.0


@dataclass(frozen=True)
class Segment:
    """Consecutive scans of one local map.

    first, last : numbers of its scans in the recording; scans, registered : how many there are
    frame : of the coordinates of its poses, 0 for those of the trajectory
    tied_by : what ties it to the segments before it in its frame, in words; empty for the first of a frame
    reason : why nothing does, empty where something does or nothing is needed
    """

    number: int
    first: int
    last: int
    scans: int
    registered: int
    frame: int = 0
    tied_by: str = ""
    reason: str = ""

    @property
    def span(self) -> str:
        """Its scans in words."""
        return f"scan {self.first}" if self.first == self.last else f"scans {self.first} to {self.last}"
