"""An IMU on a moving body: exact specific force and angular rate, and the readings of a MEMS device."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from pydantic import Field

from lslam.core.arrays import Floats, Longs
from lslam.core.config.input import Section
from lslam.core.errors import UsageError, nearest
from lslam.core.geometry import portable, se3, so3
from lslam.core.types.imu import ImuStream
from lslam.simulation.kinematics import Kinematics, Motion

GRAVITY = 9.80665  # m/s2, downwards along the city's -z

# Inside an Ouster OS1 (its manual: 6.253, -11.775, 7.645 mm), and on KITTI's car, in the LiDAR frame.
T_OUSTER_IMU = se3.make(np.eye(3), np.array([0.006253, -0.011775, 0.007645]))
T_CAR_IMU = se3.make(so3.from_euler_rpy(np.radians([0.85, 0.12, 0.04])), np.array([-0.81, 0.32, -0.80]))


@dataclass(frozen=True)
class Triad:
    """Three axes of one kind: an accelerometer (units m/s2) or a gyroscope (rad/s).

    limit : largest reading either way; step : of one bit, 0 for none; bias : constant, on each axis
    misalignment : share of every other axis that an axis feels, per cent
    noise_density : white noise, unit/sqrt(Hz): N of the Allan deviation N / sqrt(tau)
    bias_walk : random walk of the bias, unit/sqrt(s): K of the Allan deviation K sqrt(tau / 3)
    """

    limit: float = np.inf
    step: float = 0.0
    bias: float = 0.0
    misalignment: float = 0.0
    noise_density: float = 0.0
    bias_walk: float = 0.0


@dataclass(frozen=True)
class ImuModel:
    """A kind of IMU; the default has no errors.

    jitter : standard deviation of stamps about the times of reading, s; within 0.45 of a period
    late : standard deviation of the times of reading about their nominal stamps, s; of any size
    """

    name: str
    accel: Triad = field(default_factory=Triad)
    gyro: Triad = field(default_factory=Triad)
    rate_hz: float = 100.0
    jitter: float = 0.0
    late: float = 0.0


class ImuFaults(Section):
    """Faults added to the IMU of a scenario.

    jitter_ms : standard deviation of its stamps; accel_limit, gyro_limit_deg : range beyond which it saturates, m/s2 and deg/s;
        None: that of the model
    """

    jitter_ms: float = Field(0.0, ge=0, le=100)
    accel_limit: float | None = Field(None, gt=0)
    gyro_limit_deg: float | None = Field(None, gt=0)

    def of(self, model: ImuModel) -> ImuModel:
        """`model` with these faults; limits are never wider than its own."""
        accel, gyro = model.accel, model.gyro
        if self.accel_limit is not None:
            accel = replace(accel, limit=min(accel.limit, self.accel_limit))
        if self.gyro_limit_deg is not None:
            gyro = replace(gyro, limit=min(gyro.limit, float(np.radians(self.gyro_limit_deg))))
        return replace(model, accel=accel, gyro=gyro, jitter=max(model.jitter, self.jitter_ms * 1e-3))


@dataclass(frozen=True)
class SimulatedImu:
    """Readings of an IMU, and the truth behind them.

    stream : the readings; accel_bias, gyro_bias : (M, 3) constant and walking bias at each reading, m/s2 and rad/s
    truth : (M,) motion of the IMU in the city frame; T_lidar_imu : where it sits
    """

    stream: ImuStream
    accel_bias: Floats
    gyro_bias: Floats
    truth: Kinematics
    T_lidar_imu: Floats


# Girolimetto, table 2.3 (from the data sheet). Neither states a bias random walk: it is that of Kalibr's example of a MEMS IMU.
_ICM_ACCEL = Triad(19.62, 0.000598754, 0.4905, 2.0, 0.0022563, 2e-4)
_ICM_GYRO = Triad(4.36332313, 0.000133231, 0.087266462, 2.0, 0.000261799, 4e-6)


def _times_ten(triad: Triad, limit: float) -> Triad:
    """`triad` with ten times its biases, constant and walking, and 16-bit steps over another range."""
    return replace(triad, limit=limit, step=limit / 2**15, bias=10 * triad.bias, bias_walk=10 * triad.bias_walk)


# A phone's: 8 g, 500 deg/s and ten times the biases. An application reads when the system lets it and notes when it should
# have: the stamps are the nominal ones. 5 ms is half a period: stamps that were as wrong would overtake each other, and what
# a reader of the recording drops for that would no longer count.
_PHONE_ACCEL, _PHONE_GYRO = _times_ten(_ICM_ACCEL, 8 * GRAVITY), _times_ten(_ICM_GYRO, float(np.radians(500)))
_PHONE = ImuModel("phone", _PHONE_ACCEL, _PHONE_GYRO, late=5e-3)

IMUS = {
    model.name: model
    for model in (
        ImuModel("icm20948", _ICM_ACCEL, _ICM_GYRO),
        # The same after a calibration that took out the constant bias and the misalignment.
        ImuModel(
            "icm20948-calibrated",
            Triad(19.62, 0.000598754, 0.0, 0.0, 0.0022563, 2e-4),
            Triad(4.36332313, 0.000133231, 0.0, 0.0, 0.000261799, 4e-6),
        ),
        _PHONE,
        # As the system of a phone hands it out, which takes out what it saw while the phone lay.
        replace(
            _PHONE,
            name="phone-calibrated",
            accel=replace(_PHONE_ACCEL, bias=0.0, misalignment=0.0),
            gyro=replace(_PHONE_GYRO, bias=0.0, misalignment=0.0),
        ),
        ImuModel("ideal"),
    )
}


def find_imu(name: str) -> ImuModel:
    """Model called `name`. Raises UsageError with the nearest name."""
    if name not in IMUS:
        raise UsageError(f"no IMU {name!r}; {nearest(name, IMUS)}")
    return IMUS[name]


def reading_stamps(rate_hz: float, end: float) -> Longs:
    """(M,) ns, nominal stamps of a sensor's readings from 0 to `end` s."""
    count = int(np.floor(end * rate_hz + 1e-6)) + 1
    return np.round(np.arange(count) * (1e9 / rate_hz)).astype(np.int64)


