"""The variables of a window of scans and planes, and the factors among them.

The factors are a preintegrated motion, planes as scans see them, and what was marginalised.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lslam.core.arrays import Bools, Floats, Longs
from lslam.core.geometry import se3, so3
from lslam.core.types.imu import MotionState, PreintegratedStep
from lslam.odometry.inertial.filter import Normal
from lslam.odometry.plane_segmentation import linearise_view

# An update: gravity and the gyroscope's axes, which all states share; each state; each plane.
SHARED, STATE_SIZE, PLANE_SIZE = 12, 15, 3
# From the order of `MotionState.covariance` to shared part and state: position, rotation, velocity, biases.
ORDER = np.r_[9:12, 18:27, 0:9, 12:18]


@dataclass(frozen=True)
class WindowValues:
    """gravity (3,) m/s2; axes (3, 3) of the gyroscope; poses (W, 4, 4) T_world_imu; velocities, accel_biases, gyro_biases (W, 3);
    planes (M, 3) closest points in their anchors, m.
    """

    gravity: Floats
    axes: Floats
    poses: Floats
    velocities: Floats
    accel_biases: Floats
    gyro_biases: Floats
    planes: Floats

    @classmethod
    def begin(cls, state: MotionState) -> WindowValues:
        """Values of one state and no planes."""
        return cls(
            state.gravity,
            state.gyro_axes,
            state.T_world_imu[None],
            state.velocity[None],
            state.accel_bias[None],
            state.gyro_bias[None],
            np.zeros((0, 3)),
        )

    @property
    def states(self) -> int:
        """How many states there are."""
        return len(self.poses)

    @property
    def first_plane(self) -> int:
        """Where the planes begin in an update."""
        return SHARED + STATE_SIZE * self.states

    @property
    def size(self) -> int:
        """Length of an update."""
        return self.first_plane + PLANE_SIZE * len(self.planes)

    def retract(self, update: Floats) -> WindowValues:
        """The values after an `update` (N,): rotations by R' = exp(d) R, all others by a sum."""
        x = update[SHARED : self.first_plane].reshape(-1, STATE_SIZE)
        poses = se3.normalise(se3.make(so3.exp(x[:, 3:6]) @ self.poses[:, :3, :3], self.poses[:, :3, 3] + x[:, :3]))
        return WindowValues(
            self.gravity + update[:3],
            self.axes + update[3:SHARED].reshape(3, 3),
            poses,
            self.velocities + x[:, 6:9],
            self.accel_biases + x[:, 9:12],
            self.gyro_biases + x[:, 12:],
            self.planes + update[self.first_plane :].reshape(-1, 3),
        )

    def since(self, before: WindowValues) -> Floats:
        """(N,) update that leads from the values `before`, of as many states and planes, to these."""
        turn = so3.log(self.poses[:, :3, :3] @ np.swapaxes(before.poses[:, :3, :3], 1, 2))
        x = np.concatenate(
            [
                self.poses[:, :3, 3] - before.poses[:, :3, 3],
                turn,
                self.velocities - before.velocities,
                self.accel_biases - before.accel_biases,
                self.gyro_biases - before.gyro_biases,
            ],
            axis=1,
        )
        return np.concatenate(
            [
                self.gravity - before.gravity,
                (self.axes - before.axes).ravel(),
                x.ravel(),
                (self.planes - before.planes).ravel(),
            ]
        )

    def select(self, states: slice, planes: slice | Bools = slice(None)) -> WindowValues:
        """The values of the `states` and `planes`, slices or a mask."""
        return replace(
            self,
            poses=self.poses[states],
            velocities=self.velocities[states],
            accel_biases=self.accel_biases[states],
            gyro_biases=self.gyro_biases[states],
            planes=self.planes[planes],
        )

    def newest(self, covariance: Floats) -> MotionState:
        """The last state, with the `covariance` (27, 27) of shared part and state."""
        C = np.empty_like(covariance)
        C[np.ix_(ORDER, ORDER)] = covariance
        return MotionState(
            self.poses[-1], self.velocities[-1], self.gravity, self.accel_biases[-1], self.gyro_biases[-1], self.axes, C
        )


# Mahalanobis length beyond which a plane counts less (Huber): the square root of the 95 % quantile of chi-square, three degrees.
HUBER_SIGMAS = 2.8


