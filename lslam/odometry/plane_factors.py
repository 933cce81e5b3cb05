"""Factors of a window of scans and planes: a preintegrated motion, planes as scans see them, and what was marginalised."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lslam.core.geometry import so3
from lslam.core.geometry.normal_equations import Normal
from lslam.core.types.arrays import Bools, Floats, Longs
from lslam.core.types.imu import PreintegratedStep
from lslam.odometry import closest_point
from lslam.odometry.plane_values import PLANE_SIZE, SHARED, STATE_SIZE, WindowValues

# Mahalanobis length beyond which a plane counts less (Huber): the square root of the 95 % quantile of chi-square, three degrees.
HUBER = 2.8


@dataclass(frozen=True)
class WindowPrior:
    """What is known of the oldest state, the shared part and the planes: x^T information x / 2 + gradient x, x since `at`."""

    information: Floats
    gradient: Floats
    at: WindowValues


@dataclass(frozen=True)
class Sightings:
    """Planes as scans saw them.

    states, planes : (K,) which state saw which plane; cp : (K, 3) closest points in the LiDAR's frame, m
    information : (K, 3, 3) of these, 1/m2
    """

    states: Longs
    planes: Longs
    cp: Floats
    information: Floats

    @classmethod
    def none(cls) -> Sightings:
        """No sighting."""
        return cls(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)))

    def __len__(self) -> int:
        return len(self.states)

    def only(self, which: Bools) -> Sightings:
        """Some of them."""
        return Sightings(self.states[which], self.planes[which], self.cp[which], self.information[which])

    def joined(self, more: Sightings) -> Sightings:
        """These and `more`."""
        return Sightings(*(
            np.concatenate([getattr(self, name), getattr(more, name)])
            for name in ("states", "planes", "cp", "information")
        ))  # fmt: skip


def step_residual(values: WindowValues, k: int, step: PreintegratedStep) -> tuple[Floats, Floats]:
    """What state k + 1 is off from where `step` leads from state k.

    Returns
    -------
    (15,) position, rotation, velocity, biases; (15, 42) by the shared part, state k and state k + 1
    """
    R, R_end = values.poses[k, :3, :3], values.poses[k + 1, :3, :3]
    t, force = step.seconds, values.accel_biases[k] - step.accel_bias
    rate = np.concatenate([values.gyro_biases[k] - step.gyro_bias, (values.axes - step.gyro_axes).ravel()])
    moved, gained = R @ (step.position - step.position_arm @ force), R @ (step.velocity - step.velocity_arm @ force)
    led = R @ step.rotation @ so3.exp(step.turn_columns @ rate)
    off, v = R_end @ led.T, values.velocities
    r = np.concatenate([
        values.poses[k + 1, :3, 3] - values.poses[k, :3, 3] - t * v[k] - 0.5 * t**2 * values.gravity - moved, so3.log(off),
        v[k + 1] - v[k] - t * values.gravity - gained, values.accel_biases[k + 1] - values.accel_biases[k],
        values.gyro_biases[k + 1] - values.gyro_biases[k],
    ])  # fmt: skip
    J, one, turn = np.zeros((15, SHARED + 2 * STATE_SIZE)), np.eye(3), -R_end @ step.turn_columns
    J[0:3, 0:3], J[6:9, 0:3] = -0.5 * t**2 * one, -t * one
    J[3:6, 3:12] = turn[:, 3:]
    a = SHARED
    J[0:3, a : a + 3], J[0:3, a + 3 : a + 6], J[0:3, a + 6 : a + 9] = -one, so3.hat(moved), -t * one
    J[0:3, a + 9 : a + 12], J[6:9, a + 9 : a + 12] = R @ step.position_arm, R @ step.velocity_arm
    J[3:6, a + 3 : a + 6], J[3:6, a + 12 : a + 15] = -off, turn[:, :3]
    J[6:9, a + 3 : a + 6], J[6:9, a + 6 : a + 9] = so3.hat(gained), -one
    J[9:15, a + 9 : a + 15] = -np.eye(6)
    J[:, a + 15 :] = np.eye(15)
    return r, J


def sighting_residuals(
    values: WindowValues, seen: Sightings, anchors: Floats, T_imu_lidar: Floats
) -> tuple[Floats, Floats, Floats]:
    """Measured less expected closest points.

    anchors : (M, 4, 4) T_world_anchor of the planes; T_imu_lidar : (4, 4)

    Returns
    -------
    (K, 3) m; (K, 3, 6) by position and rotation of the IMU; (K, 3, 3) by the plane
    """
    T_world_lidar = values.poses @ T_imu_lidar
    found, by_pose, by_plane = closest_point.linearised(
        values.planes[seen.planes], anchors[seen.planes], T_world_lidar[seen.states]
    )
    lever = (T_world_lidar[:, :3, 3] - values.poses[:, :3, 3])[seen.states]
    by_pose[:, :, 3:] -= by_pose[:, :, :3] @ so3.hat(lever)
    return seen.cp - found, -by_pose, -by_plane


def normal_equations(
    values: WindowValues,
    prior: WindowPrior,
    steps: tuple[PreintegratedStep, ...],
    seen: Sightings,
    anchors: Floats,
    T_imu_lidar: Floats,
) -> Normal:
    """All factors at `values`; the prior is on the first state."""
    H, g = np.zeros((values.size, values.size)), np.zeros(values.size)
    first = np.r_[0 : SHARED + STATE_SIZE, values.first_plane : values.size]
    known = np.einsum("ij,j->i", prior.information, values.cut(slice(1)).since(prior.at)) + prior.gradient
    H[np.ix_(first, first)] += prior.information
    g[first] += known
    for k, step in enumerate(steps):
        r, J = step_residual(values, k, step)
        weighted = np.linalg.solve(step.covariance, J).T
        a = SHARED + STATE_SIZE * k
        at = np.r_[0:SHARED, a : a + 2 * STATE_SIZE]
        H[np.ix_(at, at)] += weighted @ J
        g[at] += weighted @ r
    if len(seen):
        r, by_pose, by_plane = sighting_residuals(values, seen, anchors, T_imu_lidar)
        J = np.concatenate([by_pose, by_plane], axis=2)
        far = np.sqrt(np.einsum("ki,kij,kj->k", r, seen.information, r))
        weight = np.minimum(1.0, HUBER / np.maximum(far, HUBER))
        weighted = np.swapaxes(J, 1, 2) @ (weight[:, None, None] * seen.information)
        at = np.concatenate([
            SHARED + STATE_SIZE * seen.states[:, None] + np.arange(6),
            values.first_plane + PLANE_SIZE * seen.planes[:, None] + np.arange(PLANE_SIZE),
        ], axis=1)  # fmt: skip
        np.add.at(H, (at[:, :, None], at[:, None, :]), weighted @ J)
        np.add.at(g, at, np.einsum("kij,kj->ki", weighted, r))
    return Normal(0.5 * (H + H.T), g)
