"""How the truth's body is turned against the estimate's, by the motions of both: A X = X B, X held by one body (Tsai 1989)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.geometry import se3, so3

Floats = NDArray[np.float64]

# Motions that are compared, at most, and how long they are at least: noise of poses counts less over more way.
MOST, LEAST_M, LEAST_RAD = 300, 5.0, np.deg2rad(15.0)
FEWEST = 6
# One sigma of what odometry and truth disagree by in direction without any calibration to blame: drift to one side of a
# percent of the way.
DRIFT_RAD = 0.01
ROUNDS, SCALE = 30, 1.345


@dataclass(frozen=True)
class BodyTurn:
    """rotation (3,): rotation vector that takes directions of the truth's body into the estimate's, rad, 0 about what the
    motion does not tell; covariance (3, 3) of it, rad2
    """

    rotation: Floats
    covariance: Floats

    @property
    def angle(self) -> float:
        """rad."""
        return float(np.linalg.norm(self.rotation))

    @property
    def sigma(self) -> float:
        """One sigma of the angle, rad."""
        axis = self.rotation / max(self.angle, 1e-12)
        return float(np.sqrt(axis @ self.covariance @ axis))

    @property
    def squared(self) -> float:
        """Chi-square of three degrees of freedom where nothing is turned."""
        return float(self.rotation @ np.linalg.solve(self.covariance, self.rotation))


def body_turn(estimate: Floats, truth: Floats) -> BodyTurn | None:
    """The turn between the bodies of matched poses (N, 4, 4), None where there is too little motion.

    Motions from one pose to a later one, A of the estimate and B of the truth, fulfil A X = X B for the transform X between
    the bodies. Rotation and lever arm are fitted by robust least squares; what is left of the motions tells sigmas, to which
    drift adds its own.
    """
    pairs = _pairs(truth)
    if len(pairs) < FEWEST:
        return None
    A, B = (se3.relative(poses[pairs[:, 0]], poses[pairs[:, 1]]) for poses in (estimate, truth))
    R, x = np.eye(3), np.zeros(6)
    # A weak prior at no rotation and no lever arm, for unobservable directions.
    hold = np.diag(np.repeat([1.0, 1e-2], 3))
    for _ in range(ROUNDS):
        r, J = _linearised(A, B, R, x[3:])
        sizes = np.linalg.norm(r.reshape(len(r), 2, 3), axis=2)
        scales = np.maximum(1.4826 * np.median(sizes, axis=0) / 1.538, (1e-6, 1e-6))
        weights = np.minimum(SCALE * np.sqrt(3) * scales / np.maximum(sizes, 1e-12), 1.0) / scales**2
        w = np.repeat(weights, 3, axis=1)
        information = np.einsum("nij,ni,nik->jk", J, w, J)
        step = -np.linalg.solve(information + hold, np.einsum("nij,ni,ni->j", J, w, r) + hold @ _state(R, x))
        R, x = so3.exp(step[:3]) @ R, x + np.concatenate([np.zeros(3), step[3:]])
        if np.linalg.norm(step) < 1e-9:
            break
    covariance = np.linalg.inv(information + hold)[:3, :3] + DRIFT_RAD**2 * np.eye(3)
    return BodyTurn(np.asarray(so3.log(R)), covariance)


def _state(R: Floats, x: Floats) -> Floats:
    return np.concatenate([so3.log(R), x[3:]])


def _pairs(truth: Floats) -> NDArray[np.intp]:
    """(K, 2) first and last pose of motions one after the other, each the shortest that is long enough."""
    steps = se3.relative(truth[:-1], truth[1:])
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps[:, :3, 3], axis=1))])
    turn = np.concatenate([[0.0], np.cumsum(so3.angle(steps[:, :3, :3]))])
    found, first = [], 0
    for k in range(1, len(truth)):
        if way[k] - way[first] >= LEAST_M or turn[k] - turn[first] >= LEAST_RAD:
            found.append((first, k))
            first = k
    return np.array(found[:: 1 + len(found) // MOST], np.intp).reshape(-1, 2)


def _linearised(A: Floats, B: Floats, R: Floats, t: Floats) -> tuple[Floats, Floats]:
    """(K, 6) residuals of turns and ways, and (K, 6, 6) derivatives by a turn of R from the left and the lever arm `t`."""
    turn_a, turn_b = so3.log(A[:, :3, :3]), so3.log(B[:, :3, :3]) @ R.T
    way_b = B[:, :3, 3] @ R.T
    arm = A[:, :3, :3] - np.eye(3)
    r = np.concatenate([turn_a - turn_b, A[:, :3, 3] + arm @ t - way_b], axis=1)
    J = np.zeros((len(A), 6, 6))
    J[:, :3, :3], J[:, 3:, :3] = so3.hat(turn_b), so3.hat(way_b)
    J[:, 3:, 3:] = arm
    return r, J
