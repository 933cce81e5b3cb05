"""Velocity, gravity and biases at the first scan, from what registration says about the first seconds."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lslam.config.imu import ImuConfig
from lslam.geometry import so3
from lslam.inertial.agreement import check_agreement
from lslam.inertial.estimate import BIAS, GRAVITY, ImuEstimate
from lslam.inertial.integrate import integrate
from lslam.inertial.stream import clean
from lslam.types.imu import ImuStream

Floats = NDArray[np.float64]

# One sigma before anything is known: any vehicle's speed; consumer devices' biases; gravity from forces while moving.
ANY_SPEED, ANY_ACCEL_BIAS, ANY_GYRO_BIAS, MOVING_GRAVITY = 50.0, 0.5, 0.1, 1.5
GIVEN_ACCEL_BIAS, GIVEN_GYRO_BIAS, GIVEN_SPEED = 0.05, 2e-3, 0.3
# A standing sensor: spread of rates (rad/s) and forces (m/s2) over a second, and how far registration moves it (m).
STILL_RATE, STILL_FORCE, STILL_MOVE = 0.02, 0.3, 0.05
STILL_GRAVITY = 0.1
# The speed at the first scan is read off so many seconds: longer, and errors of the force add up.
SPEED_S = 0.8


@dataclass(frozen=True)
class Start:
    """A usable IMU: its stream on the clock of the scans, the estimate at the first of them, and what was decided.

    offset_s : what was added to its stamps; is_checked : whether its turns could be compared with those of the scans
    """

    imu: ImuStream
    T_lidar_imu: Floats
    estimate: ImuEstimate
    offset_s: float
    is_checked: bool
    is_static: bool
    notes: list[str]


def start(
    imu: ImuStream,
    T_lidar_imu: Floats,
    stamps_ns: NDArray[np.int64],
    poses: Floats,
    last_ns: int,
    config: ImuConfig,
) -> Start:
    """Check the stream against the first poses (N, 4, 4) that registration found by itself, and align it with them.

    stamps_ns (N,) : of the poses, the first scan's first; last_ns : stamp of the recording's last scan

    Raises ImuRefusedError with the reason when the stream cannot be of this sensor's motion.
    """
    given = config.time_offset_s
    shift = 0 if given is None else round(1e9 * given)
    cleaned = clean(replace(imu, stamps_ns=imu.stamps_ns + shift), int(stamps_ns[0]), last_ns)
    notes = list(cleaned.notes)
    agreement = check_agreement(cleaned.imu, T_lidar_imu, stamps_ns, poses, None if given is None else 0.0)
    offset = agreement.offset_s if given is None else given
    if agreement.offset_s:
        notes.append(
            f"IMU stamps moved by {1e3 * agreement.offset_s:+.1f} ms (sigma {1e3 * agreement.offset_sigma_s:.1f}): its turns "
            "then fit those of the scans best"
        )
    if not agreement.is_judged:
        notes.append(
            "IMU: the sensor hardly turns at the start, so axes and clock of the IMU could not be checked there"
        )
    moved = round(1e9 * agreement.offset_s)
    usable = replace(cleaned.imu, stamps_ns=cleaned.imu.stamps_ns + moved)
    first, is_static = _first_guess(usable, T_lidar_imu, stamps_ns, poses, config)
    estimate = _learnt(usable, T_lidar_imu, first, stamps_ns, poses, config)
    notes.append("IMU aligned " + ("while standing" if is_static else "while moving"))
    return Start(usable, T_lidar_imu, estimate, offset, agreement.is_judged, is_static, notes)


def _first_guess(
    imu: ImuStream, T_lidar_imu: Floats, stamps_ns: NDArray[np.int64], poses: Floats, config: ImuConfig
) -> tuple[ImuEstimate, bool]:
    """Gravity from the mean force of the first second, the rate's bias too when the sensor stands."""
    i, j = np.searchsorted(imu.stamps_ns, [stamps_ns[0], stamps_ns[0] + 1_000_000_000])
    j = min(max(int(j), int(i) + 1), len(imu))
    i = min(int(i), j - 1)
    force, rates = imu.accel[i:j], imu.gyro[i:j]
    within = stamps_ns < stamps_ns[0] + 1_000_000_000
    stands = (
        float(np.std(rates, axis=0).max()) < STILL_RATE
        and float(np.std(force, axis=0).max()) < STILL_FORCE
        and within.sum() > 2
        and float(np.linalg.norm(poses[within, :3, 3] - poses[0, :3, 3], axis=1).max()) < STILL_MOVE
    )
    gyro_bias, gyro_sigma = (rates.mean(axis=0), GIVEN_GYRO_BIAS) if stands else (np.zeros(3), ANY_GYRO_BIAS)
    accel_bias, accel_sigma = np.zeros(3), ANY_ACCEL_BIAS
    if config.gyro_bias is not None:
        gyro_bias, gyro_sigma = np.array(config.gyro_bias), GIVEN_GYRO_BIAS
    if config.accel_bias is not None:
        accel_bias, accel_sigma = np.array(config.accel_bias), GIVEN_ACCEL_BIAS
    mean = (force - accel_bias).mean(axis=0)
    gravity = -GRAVITY * (T_lidar_imu[:3, :3] @ mean) / max(float(np.linalg.norm(mean)), 1e-9)
    # Standing, force and gravity only say their difference: a bias tilts what is taken for vertical.
    covariance = np.zeros((9, 9))
    sigmas = np.repeat([ANY_SPEED, MOVING_GRAVITY, accel_sigma], 3)
    np.fill_diagonal(covariance, sigmas**2)
    if stands:
        R = T_lidar_imu[:3, :3]
        covariance[3:6, 3:6] = (STILL_GRAVITY**2 + accel_sigma**2) * np.eye(3)
        covariance[3:6, BIAS] = accel_sigma**2 * R
        covariance[BIAS, 3:6] = accel_sigma**2 * R.T
    guess = ImuEstimate(np.zeros(3), gravity, accel_bias, gyro_bias, covariance, gyro_sigma**2 * np.eye(3))
    return guess, stands