@dataclass(frozen=True)
class WindowPrior:
    """Prior of the oldest state, the shared part and the planes: x^T information x / 2 + gradient x, x since `at`."""

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
        """Empty sightings."""
        return cls(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)))

    def __len__(self) -> int:
        return len(self.states)

    def only(self, which: Bools) -> Sightings:
        """The sightings that the mask `which` (K,) selects."""
        return Sightings(self.states[which], self.planes[which], self.cp[which], self.information[which])

    def join(self, more: Sightings) -> Sightings:
        """These sightings and `more`."""
        return Sightings(
            *(
                np.concatenate([getattr(self, name), getattr(more, name)])
                for name in ("states", "planes", "cp", "information")
            )
        )


def step_residual(values: WindowValues, k: int, step: PreintegratedStep) -> tuple[Floats, Floats]:
    """Residual of state k + 1 relative to the prediction by `step` from state k, and its Jacobian.

    Returns (15,) position, rotation, velocity, biases; (15, 42) by the shared part, state k and state k + 1.
    """
    R, R_end = values.poses[k, :3, :3], values.poses[k + 1, :3, :3]
    t, force = step.seconds, values.accel_biases[k] - step.accel_bias
    rate = np.concatenate([values.gyro_biases[k] - step.gyro_bias, (values.axes - step.gyro_axes).ravel()])
    moved, gained = R @ (step.position - step.position_arm @ force), R @ (step.velocity - step.velocity_arm @ force)
    led = R @ step.rotation @ so3.exp(step.turn_columns @ rate)
    off, v = R_end @ led.T, values.velocities
    r = np.concatenate(
        [
            values.poses[k + 1, :3, 3] - values.poses[k, :3, 3] - t * v[k] - 0.5 * t**2 * values.gravity - moved,
            so3.log(off),
            v[k + 1] - v[k] - t * values.gravity - gained,
            values.accel_biases[k + 1] - values.accel_biases[k],
            values.gyro_biases[k + 1] - values.gyro_biases[k],
        ]
    )
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
    values: WindowValues, sightings: Sightings, anchors: Floats, T_imu_lidar: Floats
) -> tuple[Floats, Floats, Floats]:
    """Measured less expected closest points.

    anchors : (M, 4, 4) T_world_anchor of the planes; T_imu_lidar : (4, 4)

    Returns (K, 3) m; (K, 3, 6) by position and rotation of the IMU; (K, 3, 3) by the plane.
    """
    T_world_lidar = values.poses @ T_imu_lidar
    expected, by_pose, by_plane = linearise_view(
        values.planes[sightings.planes], anchors[sightings.planes], T_world_lidar[sightings.states]
    )
    lever = (T_world_lidar[:, :3, 3] - values.poses[:, :3, 3])[sightings.states]
    by_pose[:, :, 3:] -= by_pose[:, :, :3] @ so3.hat(lever)
    return sightings.cp - expected, -by_pose, -by_plane


def normal_equations(
    values: WindowValues,
    prior: WindowPrior,
    steps: tuple[PreintegratedStep, ...],
    sightings: Sightings,
    anchors: Floats,
    T_imu_lidar: Floats,
) -> Normal:
    """Normal equations of all factors at `values`; `prior` is on the first state and the planes, sightings have Huber weights."""
    H, g = np.zeros((values.size, values.size)), np.zeros(values.size)
    first = np.r_[0 : SHARED + STATE_SIZE, values.first_plane : values.size]
    pull = np.einsum("ij,j->i", prior.information, values.select(slice(1)).since(prior.at)) + prior.gradient
    H[np.ix_(first, first)] += prior.information
    g[first] += pull
    for k, step in enumerate(steps):
        r, J = step_residual(values, k, step)
        weighted = np.linalg.solve(step.covariance, J).T
        a = SHARED + STATE_SIZE * k
        at = np.r_[0:SHARED, a : a + 2 * STATE_SIZE]
        H[np.ix_(at, at)] += weighted @ J
        g[at] += weighted @ r
    if len(sightings):
        r, by_pose, by_plane = sighting_residuals(values, sightings, anchors, T_imu_lidar)
        J = np.concatenate([by_pose, by_plane], axis=2)
        far = np.sqrt(np.einsum("ki,kij,kj->k", r, sightings.information, r))
        weight = np.minimum(1.0, HUBER_SIGMAS / np.maximum(far, HUBER_SIGMAS))
        weighted = np.swapaxes(J, 1, 2) @ (weight[:, None, None] * sightings.information)
        at = np.concatenate(
            [
                SHARED + STATE_SIZE * sightings.states[:, None] + np.arange(6),
                values.first_plane + PLANE_SIZE * sightings.planes[:, None] + np.arange(PLANE_SIZE),
            ],
            axis=1,
        )
        np.add.at(H, (at[:, :, None], at[:, None, :]), weighted @ J)
        np.add.at(g, at, np.einsum("kij,kj->ki", weighted, r))
    return Normal(0.5 * (H + H.T), g)
