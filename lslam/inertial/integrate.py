"""Between two instants: angular rates integrated on SO(3), specific force rotated and integrated twice."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.geometry import so3
from lslam.types.imu import ImuStream

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Increments:
    """What an IMU felt since the first of some instants, in its own axes at that instant, gravity not removed.

    instants_ns : (K,) increasing; rotations : (K, 3, 3) from the IMU then to the IMU at the first instant
    velocities (K, 3), positions (K, 3) : the specific force integrated once and twice, m/s and m
    velocity_arms, position_arms : (K, 3, 3) likewise of the rotations: what a constant force in IMU axes adds
    """

    instants_ns: NDArray[np.int64]
    rotations: Floats
    velocities: Floats
    positions: Floats
    velocity_arms: Floats
    position_arms: Floats

    @property
    def seconds(self) -> Floats:
        """(K,) since the first instant."""
        return np.asarray((self.instants_ns - self.instants_ns[0]) * 1e-9)

    def motion(self, anchor: int, R: Floats, velocity: Floats, gravity: Floats) -> tuple[Floats, Floats, Floats]:
        """Rotations (K, 3, 3), velocities (K, 3) and positions (K, 3) in the world, relative to the position at `anchor`.

        R (3, 3), velocity (3,) : of the IMU in the world at instant `anchor`; gravity : (3,) m/s2, downwards
        """
        seconds = self.seconds
        tau = (seconds - seconds[anchor])[:, None]
        R_first = R @ self.rotations[anchor].T
        gained = self.velocities - self.velocities[anchor]
        moved = self.positions - self.positions[anchor] - tau * self.velocities[anchor]
        return (
            np.asarray(R_first @ self.rotations),
            velocity + gained @ R_first.T + tau * gravity,
            tau * velocity + moved @ R_first.T + 0.5 * tau**2 * gravity,
        )


def integrate(
    imu: ImuStream, instants_ns: NDArray[np.int64], gyro_bias: Floats, accel_bias: Floats,
    gyro_axes: Floats | None = None,
) -> Increments:  # fmt: skip
    """Integrate the stream over increasing `instants_ns` (K,), K >= 1, with the biases (3,) taken off.

    gyro_axes : (3, 3) that makes true rates of the gyroscope's readings less their bias; None takes them as they are

    Readings are linear between samples and constant beyond the ends of the stream, so the result does not depend on how the
    instants lie among the samples (midpoint rule: exact for a constant rate and force).
    """
    lo, hi = int(instants_ns[0]), int(instants_ns[-1])
    i, j = np.searchsorted(imu.stamps_ns, [lo, hi])
    grid, where = np.unique(np.concatenate([instants_ns, imu.stamps_ns[i:j]]), return_inverse=True)
    nodes = where[: len(instants_ns)]
    dt = np.diff(grid) * 1e-9
    middles = 0.5 * (grid[:-1] + grid[1:] - 2 * lo)
    gyro, accel = _sampled(imu, i, j, lo, middles)
    gyro, accel = gyro - gyro_bias, accel - accel_bias
    if gyro_axes is not None:
        gyro = gyro @ gyro_axes.T
    R = np.empty((len(grid), 3, 3))
    R[0] = np.eye(3)
    steps = so3.exp(gyro * dt[:, None])
    for k, step in enumerate(steps):
        R[k + 1] = R[k] @ step
    halfway = R[:-1] @ so3.exp(0.5 * gyro * dt[:, None])
    velocities, positions = _twice(np.einsum("kij,kj->ki", halfway, accel), dt)
    velocity_arms, position_arms = _twice(halfway, dt)
    return Increments(
        instants_ns, R[nodes], velocities[nodes], positions[nodes], velocity_arms[nodes], position_arms[nodes]
    )


def _sampled(imu: ImuStream, i: int, j: int, origin: int, query: Floats) -> tuple[Floats, Floats]:
    """Gyroscope and accelerometer at `query` (Q,) ns since `origin`, from samples i..j and their neighbours."""
    near = slice(max(int(i) - 1, 0), min(int(j) + 1, len(imu)))
    times = (imu.stamps_ns[near] - origin).astype(np.float64)

    def at(values: NDArray[Any]) -> Floats:
        return np.stack([np.interp(query, times, values[near, axis]) for axis in range(3)], axis=-1)

    return at(imu.gyro), at(imu.accel)


def _twice(rates: Floats, dt: Floats) -> tuple[Floats, Floats]:
    """First and second integral (K + 1, ...) of `rates` (K, ...), constant over each of `dt` (K,)."""
    shape = (-1,) + (1,) * (rates.ndim - 1)
    h = dt.reshape(shape)
    first = (
        np.concatenate([np.zeros_like(rates[:1]), np.cumsum(rates * h, axis=0)])
        if len(dt)
        else np.zeros((1, *rates.shape[1:]))
    )
    steps = first[:-1] * h + 0.5 * rates * h**2
    second = np.concatenate([np.zeros_like(first[:1]), np.cumsum(steps, axis=0)])
    return first, second
