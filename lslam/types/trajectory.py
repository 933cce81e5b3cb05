"""A stamped sequence of poses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray


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

    stamps_ns: NDArray[np.int64]
    poses: NDArray[np.float64]
    frame: str = "lidar"
    has_stamps: bool = True
    covariances: NDArray[np.float64] | None = None
    source: str = ""
    has_rotations: bool = True
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def positions(self) -> NDArray[np.float64]:
        """(N, 3) positions, m."""
        return self.poses[:, :3, 3]

    @property
    def path_lengths(self) -> NDArray[np.float64]:
        """(N,) distance travelled up to each pose, m; starts at 0."""
        steps = np.linalg.norm(np.diff(self.positions, axis=0), axis=1)
        return np.concatenate([np.zeros(min(len(self), 1)), np.cumsum(steps)])

    def select(self, index: Any) -> Trajectory:
        """The poses at `index` (a slice, indices or a mask)."""
        return replace(
            self,
            stamps_ns=self.stamps_ns[index],
            poses=self.poses[index],
            covariances=None if self.covariances is None else self.covariances[index],
        )
