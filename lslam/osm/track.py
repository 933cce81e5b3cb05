"""The track of a run on the map: a planar Kalman filter, predicted by odometry and updated by matches.

Its covariance gives the window in which the next match is searched, and gates the match.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.geometry import se2
from lslam.core.types.building import KeyframeMatch

# m, correlation length of odometry's drift.
MEMORY_M = 100.0
# Directions with less than this share of the largest information are unobserved.
FREE = 1e-9
# Alignment of a run with its matches: iterations, and degrees of freedom of the residuals (Student's t) against wrong ones.
ROUNDS, FREEDOM = 10, 3.0


class OsmTrack:
    """Planar pose (3,) in the map frame and its covariance (3, 3).

    percent, rad_per_m : one sigma of odometry's drift, % of the way and rad per m of it
    map_sigma : (3,) m, m, rad, local error of the map
    """

    def __init__(self, pose: Floats, sigma: Floats, percent: float, rad_per_m: float, map_sigma: Floats) -> None:
        self.pose: Floats = np.asarray(pose, np.float64)
        self.covariance: Floats = np.diag(np.asarray(sigma, np.float64) ** 2)
        self._drift: Floats = np.array([0.01 * percent, 0.01 * percent, rad_per_m], np.float64) ** 2
        self._map: Floats = np.asarray(map_sigma, np.float64) ** 2

    @property
    def sigma(self) -> Floats:
        """Sigma (3,), m, m, rad, of the pose relative to the map around it."""
        return np.asarray(np.sqrt(np.diag(self.covariance) + self._map))

    def move(self, step: Floats, way: float) -> None:
        """Predict by the relative pose `step` (3,) of odometry, over a distance travelled of `way`, m."""
        moved = se2.compose(self.pose, step)
        ahead: Floats = np.eye(3)
        ahead[:2, 2] = [-(moved[1] - self.pose[1]), moved[0] - self.pose[0]]
        self.covariance = ahead @ self.covariance @ ahead.T + np.diag(self._drift * way * MEMORY_M)
        self.pose = moved

    def begin(self, pose: Floats, information: Floats) -> None:
        """Reset the track to the pose (3,) and information (3, 3) of a match of full rank, and add the map's local error."""
        self.pose = np.asarray(pose, np.float64)
        self.covariance = np.asarray(np.linalg.inv(information) + np.diag(self._map))

    def squared_distance(self, pose: Floats, information: Floats) -> tuple[float, int]:
        """Squared Mahalanobis distance of a match from the track, along the directions it observes, and their number."""
        error, H, R = self._innovation(pose, information)
        S = H @ self.covariance @ H.T + R
        return float(error @ np.linalg.solve(S, error)), len(error)

    def correct(self, pose: Floats, information: Floats) -> None:
        """Kalman update with a matched pose (3,), map frame, and its information (3, 3), which may be singular."""
        error, H, R = self._innovation(pose, information)
        gain = np.linalg.solve(H @ self.covariance @ H.T + R, H @ self.covariance).T
        moved = self.pose + gain @ error
        self.pose = np.array([moved[0], moved[1], se2.wrap(moved[2])])
        kept: Floats = np.eye(3) - gain @ H
        self.covariance = kept @ self.covariance @ kept.T + gain @ R @ gain.T

    def align(
        self, poses: Floats, ways: Floats, matches: Sequence[KeyframeMatch], sigma: Floats
    ) -> tuple[float, Floats]:
        """Align `poses` (M, 3) as a whole with their `matches`, one each.

        The displacement has the prior `sigma` (3,), m, m, rad. The weight of a match decreases with the distance travelled,
        `ways` (M,), m, from the first one.

        Returns the rotation, rad, about the first pose, and the squared Mahalanobis distances (M,) of the matches.
        """
        weights = np.stack(
            [
                self._weight(m.information, self._map + self._drift * abs(way - ways[0]) * MEMORY_M)
                for m, way in zip(matches, ways, strict=True)
            ]
        )
        real, pivot = np.stack([m.pose for m in matches]), np.append(poses[0, :2], 0.0)
        about, moved, squared = se2.relative(pivot, poses), np.zeros(3), np.zeros(len(poses))
        for _ in range(ROUNDS):
            there = se2.compose(pivot + moved, about)
            away = real - there
            away[:, 2] = se2.wrap(away[:, 2])
            squared = np.einsum("mi,mij,mj->m", away, weights, away)
            robust = (FREEDOM + 1.0) / (FREEDOM + squared)
            effect = np.tile(np.eye(3), (len(there), 1, 1))
            effect[:, 0, 2], effect[:, 1, 2] = pivot[1] + moved[1] - there[:, 1], there[:, 0] - pivot[0] - moved[0]
            pulls = np.swapaxes(effect, -1, -2) @ (robust[:, None, None] * weights)
            normal = np.diag(1.0 / sigma**2) + (pulls @ effect).sum(axis=0)
            pull = (pulls @ away[:, :, None]).sum(axis=0)[:, 0] - moved / sigma**2
            moved = moved + np.linalg.solve(normal, pull)
        return float(moved[2]), squared

    def is_accurate(self, information: Floats) -> bool:
        """Whether the sigmas of a match of full rank are at most those of the map."""
        return bool((np.diag(np.linalg.inv(information)) <= self._map).all())

    @staticmethod
    def _weight(information: Floats, variance: Floats) -> Floats:
        """Information (3, 3) of a match with an additional `variance` (3,); unobserved directions remain unobserved."""
        H, own = _directions(information)
        return np.asarray(H.T @ np.linalg.solve(own + H @ np.diag(variance) @ H.T, H))

    def _innovation(self, pose: Floats, information: Floats) -> tuple[Floats, Floats, Floats]:
        """Innovation (R,) of a match at `pose` (3,), its Jacobian (R, 3) and the covariance (R, R) of match and map.

        The track's own covariance is not in it. R directions are observed, as `information` (3, 3) says.
        """
        H, own = _directions(information)
        away = np.asarray(pose, np.float64) - self.pose
        away[2] = se2.wrap(away[2])
        return H @ away, H, own + H @ np.diag(self._map) @ H.T


def _directions(information: Floats) -> tuple[Floats, Floats]:
    """Directions (R, 3) that a match observes, and the covariance (R, R) along them."""
    values, axes = np.linalg.eigh(information)
    is_seen = values > FREE * values[-1]
    return axes[:, is_seen].T, np.diag(1.0 / values[is_seen])
