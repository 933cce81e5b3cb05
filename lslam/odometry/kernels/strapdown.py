"""Strapdown integration: angular rates to rotations, specific forces to velocities and positions, sample by sample."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.kernels.jit import inline, kernel
from lslam.odometry.kernels.rotation import exponential, multiply, straighten


@kernel
def integrate(
    stamps_ns: NDArray[np.int64],
    gyro: Floats,
    accel: Floats,
    s: int,
    instants_ns: NDArray[np.int64],
    gyro_bias: Floats,
    accel_bias: Floats,
    gyro_axes: Floats,
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Rotations, velocities, positions, velocity arms and position arms at `instants_ns` (K,), as in `Increments`.

    stamps_ns (N,), gyro (N, 3), rad/s, accel (N, 3), m/s2, N >= 1 : the samples; s : index of the first one after instant 0
    gyro_bias, accel_bias (3,), gyro_axes (3, 3) : rates are gyro_axes (gyro - gyro_bias)
    Midpoint rule: between two neighbours among samples and instants the reading is the one in the middle, so that the sums do
    not depend on where the instants lie.
    """
    count = len(instants_ns)
    rotations, velocity_arms, position_arms = np.empty((count, 3, 3)), np.empty((count, 3, 3)), np.empty((count, 3, 3))
    velocities, positions = np.empty((count, 3)), np.empty((count, 3))
    R, halfway, half = np.zeros((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    R[0, 0] = R[1, 1] = R[2, 2] = 1.0
    v, p, V, P = np.zeros(3), np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))
    rate, force = np.empty(3), np.empty(3)
    now = instants_ns[0]
    for k in range(count):
        while now < instants_ns[k]:
            then = instants_ns[k]
            if s < len(stamps_ns):
                then = min(then, stamps_ns[s])
            dt = (then - now) * 1e-9
            _readings(stamps_ns, gyro, s, now, then, gyro_bias, rate)
            _readings(stamps_ns, accel, s, now, then, accel_bias, force)
            x, y, z = rate[0], rate[1], rate[2]
            for i in range(3):
                rate[i] = 0.5 * dt * (gyro_axes[i, 0] * x + gyro_axes[i, 1] * y + gyro_axes[i, 2] * z)
            exponential(rate[0], rate[1], rate[2], half)
            multiply(R, half, halfway)
            multiply(halfway, half, R)
            for i in range(3):
                a = halfway[i, 0] * force[0] + halfway[i, 1] * force[1] + halfway[i, 2] * force[2]
                p[i] += v[i] * dt + 0.5 * a * dt * dt
                v[i] += a * dt
                for j in range(3):
                    P[i, j] += V[i, j] * dt + 0.5 * halfway[i, j] * dt * dt
                    V[i, j] += halfway[i, j] * dt
            now = then
            if s < len(stamps_ns) and stamps_ns[s] == now:
                s += 1
        for i in range(3):
            velocities[k, i], positions[k, i] = v[i], p[i]
            for j in range(3):
                rotations[k, i, j], velocity_arms[k, i, j], position_arms[k, i, j] = R[i, j], V[i, j], P[i, j]
    return rotations, velocities, positions, velocity_arms, position_arms


@inline
def _readings(
    stamps_ns: NDArray[np.int64], values: Floats, s: int, now: int, then: int, bias: Floats, out: Floats
) -> None:
    """out (3,) <- mean reading less the bias from `now` to `then`, ns, with no sample between them; `s` is the next sample.

    Linear between samples, constant before the first and after the last.
    """
    if s == 0 or s == len(stamps_ns):
        k = min(s, len(stamps_ns) - 1)
        for i in range(3):
            out[i] = values[k, i] - bias[i]
        return
    before, after = stamps_ns[s - 1], stamps_ns[s]
    share = 0.5 * ((now - before) + (then - before)) / (after - before)
    for i in range(3):
        out[i] = values[s - 1, i] + share * (values[s, i] - values[s - 1, i]) - bias[i]


@kernel
def poses(
    rotations: Floats,
    velocities: Floats,
    positions: Floats,
    seconds: Floats,
    anchor: int,
    T_world_imu: Floats,
    velocity: Floats,
    gravity: Floats,
    T_imu_lidar: Floats,
) -> Floats:
    """(K, 4, 4) T_world_lidar of an IMU whose pose T_world_imu (4, 4) and velocity (3,) at instant `anchor` are given.

    rotations (K, 3, 3), velocities, positions (K, 3), seconds (K,) : as in `Increments`; gravity : (3,) m/s2, downwards
    """
    count = len(seconds)
    out = np.zeros((count, 4, 4))
    R_first, R_imu, R = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    moved = np.empty(3)
    for i in range(3):
        for j in range(3):
            R[i, j] = rotations[anchor, j, i]
    multiply(T_world_imu, R, R_first)
    for k in range(count):
        multiply(R_first, rotations[k], R_imu)
        multiply(R_imu, T_imu_lidar, R)
        tau = seconds[k] - seconds[anchor]
        for j in range(3):
            moved[j] = positions[k, j] - positions[anchor, j] - tau * velocities[anchor, j]
        for i in range(3):
            out[k, i, 3] = (
                T_world_imu[i, 3]
                + tau * velocity[i]
                + 0.5 * tau * tau * gravity[i]
                + R_first[i, 0] * moved[0]
                + R_first[i, 1] * moved[1]
                + R_first[i, 2] * moved[2]
                + R_imu[i, 0] * T_imu_lidar[0, 3]
                + R_imu[i, 1] * T_imu_lidar[1, 3]
                + R_imu[i, 2] * T_imu_lidar[2, 3]
            )
        straighten(R)
        for i in range(3):
            for j in range(3):
                out[k, i, j] = R[i, j]
        out[k, 3, 3] = 1.0
    return out


@kernel
def overlaps(stretches: NDArray[np.int64], begin: int, end: int) -> bool:
    """Whether one of the `stretches` (G, 2) of time overlaps the one from `begin` to `end` by more than an instant."""
    found = False
    for k in range(len(stretches)):
        found |= stretches[k, 0] < end and stretches[k, 1] > begin
    return found
