"""Where the run is on the map, as the walls seen so far say: an estimate that follows odometry and is held by matches.

Its uncertainty opens the window in which the next match is sought, and judges what is found there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.geometry import se2

Floats = NDArray[np.float64]

# m over which the drift of odometry is one and the same: over so far it adds up in proportion to the way.
MEMORY = 100.0
# Directions with less than this share of the largest information are free.
FREE = 1e-9


class OsmTrack:
    """Planar pose (3,) in the map frame and its covariance (3, 3).

    percent, rad_per_m : one sigma of odometry's drift, % of the way and rad per m of it
    map_sigma : (3,) m, m, rad by which what stands about one place is off in the map, however well it is seen
    """

    def __init__(self, pose: Floats, sigma: Floats, percent: float, rad_per_m: float, map_sigma: Floats) -> None:
        self.pose: Floats = np.asarray(pose, np.float64)
        self.covariance: Floats = np.diag(np.asarray(sigma, np.float64) ** 2)
        self._drift: Floats = np.array([0.01 * percent, 0.01 * percent, rad_per_m], np.float64) ** 2
        self._map: Floats = np.asarray(map_sigma, np.float64) ** 2

    @property
    def sigma(self) -> Floats:
        """(3,) m, m, rad, of the pose against what stands about it in the map."""
        return np.asarray(np.sqrt(np.diag(self.covariance) + self._map))

    def move(self, step: Floats, way: float) -> None:
        """Go on by `step` (3,) in the track's own axes, `way` m long."""
        moved = se2.compose(self.pose, step)
        ahead: Floats = np.eye(3)
        ahead[:2, 2] = [-(moved[1] - self.pose[1]), moved[0] - self.pose[0]]
        self.covariance = ahead @ self.covariance @ ahead.T + np.diag(self._drift * way * MEMORY)
        self.pose = moved

    def begin(self, pose: Floats, information: Floats) -> None:
        """Be where a match that fixes everything says, and nowhere else."""
        self.pose = np.asarray(pose, np.float64)
        self.covariance = np.asarray(np.linalg.inv(information) + np.diag(self._map))

    def squared(self, pose: Floats, information: Floats) -> tuple[float, int]:
        """Squared Mahalanobis distance of a match from the track, of the directions it fixes, and how many these are."""
        error, H, R = self._innovation(pose, information)
        S = H @ self.covariance @ H.T + R
        return float(error @ np.linalg.solve(S, error)), len(error)

    def take(self, pose: Floats, information: Floats) -> None:
        """Believe a match."""
        error, H, R = self._innovation(pose, information)
        gain = np.linalg.solve(H @ self.covariance @ H.T + R, H @ self.covariance).T
        moved = self.pose + gain @ error
        self.pose = np.array([moved[0], moved[1], se2.wrapped(moved[2])])
        kept: Floats = np.eye(3) - gain @ H
        self.covariance = kept @ self.covariance @ kept.T + gain @ R @ gain.T

    def _innovation(self, pose: Floats, information: Floats) -> tuple[Floats, Floats, Floats]:
        """Error, directions and covariance of what the match fixes."""
        values, axes = np.linalg.eigh(information)
        is_seen = values > FREE * values[-1]
        H = axes[:, is_seen].T
        away = np.asarray(pose, np.float64) - self.pose
        away[2] = se2.wrapped(away[2])
        return H @ away, H, np.diag(1.0 / values[is_seen]) + H @ np.diag(self._map) @ H.T