def simulate_imu(
    motion: Motion, model: ImuModel, T_lidar_imu: Floats, end: float, rng: np.random.Generator
) -> SimulatedImu:
    """Readings of `model` at `T_lidar_imu` (4, 4), from 0 to `end` s of `motion`.

    The same generator state gives the same readings; a longer `end` only adds to them.
    """
    stamps = reading_stamps(model.rate_hz, end)
    count = len(stamps)
    truth = felt = motion.at(stamps / 1e9).at_sensor(T_lidar_imu)
    if model.late > 0:
        taken = stamps / 1e9 + model.late * rng.spawn(1)[0].standard_normal(count)
        felt = motion.at(np.clip(taken, 0.0, motion.duration)).at_sensor(T_lidar_imu)
    noise = rng.standard_normal((count, 4, 3))
    accel, accel_bias = measure(model.accel, specific_force(felt), noise[:, :2], model.rate_hz)
    gyro, gyro_bias = measure(model.gyro, felt.rate, noise[:, 2:], model.rate_hz)
    if model.jitter > 0:
        # Drawn last, so that readings are those of an IMU without it; the first stamp stays, where the recording begins.
        late = np.clip(rng.standard_normal(count) * model.jitter, -0.45 / model.rate_hz, 0.45 / model.rate_hz)
        stamps = stamps + np.round(1e9 * np.append(0.0, late[1:])).astype(np.int64)
    return SimulatedImu(ImuStream(stamps, accel, gyro), accel_bias, gyro_bias, truth, np.asarray(T_lidar_imu))


def specific_force(truth: Kinematics) -> Floats:
    """(M, 3) specific force in the body frame, m/s2, as an exact accelerometer measures it: +g upwards at rest (REP 145)."""
    felt = truth.acceleration + np.array([0.0, 0.0, GRAVITY])
    return portable.rotate(np.swapaxes(truth.poses[:, :3, :3], -1, -2), felt)


def measure(triad: Triad, exact: Floats, noise: Floats, rate_hz: float) -> tuple[Floats, Floats]:
    """Readings (M, 3) and biases (M, 3) of a triad whose exact input is `exact` (M, 3).

    noise : (M, 2, 3) standard normal numbers, for the white noise and for the steps of the bias. A white noise of density N
    sampled at f has the deviation N sqrt(f), a random walk K steps of K / sqrt(f) (IEEE Std 952).
    """
    cross = np.full((3, 3), triad.misalignment / 100)
    np.fill_diagonal(cross, 1.0)
    walk = np.cumsum(noise[:, 1], axis=0) - noise[:1, 1]
    bias = triad.bias + triad.bias_walk / np.sqrt(rate_hz) * walk
    reading = portable.product(exact, cross.T) + bias + triad.noise_density * np.sqrt(rate_hz) * noise[:, 0]
    if triad.step > 0:
        reading = np.round(reading / triad.step) * triad.step
    return np.clip(reading, -triad.limit, triad.limit), np.asarray(bias)
