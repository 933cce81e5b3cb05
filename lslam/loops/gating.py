"""Gating of loop candidates: the relative uncertainty of two keyframes by odometry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.geometry import so3
from lslam.kernels import gating
from lslam.types.trajectory import Keyframe

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class RelativeUncertainty:
    """Uncertainty of one keyframe's pose relative to others.

    position : (C, 3, 3) m2, world axes; turn : (C,) rad, standard deviation of the rotation
    """

    position: Floats
    turn: Floats

    @property
    def reach(self) -> Floats:
        """(C,) m, standard deviation of the position where it is worst."""
        return np.asarray(np.sqrt(np.linalg.eigvalsh(self.position)[:, 2]))


class OdometryUncertainty:
    """Relative uncertainty of keyframe poses: odometry's covariances, and systematic drift that they do not model.

    Odometry's covariances accumulate independent errors, transported by the lever arm: with A = [[I, -hat(p_b - p_a)],
    [0, I]], the relative covariance of a and b is S_b - A S_a A^T. Errors of scale and bending are added as
    `drift_percent` of the distance travelled and `drift_deg` per 100 m of it, the latter by the rms distance from b to
    the keyframes since a.
    """

    def __init__(self, keyframes: Sequence[Keyframe], drift_percent: float, drift_deg: float) -> None:
        self.positions = np.array([k.T_world_lidar[:3, 3] for k in keyframes]).reshape(-1, 3)
        self.distances = np.array([k.distance for k in keyframes])
        known = all(k.covariance is not None for k in keyframes)
        self.covariances = np.array([k.covariance for k in keyframes]) if known and keyframes else None
        self._per_m = drift_percent / 100
        self._turn_per_m = np.deg2rad(drift_deg) / 100
        zero = np.zeros((1, 3))
        self._sum = np.concatenate([zero, np.cumsum(self.positions, axis=0)])
        self._squares = np.concatenate([[0.0], np.cumsum((self.positions**2).sum(axis=1))])

    def between(self, b: int, older: NDArray[np.int64]) -> RelativeUncertainty:
        """Uncertainty of keyframe `b` relative to each of the keyframes `older`."""
        travelled = self.distances[b] - self.distances[older]
        turn = self._turn_per_m * travelled
        spread = (self._per_m * travelled) ** 2 + (turn * self._lever(b, older)) ** 2
        position = spread[:, None, None] * np.eye(3)
        square = turn**2
        if self.covariances is not None:
            A = np.tile(np.eye(6), (len(older), 1, 1))
            A[:, :3, 3:] = -so3.hat(self.positions[b] - self.positions[older])
            own = self.covariances[b] - A @ self.covariances[older] @ A.transpose(0, 2, 1)
            position = position + _positive(own[:, :3, :3])
            square = square + np.maximum(np.linalg.eigvalsh(own[:, 3:, 3:])[:, 2], 0.0)
        return RelativeUncertainty(position, np.sqrt(square))

    def gated(self, b: int, among: NDArray[np.int64], least: float, near: float, sigmas: float) -> NDArray[np.int64]:
        """Those `among` the older keyframes (C,) at least `least` m of way ago and no farther from keyframe `b` than `near` m and
        so many times the standard deviation of the position where it is worst (`RelativeUncertainty.reach`).
        """
        covariances = np.zeros((0, 6, 6)) if self.covariances is None else self.covariances
        return np.asarray(gating.gated(
            b, among, self.positions, self.distances, covariances, self._sum, self._squares,
            (self._per_m, float(self._turn_per_m)), (float(least), float(near), float(sigmas)),
        ))  # fmt: skip

    def _lever(self, b: int, older: NDArray[np.int64]) -> Floats:
        """(C,) m, rms distance of keyframe `b` from the keyframes since each of `older`."""
        count = b + 1 - older
        mean = (self._sum[b + 1] - self._sum[older]) / count[:, None]
        squares = (self._squares[b + 1] - self._squares[older]) / count
        p = self.positions[b]
        return np.asarray(np.sqrt(np.maximum(p @ p - 2 * mean @ p + squares, 0.0)))


def _positive(matrices: Floats) -> Floats:
    """Symmetric (C, 3, 3) without negative eigenvalues: the difference of two estimates may have some."""
    values, vectors = np.linalg.eigh(0.5 * (matrices + matrices.transpose(0, 2, 1)))
    return np.asarray((vectors * np.maximum(values, 0.0)[:, None, :]) @ vectors.transpose(0, 2, 1))
