"""The variables of a window of scans and planes, and how an update moves them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lslam.core.geometry import se3, so3
from lslam.core.types.arrays import Bools, Floats
from lslam.core.types.imu import MotionState

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
        """One state and no planes."""
        return cls(
            state.gravity, state.gyro_axes, state.T_world_imu[None], state.velocity[None], state.accel_bias[None],
            state.gyro_bias[None], np.zeros((0, 3)),
        )  # fmt: skip

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

    def moved(self, update: Floats) -> WindowValues:
        """The values after an `update` (N,): rotations by R' = exp(d) R, all others by a sum."""
        x = update[SHARED : self.first_plane].reshape(-1, STATE_SIZE)
        poses = se3.normalise(se3.make(so3.exp(x[:, 3:6]) @ self.poses[:, :3, :3], self.poses[:, :3, 3] + x[:, :3]))
        return WindowValues(
            self.gravity + update[:3], self.axes + update[3:SHARED].reshape(3, 3), poses, self.velocities + x[:, 6:9],
            self.accel_biases + x[:, 9:12], self.gyro_biases + x[:, 12:],
            self.planes + update[self.first_plane :].reshape(-1, 3),
        )  # fmt: skip

    def since(self, before: WindowValues) -> Floats:
        """(N,) the update that leads here from values `before` of as many states and planes."""
        turn = so3.log(self.poses[:, :3, :3] @ np.swapaxes(before.poses[:, :3, :3], 1, 2))
        x = np.concatenate([
            self.poses[:, :3, 3] - before.poses[:, :3, 3], turn, self.velocities - before.velocities,
            self.accel_biases - before.accel_biases, self.gyro_biases - before.gyro_biases,
        ], axis=1)  # fmt: skip
        return np.concatenate([
            self.gravity - before.gravity, (self.axes - before.axes).ravel(), x.ravel(),
            (self.planes - before.planes).ravel(),
        ])  # fmt: skip

    def cut(self, states: slice, planes: slice | Bools = slice(None)) -> WindowValues:
        """Some of the states and planes."""
        return replace(
            self, poses=self.poses[states], velocities=self.velocities[states], accel_biases=self.accel_biases[states],
            gyro_biases=self.gyro_biases[states], planes=self.planes[planes],
        )  # fmt: skip

    def newest(self, covariance: Floats) -> MotionState:
        """The last state, with the `covariance` (27, 27) of shared part and state."""
        C = np.empty_like(covariance)
        C[np.ix_(ORDER, ORDER)] = covariance
        return MotionState(
            self.poses[-1], self.velocities[-1], self.gravity, self.accel_biases[-1], self.gyro_biases[-1], self.axes, C
        )
