"""Initialisation of the IMU: velocity, gravity and biases at the first scan, from the registration of the first seconds."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.config.odometry import ImuConfig
from lslam.core.kernels.linearisation import OUTLIER_SIGMAS
from lslam.core.types.imu import GRAVITY, ImuStream
from lslam.core.types.scan import LEVER_M
from lslam.core.types.scan_result import FASTEST_M_S, STILL_M
from lslam.odometry.inertial.agreement import LEAST_OFFSET_S, check_agreement
from lslam.odometry.inertial.gyroscope import Gyroscope, ImuNoise
from lslam.odometry.inertial.imu_cleaning import IMU_GAP_S, ImuRefusedError, clean, covers, gaps
from lslam.odometry.inertial.imu_estimate import BIAS, DOWN, WORSE_RATIO, ImuEstimate
from lslam.odometry.kernels.rotation import apart

# Prior sigmas: any vehicle's speed; consumer devices' biases; a bias by the mean turn.
ANY_SPEED, ANY_ACCEL_BIAS, ANY_GYRO_BIAS, MEAN_GYRO_BIAS = FASTEST_M_S / OUTLIER_SIGMAS, 0.5, 0.1, 0.02
# Given biases: axes up to 2 % askew (a consumer device's data sheet) show as much of gravity as one more: two sigma.
# A bias that is given was measured over minutes.
GIVEN_ACCEL_BIAS, GIVEN_GYRO_BIAS, GIVEN_SPEED = 0.1, 2e-4, 0.3
# A given bias may differ from the mean rate error of the first seconds by so much, rad/s: misaligned axes add to that.
MOST_BIAS_ERROR_RAD_S = 0.03
# What gravity may be off beyond what a bias explains, m/s2.
LEVEL_SIGMA_M_S2 = 0.3
# The speed at the first scan is read off so many seconds: longer, and errors of the force add up.
SPEED_S = 0.8


@dataclass(frozen=True)
class FirstPoses:
    """The registration of the first seconds without an IMU.

    stamps_ns (N,), poses (N, 4, 4) : at the stamps of the scans
    instants_ns (M,), middles (M, 4, 4) : in the middle of sweeps, where rotations are most accurate
    covariances : (M, 6, 6) of the registrations, world axes; None when unknown
    """

    stamps_ns: Longs
    poses: Floats
    instants_ns: Longs
    middles: Floats
    covariances: Floats | None = None

    def during(self, begin: int, end: int) -> FirstPoses:
        """The scans from number `begin` to before `end`, and the middles of sweeps between them."""
        stamps = self.stamps_ns[begin:end]
        is_in = self.instants_ns >= stamps[0]
        if end < len(self.stamps_ns):
            is_in &= self.instants_ns <= stamps[-1]
        covariances = None if self.covariances is None else self.covariances[is_in]
        return FirstPoses(stamps, self.poses[begin:end], self.instants_ns[is_in], self.middles[is_in], covariances)


@dataclass(frozen=True)
class InertialStart:
    """A usable IMU: its stream on the clock of the scans, the estimate at the first of them, and what was decided.

    problems : what was given and could not be used
    offset_s : what was added to its stamps; has_turn_check : whether its turns could be compared with those of the scans
    """

    imu: ImuStream
    T_lidar_imu: Floats
    estimate: ImuEstimate
    offset_s: float = 0.0
    has_turn_check: bool = False
    is_static: bool = False
    notes: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


def start(
    imu: ImuStream,
    T_lidar_imu: Floats,
    first: FirstPoses,
    last_ns: int,
    config: ImuConfig,
    least_offset_s: float = LEAST_OFFSET_S,
) -> InertialStart:
    """Check the stream against the registered first poses, and initialise velocity, gravity and biases by them.

    last_ns : stamp of the recording's last scan; least_offset_s : smaller clock offsets are taken as zero

    Raises ImuRefusedError with the reason when the stream cannot be of this sensor's motion.
    """
    offset_s = config.time_offset_s
    shift = 0 if offset_s is None else round(1e9 * offset_s)
    cleaned = clean(replace(imu, stamps_ns=imu.stamps_ns + shift), int(first.stamps_ns[0]), last_ns)
    notes = list(cleaned.notes)
    part = covered_stretches(first, cleaned.imu)[0]
    agreement = check_agreement(
        cleaned.imu, T_lidar_imu, part.instants_ns, part.middles, None if offset_s is None else 0.0, least_offset_s
    )
    offset = agreement.offset_s if offset_s is None else offset_s
    if not agreement.is_judged:
        notes.append("IMU: the first scans show too few turns to check its axes and its clock")
    problems: list[str] = []
    config = _without_wrong_bias(config, agreement.gyro_bias, problems)
    moved = round(1e9 * agreement.offset_s)
    usable = replace(cleaned.imu, stamps_ns=cleaned.imu.stamps_ns + moved)
    part, opening = covered_stretches(first, usable)
    _refuse_sign(usable, T_lidar_imu, part, agreement.gyro_bias)
    guess = _first_guess(usable, T_lidar_imu, part, config, agreement.gyro_bias)
    options = config.estimate_extrinsics, config.estimate_offset
    guess = replace(guess, gyroscope=guess.gyroscope.with_calibration(*options))
    estimate = _learn(usable, T_lidar_imu, guess, part, opening, config)
    if any(options):
        # Once more, with forces about the axes that the turns showed and at their time: what was learnt is no prior.
        device = replace(estimate.gyroscope, covariance=guess.gyroscope.covariance)
        estimate = _learn(usable, T_lidar_imu, replace(guess, gyroscope=device), part, opening, config)
    if config.gyro_bias is not None:
        bias = np.array(config.gyro_bias)
        device = Gyroscope.of_bias(bias, _bias_sigma(bias, estimate.gyroscope), ImuNoise.of(config)).with_calibration(
            *options
        )
        estimate = _learn(usable, T_lidar_imu, replace(guess, gyroscope=device), part, opening, config)
    is_static = _is_static(part)
    notes.append("IMU aligned " + ("while standing" if is_static else "while moving"))
    return InertialStart(usable, T_lidar_imu, estimate, offset, agreement.is_judged, is_static, notes, problems)


def covered_stretches(first: FirstPoses, imu: ImuStream) -> tuple[FirstPoses, FirstPoses]:
    """The longest stretch of the first scans that the stream covers, and the covered stretch from the very first scan on.

    Raises ImuRefusedError when it covers no two successive scans.
    """
    silent = gaps(imu, IMU_GAP_S)
    ends = [k + 1 for k, (a, b) in enumerate(pairwise(first.stamps_ns)) if not covers(silent, int(a), int(b))]
    stretches = list(pairwise([0, *ends, len(first.stamps_ns)]))
    longest = max(stretches, key=lambda stretch: stretch[1] - stretch[0])
    if longest == (0, 1) and ends:
        seconds = 1e-9 * float(first.stamps_ns[-1] - first.stamps_ns[0])
        raise ImuRefusedError(
            f"it is silent between all {len(first.stamps_ns)} scans of the first {seconds:.1f} s, which registration found "
            "without it",
            "begin where it speaks, with --start",
        )
    return first.during(*longest), first.during(*stretches[0])


def _refuse_sign(imu: ImuStream, T_lidar_imu: Floats, part: FirstPoses, gyro_bias: Floats | None) -> None:
    """Raise ImuRefusedError where inverted forces fit the scans' path far better: at rest +g must be up (REP 145).

    A stationary sensor is not tested: its path is only registration noise.
    """
    if _farthest(part.poses) < STILL_M:
        return
    bias, none = np.zeros(3) if gyro_bias is None else gyro_bias, np.zeros(3)
    guess = ImuEstimate(none, none, none, Gyroscope.of_bias(bias, MEAN_GYRO_BIAS), np.eye(9))
    as_given, reversed_ = (
        _fit_velocity_and_gravity(
            replace(imu, accel=sign * imu.accel), part.poses @ T_lidar_imu, part.stamps_ns, guess
        )[2]
        for sign in (1.0, -1.0)
    )
    # Forces of the right sign miss the path farther nowhere where anything accelerates.
    if as_given > WORSE_RATIO * reversed_:
        raise ImuRefusedError(
            "its specific forces fit the path of the scans when they point the other way",
            "at rest they must be +g up, change the sign of its accelerometer",
        )


def _without_wrong_bias(config: ImuConfig, scan_bias: Floats | None, problems: list[str]) -> ImuConfig:
    """The configuration without its gyroscope and accelerometer bias, if the former contradicts `scan_bias` (3,), rad/s.

    The scans' bias is None if unknown. A dropped bias, for example a preset's of another device, adds one of the `problems`.
    """
    if config.gyro_bias is None or scan_bias is None:
        return config
    off = float(np.abs(np.array(config.gyro_bias) - scan_bias).max())
    if off < MOST_BIAS_ERROR_RAD_S:
        return config
    problems.append(
        f"imu.gyro_bias {config.gyro_bias} and imu.accel_bias are not used, they are estimated: the scans show a rate bias "
        f"that differs by {off:.3f} rad/s"
    )
    return config.model_copy(update={"gyro_bias": None, "accel_bias": None})


def _bias_sigma(bias: Floats, device: Gyroscope) -> float:
    """Sigma of a given bias (3,), rad/s: its difference from that of the `device`, estimated with a weak prior."""
    beyond = np.abs(bias - device.bias) - OUTLIER_SIGMAS * np.sqrt(np.diag(device.covariance)[:3])
    return max(float(beyond.max()), GIVEN_GYRO_BIAS)


def _first_guess(
    imu: ImuStream,
    T_lidar_imu: Floats,
    part: FirstPoses,
    config: ImuConfig,
    mean_bias: Floats | None,
) -> ImuEstimate:
    """Initial estimate with its covariance: the gyroscope bias configured, else `mean_bias`; gravity from forces and path."""
    gyro_bias, gyro_sigma = (np.zeros(3), ANY_GYRO_BIAS) if mean_bias is None else (mean_bias, MEAN_GYRO_BIAS)
    accel_bias, accel_sigma = np.zeros(3), ANY_ACCEL_BIAS
    if config.gyro_bias is not None:
        gyro_bias, gyro_sigma = np.array(config.gyro_bias), MOST_BIAS_ERROR_RAD_S
    if config.accel_bias is not None:
        accel_bias, accel_sigma = np.array(config.accel_bias), GIVEN_ACCEL_BIAS
    # At first only the difference of force and gravity is observable: a bias tilts the vertical.
    R, shared = T_lidar_imu[:3, :3], accel_sigma**2
    covariance = np.zeros((9, 9))
    np.fill_diagonal(covariance, np.repeat([ANY_SPEED**2, LEVEL_SIGMA_M_S2**2 + shared, shared], 3))
    covariance[DOWN, BIAS], covariance[BIAS, DOWN] = shared * R, shared * R.T
    gyroscope = Gyroscope.of_bias(gyro_bias, gyro_sigma, ImuNoise.of(config))
    guess = ImuEstimate(np.zeros(3), np.zeros(3), accel_bias, gyroscope, covariance)
    gravity = _fit_velocity_and_gravity(imu, part.poses @ T_lidar_imu, part.stamps_ns, guess)[1]
    return replace(guess, gravity=GRAVITY * gravity / max(float(np.linalg.norm(gravity)), 1e-9))


def _is_static(part: FirstPoses) -> bool:
    """Whether no point at `LEVER_M` moves in the first second, by the poses of its scans; False of fewer than three."""
    early = part.poses[part.stamps_ns < part.stamps_ns[0] + 1_000_000_000]
    return len(early) > 2 and max(apart(part.poses[0], pose, LEVER_M) for pose in early) < STILL_M


def _farthest(poses: Floats) -> float:
    """m that any of the poses (N, 4, 4) is from the first."""
    return float(np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1).max())


def _learn(
    imu: ImuStream, T_lidar_imu: Floats, guess: ImuEstimate, part: FirstPoses, opening: FirstPoses, config: ImuConfig
) -> ImuEstimate:
    """The guess updated by all sweeps of `part`, with the velocity at the first pose of `opening`."""
    T = part.middles @ T_lidar_imu
    learnt = guess
    for k in range(len(T) - 1):
        step, R, R_end = learnt.over(imu, part.instants_ns[k : k + 2]), T[k, :3, :3], T[k + 1, :3, :3]
        noise = None if part.covariances is None else part.covariances[k + 1, 3:, 3:]
        gyroscope = learnt.calibrate(step, R, R_end, noise)
        learnt = learnt.correct(imu, step, R, R_end, T[k + 1, :3, 3] - T[k, :3, 3], gyroscope)
    covariance = learnt.covariance.copy()
    covariance[:3, :] = covariance[:, :3] = 0.0
    velocity, _, spread = _fit_velocity_and_gravity(
        imu, opening.poses @ T_lidar_imu, opening.stamps_ns, learnt, SPEED_S
    )
    sigma = max(spread, 0.1)
    if config.initial_velocity is not None:
        i = min(int(np.searchsorted(imu.stamps_ns, opening.stamps_ns[0])), len(imu) - 1)
        rate = T_lidar_imu[:3, :3] @ learnt.gyroscope.rates(imu.gyro[i])
        velocity, sigma = np.array(config.initial_velocity) + np.cross(rate, T_lidar_imu[:3, 3]), GIVEN_SPEED
    covariance[:3, :3] = sigma**2 * np.eye(3)
    return replace(learnt, velocity=velocity, covariance=covariance)


def _fit_velocity_and_gravity(
    imu: ImuStream, T_world_imu: Floats, stamps_ns: Longs, prior: ImuEstimate, seconds: float = np.inf
) -> tuple[Floats, Floats, float]:
    """Velocity (3,), m/s, at the first pose and gravity (3,), m/s2, in the world, and the velocity's sigma, m/s.

    They fit the poses T_world_imu (N, 4, 4) of the first `seconds` best. If `prior` has a gravity, that is kept. Fewer than four
    poses give zero velocity with the sigma `ANY_SPEED`.
    """
    count = max(int(np.searchsorted(stamps_ns - stamps_ns[0], 1e9 * seconds)), min(4, len(stamps_ns)))
    has_gravity = bool(prior.gravity.any())
    if count < 4:
        step = prior.over(imu, stamps_ns[0] + np.array([0, 500_000_000]))
        return np.zeros(3), prior.gravity if has_gravity else -T_world_imu[0, :3, :3] @ step.velocities[-1], ANY_SPEED
    step = prior.over(imu, stamps_ns[:count])
    _, _, moved = step.motion(0, T_world_imu[0, :3, :3], np.zeros(3), prior.gravity)
    rest = T_world_imu[:count, :3, 3] - T_world_imu[0, :3, 3] - moved
    t = step.seconds[:, None]
    A = t if has_gravity else np.hstack([t, 0.5 * t**2])
    x = np.linalg.lstsq(A, rest, rcond=None)[0]
    spread = float(np.sqrt(np.mean(np.sum((rest - A @ x) ** 2, axis=1)) / float(np.sum(t**2))))
    return x[0], prior.gravity if has_gravity else x[1], spread