def _learnt(
    imu: ImuStream,
    T_lidar_imu: Floats,
    guess: ImuEstimate,
    stamps_ns: NDArray[np.int64],
    poses: Floats,
    config: ImuConfig,
) -> ImuEstimate:
    """The guess after all the poses, brought back to the first of them."""
    T = poses @ T_lidar_imu
    learnt = guess
    for k in range(len(T) - 1):
        moved = T[k + 1, :3, 3] - T[k, :3, 3]
        learnt = learnt.corrected(imu, stamps_ns[k : k + 2], T[k, :3, :3], T[k + 1, :3, :3], moved)
    covariance = learnt.covariance.copy()
    covariance[:3, :] = covariance[:, :3] = 0.0
    velocity, sigma = _first_velocity(imu, T, stamps_ns, learnt)
    if config.initial_velocity is not None:
        lever = T_lidar_imu[:3, 3]
        i = min(int(np.searchsorted(imu.stamps_ns, stamps_ns[0])), len(imu) - 1)
        rate = T_lidar_imu[:3, :3] @ (imu.gyro[i] - learnt.gyro_bias)
        velocity, sigma = np.array(config.initial_velocity) + np.cross(rate, lever), GIVEN_SPEED
    covariance[:3, :3] = sigma**2 * np.eye(3)
    return replace(learnt, velocity=velocity, covariance=covariance)


def _first_velocity(
    imu: ImuStream, T_world_imu: Floats, stamps_ns: NDArray[np.int64], learnt: ImuEstimate
) -> tuple[Floats, float]:
    """Velocity of the IMU at the first pose, m/s, from the displacements that forces do not explain, and its sigma."""
    count = max(int(np.searchsorted(stamps_ns, stamps_ns[0] + round(1e9 * SPEED_S))), min(3, len(stamps_ns)))
    if count < 2:
        return np.zeros(3), ANY_SPEED
    step = integrate(imu, stamps_ns[:count], learnt.gyro_bias, learnt.accel_bias)
    _, _, moved = step.motion(0, T_world_imu[0, :3, :3], np.zeros(3), learnt.gravity)
    rest = T_world_imu[:count, :3, 3] - T_world_imu[0, :3, 3] - moved
    t = step.seconds
    velocity = np.asarray((t @ rest) / (t @ t))
    spread = float(np.sqrt(np.mean(np.sum((rest - t[:, None] * velocity) ** 2, axis=1)) / (t @ t)))
    return velocity, max(spread, 0.1)


def vertical(estimate: ImuEstimate) -> Floats:
    """(3, 3) smallest rotation that turns the world so that gravity points along -z."""
    down = estimate.gravity / np.linalg.norm(estimate.gravity)
    axis = np.cross(down, [0.0, 0.0, -1.0])
    sine, cosine = float(np.linalg.norm(axis)), -float(down[2])
    if sine < 1e-9:
        return np.eye(3) if cosine > 0 else np.diag([1.0, -1.0, -1.0])
    return so3.exp(axis * (np.arctan2(sine, cosine) / sine))
