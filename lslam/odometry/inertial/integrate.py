"""Between two instants: angular rates integrated on SO(3), specific force rotated and integrated twice."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.types.imu import ImuStream
from lslam.odometry.kernels import strapdown

PERFECT = np.eye(3)


@dataclass(frozen=True)
class Increments:
    """Preintegrated IMU readings since the first of some instants, in IMU axes at that instant, gravity not removed.

    instants_ns : (K,) increasing; rotations : (K, 3, 3) from the IMU then to the IMU at the first instant
    velocities (K, 3), positions (K, 3) : the specific force integrated once and twice, m/s and m
    velocity_arms, position_arms : (K, 3, 3) rotations integrated likewise: the effect of a constant force in IMU axes
    imu, offset_ns : the stream, and the offset added to its stamps
    hidden : (6,) one sigma of the mean force and rate, to the last instant, that the range of the IMU cut off; None for none
    """

    instants_ns: Longs
    rotations: Floats
    velocities: Floats
    positions: Floats
    velocity_arms: Floats
    position_arms: Floats
    imu: ImuStream
    offset_ns: int
    hidden: Floats | None = None

    @property
    def readings(self) -> Floats:
        """(2, 3) rad/s of the gyroscope at the first and the last instant."""
        return _readings(self.imu, self.instants_ns[[0, -1]] - self.offset_ns)

    @property
    def seconds(self) -> Floats:
        """(K,) since the first instant."""
        return np.asarray((self.instants_ns - self.instants_ns[0]) * 1e-9)

    @property
    def duration(self) -> float:
        """Seconds from the first instant to the last."""
        return 1e-9 * int(self.instants_ns[-1] - self.instants_ns[0])

    @property
    def hidden_density(self) -> tuple[float, float]:
        """(m/s2)^2 and (rad/s)^2 per Hz of white noise that adds as much over the step as what is hidden over all of it does.

        Of the worst axis; 0 where nothing is hidden.
        """
        if self.hidden is None:
            return 0.0, 0.0
        return float(self.hidden[:3].max()) ** 2 * self.duration, float(self.hidden[3:].max()) ** 2 * self.duration

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

    def poses(self, anchor: int, T: Floats, velocity: Floats, gravity: Floats, T_imu_lidar: Floats) -> Floats:
        """(K, 4, 4) T_world_lidar; T (4, 4), velocity (3,) : of the IMU in the world at instant `anchor`; as in `motion`."""
        return strapdown.poses(
            self.rotations, self.velocities, self.positions, self.seconds, anchor, T, velocity, gravity, T_imu_lidar
        )


def integrate(
    imu: ImuStream,
    instants_ns: Longs,
    gyro_bias: Floats,
    accel_bias: Floats,
    gyro_axes: Floats | None = None,
    mounting: Floats | None = None,
    offset_ns: int = 0,
) -> Increments:
    """Integrate the stream over increasing `instants_ns` (K,), K >= 1, with the biases (3,) subtracted.

    gyro_axes : (3, 3) from the gyroscope's readings less their bias to true rates; None: the identity
    mounting : (3, 3) likewise of the forces; offset_ns : to add to the stamps of the stream

    Readings are linear between samples and constant beyond the ends of the stream, so the result does not depend on how the
    instants lie among the samples (midpoint rule: exact for a constant rate and force).
    """
    axes = PERFECT if gyro_axes is None else gyro_axes
    at = instants_ns - offset_ns if offset_ns else instants_ns
    first = int(np.searchsorted(imu.stamps_ns, at[0], side="right"))
    stamps, gyro, accel = imu.stamps_ns, imu.gyro, imu.accel
    if mounting is not None:
        # Of what is integrated only: with a sample beyond either end.
        used = slice(max(first - 1, 0), int(np.searchsorted(stamps, at[-1], side="left")) + 1)
        stamps, gyro, first = stamps[used], gyro[used], first - used.start
        accel, accel_bias = accel[used] @ mounting.T, mounting @ accel_bias
    increments = strapdown.integrate(stamps, gyro, accel, first, at, gyro_bias, accel_bias, axes)
    return Increments(instants_ns, *increments, imu, offset_ns, _hidden_sigmas(imu, int(at[0]), int(at[-1])))


def _readings(imu: ImuStream, instants_ns: Longs) -> Floats:
    """(K, 3) rad/s of the gyroscope at instants (K,), linear between samples and constant beyond them."""
    after = np.clip(np.searchsorted(imu.stamps_ns, instants_ns), 1, max(len(imu) - 1, 1))
    before, after = after - 1, np.minimum(after, len(imu) - 1)
    step = np.maximum(imu.stamps_ns[after] - imu.stamps_ns[before], 1)
    share = np.clip((instants_ns - imu.stamps_ns[before]) / step, 0.0, 1.0)[:, None]
    return np.asarray(imu.gyro[before] + share * (imu.gyro[after] - imu.gyro[before]))


def _hidden_sigmas(imu: ImuStream, begin_ns: int, end_ns: int) -> Floats | None:
    """(6,) the mean of what the samples between two instants lack; of one cut as a whole, so it does not average out."""
    if imu.clipping_sigma is None:
        return None
    i, j = np.searchsorted(imu.stamps_ns, [begin_ns, end_ns])
    within = imu.clipping_sigma[max(i - 1, 0) : j + 1]
    return np.asarray(within.mean(axis=0)) if within.any() else None
