"""Sensors beside the LiDAR: an IMU, a satellite receiver and the wheels of a car, their mounting, and their readings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.errors import UsageError
from lslam.core.geometry import geodesy, portable, se3
from lslam.core.printable import toml_text
from lslam.core.types.gnss import GnssStream
from lslam.core.types.imu import WheelStream
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats.atomic import write_text
from lslam.io.formats.stamped_csv import write_gnss_csv, write_imu_csv, write_stamped_csv, write_wheels_csv
from lslam.io.formats.trajectory_lines import write_tum
from lslam.simulation.imu import GRAVITY, T_CAR_IMU, T_OUSTER_IMU, ImuModel, SimulatedImu, reading_stamps, simulate_imu
from lslam.simulation.kinematics import Motion

# lat, lon (deg), height (m) of the city's origin unless a scenario has its own: open ground at Karlsruhe.
ORIGIN = np.array([49.0, 8.4, 115.0])

# Of the antenna in the LiDAR frame: on the roof of a car behind the LiDAR's mast, on top of a drone that carries the LiDAR
# below its belly, on a rod above a hand-held LiDAR.
T_CAR_ANTENNA = se3.make(np.eye(3), np.array([-0.9, 0.0, -0.15]))
T_DRONE_ANTENNA = se3.make(np.eye(3), np.array([-0.1, 0.0, 0.35]))
T_WALKER_ANTENNA = se3.make(np.eye(3), np.array([-0.05, 0.0, 0.25]))
IMU_FILE, GNSS_FILE, WHEELS_FILE, TRUTH = "imu.csv", "gnss.csv", "wheels.csv", "truth"
TRUTH_HZ = 100
# Middle of the rear axle below the LiDAR on KITTI's car: it hardly moves sideways.
T_CAR_BASE = se3.make(np.eye(3), np.array([-0.76, 0.0, -1.73]))
BASE = "base_link"
# Of the generators; the scenarios count down from 2**32 - 1.
_IMU_SEED, _GNSS_SEED, _WHEELS_SEED = 2**32 - 11, 2**32 - 12, 2**32 - 14


@dataclass(frozen=True)
class GnssModel:
    """A receiver of code fixes under an open sky.

    rate_hz : fixes per second, 1 to 10
    white : independent error of each fix; slow : error that wanders with the time constant `memory`, s. Both are one sigma
    of east and of north, m; upwards they are `vertical` times as large
    outages : intervals (from, to), s, in which there is no fix
    """

    rate_hz: float = 1.0
    white: float = 0.3
    slow: float = 0.8
    memory: float = 120.0
    vertical: float = 1.8
    outages: tuple[tuple[float, float], ...] = ()

    @property
    def sigma(self) -> float:
        """Stated one-sigma error of a fix, east and north, m."""
        return float(portable.hypot(self.white, self.slow))


@dataclass(frozen=True)
class SimulatedGnss:
    """Fixes of a receiver, and the truth behind them.

    stream : the fixes; antenna : (M, 3) true positions in the city frame, m; error : (M, 3) east, north, up, m
    T_lidar_gnss : (4, 4) where the antenna sits
    """

    stream: GnssStream
    antenna: Floats
    error: Floats
    T_lidar_gnss: Floats


def simulate_gnss(
    motion: Motion,
    model: GnssModel,
    T_lidar_gnss: Floats,
    origin: Floats,
    end: float,
    rng: np.random.Generator,
) -> SimulatedGnss:
    """Fixes of an antenna at `T_lidar_gnss` (4, 4), from 0 to `end` s of `motion`.

    origin : (3,) lat, lon (deg), height (m) of the city's origin; the city's x, y, z are east, north, up on the transverse
        Mercator projection there (`geometry.geodesy`)

    The same generator state gives the same errors; outages only leave fixes out. Raises UsageError for a rate outside
    1..10 Hz, negative errors or an outage that ends before it starts.
    """
    check_gnss(model)
    stamps = reading_stamps(model.rate_hz, end)
    times = stamps / 1e9
    antenna = portable.product(motion.poses(times), T_lidar_gnss)[:, :3, 3]
    error = _errors(model, len(times), rng)
    seen = np.ones(len(times), bool)
    for begin, finish in model.outages:
        seen &= (times < begin) | (times > finish)
    fixes = geodesy.from_local(antenna[seen] + error[seen], origin)
    stream = GnssStream(stamps[seen], fixes, np.full(int(seen.sum()), model.sigma))
    return SimulatedGnss(stream, antenna[seen], error[seen], np.asarray(T_lidar_gnss, np.float64))


def check_gnss(model: GnssModel) -> None:
    """Raise UsageError when `model` is out of range."""
    if not 1 <= model.rate_hz <= 10:
        raise UsageError(f"--gnss-rate {model.rate_hz:g} is out of range: 1 to 10 fixes per second")
    if not (min(model.white, model.slow, model.vertical) >= 0 and model.memory > 0):
        raise UsageError("errors of GNSS fixes are at least 0 m, and the time they wander with is above 0 s")
    for begin, finish in model.outages:
        if not finish > begin:
            raise UsageError(f"a GNSS outage from {begin:g} to {finish:g} s is none: it ends after it starts")


def _errors(model: GnssModel, count: int, rng: np.random.Generator) -> Floats:
    """(count, 3) errors east, north, up, m: white, and a first-order Gauss-Markov process in its steady state."""
    from scipy.signal import lfilter

    draws = rng.standard_normal((count, 2, 3))
    keep = float(portable.exp(-1 / (model.rate_hz * model.memory)))
    driven = draws[:, 1] * np.sqrt(1 - keep**2)
    driven[:1] = draws[:1, 1]
    slow = np.asarray(lfilter([1.0], [1.0, -keep], driven, axis=0))
    return np.asarray((model.white * draws[:, 0] + model.slow * slow) * [1.0, 1.0, model.vertical])


@dataclass(frozen=True)
class WheelModel:
    """Errors of speed and yaw rate as a car's bus has them.

    scale : largest error of the scale, drawn evenly; yaw_scale : likewise of the yaw rate; yaw_offset : one sigma, rad/s
    noise, yaw_noise : one sigma of a reading, m/s and rad/s; step : of a speed, m/s, as pulses are counted
    latency_s : by which a reading is stamped too late
    slip : largest share of the speed by which wheels spin or lock, slip_s : the longest it lasts, every : mean s between
    """

    rate_hz: float = 50.0
    scale: float = 0.02
    yaw_scale: float = 0.02
    yaw_offset: float = 0.003
    noise: float = 0.02
    yaw_noise: float = 0.003
    step: float = 0.01
    latency_s: float = 0.03
    slip: float = 0.2
    slip_s: float = 0.8
    every: float = 20.0


@dataclass(frozen=True)
class SimulatedWheels:
    """Readings, and the truth behind them: scale, yaw_scale and yaw_offset as drawn; slip : (M,) share of each reading."""

    stream: WheelStream
    scale: float
    yaw_scale: float
    yaw_offset: float
    slip: Floats


def simulate_wheels(
    motion: Motion, model: WheelModel, T_lidar_base: Floats, end: float, rng: np.random.Generator
) -> SimulatedWheels:
    """Readings of wheels at `T_lidar_base` (4, 4), from 0 to `end` s of `motion`; reproducible by the generator's state."""
    stamps = reading_stamps(model.rate_hz, end)
    scale, yaw_scale = rng.uniform(-1, 1, 2) * [model.scale, model.yaw_scale]
    yaw_offset = model.yaw_offset * rng.standard_normal()
    slip = _slip(model, stamps / 1e9, end, rng)
    noise = rng.standard_normal((len(stamps), 2))
    taken = np.clip(stamps / 1e9 - model.latency_s, 0.0, motion.duration)
    exact = motion.at(taken).at_sensor(T_lidar_base)
    forward = portable.dot(exact.velocity, exact.poses[:, :3, 0])
    speed = (1 + scale) * (1 + slip) * forward + model.noise * noise[:, 0] * (np.abs(forward) > model.step)
    if model.step > 0:
        speed = np.round(speed / model.step) * model.step
    yaw_rate = (1 + yaw_scale) * exact.rate[:, 2] + yaw_offset + model.yaw_noise * noise[:, 1]
    stream = WheelStream(stamps, speed, yaw_rate, T_lidar_base)
    return SimulatedWheels(stream, float(scale), float(yaw_scale), float(yaw_offset), slip)


def _slip(model: WheelModel, times: Floats, end: float, rng: np.random.Generator) -> Floats:
    """(M,) relative excess of the wheels' speed at `times` (M,), s: half sines at random intervals until `end`, s."""
    slip = np.zeros(len(times))
    begin = float(rng.exponential(model.every))
    while begin < end:
        lasts, size = rng.uniform(0.3, 1.0) * model.slip_s, rng.uniform(-1, 1) * model.slip
        phase = (times - begin) / lasts
        slip += np.where((phase > 0) & (phase < 1), size * portable.sin(np.pi * np.clip(phase, 0, 1)), 0.0)
        begin += lasts + float(rng.exponential(model.every))
    return slip


@dataclass(frozen=True)
class Mounts:
    """Mounting of sensors on a carrier, (4, 4) in the LiDAR frame; T_lidar_base : of its wheels, None where it has none."""

    T_lidar_imu: Floats
    T_lidar_antenna: Floats
    T_lidar_base: Floats | None = None


# In a car's boot and on its roof; what flies or is carried is light and small: the IMU shares the LiDAR's board.
MOUNTS = {
    "car": Mounts(T_CAR_IMU, T_CAR_ANTENNA, T_CAR_BASE),
    "drone": Mounts(T_OUSTER_IMU, T_DRONE_ANTENNA),
    "walker": Mounts(T_OUSTER_IMU, T_WALKER_ANTENNA),
}


@dataclass(frozen=True)
class Sensors:
    """Sensors of a drive; None for one that is absent. Raises UsageError for an impossible one."""

    imu: ImuModel | None = None
    gnss: GnssModel | None = None
    wheels: WheelModel | None = None

    def __post_init__(self) -> None:
        if self.gnss is not None:
            check_gnss(self.gnss)


@dataclass(frozen=True)
class Readings:
    """Readings of the sensors with the truth behind them; origin : (3,) lat, lon (deg), height (m) of the city's origin."""

    imu: SimulatedImu | None
    gnss: SimulatedGnss | None
    origin: Floats
    wheels: SimulatedWheels | None = None


def read_sensors(
    motion: Motion, sensors: Sensors, carrier: str, end: float, seeds: tuple[int, ...], origin: Floats = ORIGIN
) -> Readings:
    """Simulate the readings of `sensors` from 0 to `end` s of `motion`, each by its own generator.

    carrier : a key of `MOUNTS`, their mounting; drones and walkers have no wheels
    """
    mounts, imu, gnss, wheels = MOUNTS[carrier], None, None, None
    if sensors.imu is not None:
        generator = np.random.default_rng([*seeds, _IMU_SEED])
        imu = simulate_imu(motion, sensors.imu, mounts.T_lidar_imu, end, generator)
    if sensors.gnss is not None:
        generator = np.random.default_rng([*seeds, _GNSS_SEED])
        gnss = simulate_gnss(motion, sensors.gnss, mounts.T_lidar_antenna, origin, end, generator)
    if sensors.wheels is not None and mounts.T_lidar_base is not None:
        generator = np.random.default_rng([*seeds, _WHEELS_SEED])
        wheels = simulate_wheels(motion, sensors.wheels, mounts.T_lidar_base, end, generator)
    return Readings(imu, gnss, np.asarray(origin, np.float64), wheels)


def write_readings(folder: Path, readings: Readings) -> None:
    """Write `imu.csv`, `gnss.csv` and `wheels.csv` of the sensors of the drive."""
    if readings.imu is not None:
        write_imu_csv(folder / IMU_FILE, readings.imu.stream)
    if readings.gnss is not None:
        write_gnss_csv(folder / GNSS_FILE, readings.gnss.stream)
    if readings.wheels is not None:
        write_wheels_csv(folder / WHEELS_FILE, readings.wheels.stream)


def write_truth(folder: Path, motion: Motion, scan_stamps_ns: Longs, end: float, readings: Readings) -> None:
    """Write the exact truth into `folder`; readers of the sequence do not need it.

    The world is the LiDAR at the first scan. `trajectory.tum` has the LiDAR's poses at the scans' starts,
    `trajectory_100hz.tum` at 100 Hz from 0 to `end` s; `motion.csv` its velocity in the world (m/s) and its rate in its own
    frame (rad/s) at 100 Hz; `imu_bias.csv` the biases of `imu.csv`; `world.toml` the georeference and gravity.
    """
    folder.mkdir(parents=True, exist_ok=True)
    T_city_world = motion.poses(scan_stamps_ns[:1] / 1e9)[0]
    note = "exact poses T_world_lidar, world = LiDAR at the first scan"
    fine_ns = np.arange(int(np.floor(end * TRUTH_HZ + 1e-6)) + 1, dtype=np.int64) * (10**9 // TRUTH_HZ)
    for name, stamps in (("trajectory.tum", scan_stamps_ns), ("trajectory_100hz.tum", fine_ns)):
        poses = se3.relative(T_city_world, motion.poses(stamps / 1e9))
        write_tum(folder / name, Trajectory(stamps, poses, "lidar"), note)
    exact = motion.at(fine_ns / 1e9)
    velocity = portable.product(exact.velocity, T_city_world[:3, :3])
    names = [f"{what}_{axis}" for what in ("velocity", "rate") for axis in "xyz"]
    write_stamped_csv(folder / "motion.csv", names, fine_ns, np.hstack([velocity, exact.rate]))
    if readings.imu is not None:
        names = [f"{what}_bias_{axis}" for what in ("accel", "gyro") for axis in "xyz"]
        biases = np.hstack([readings.imu.accel_bias, readings.imu.gyro_bias])
        write_stamped_csv(folder / "imu_bias.csv", names, readings.imu.stream.stamps_ns, biases)
    _write_world(folder / "world.toml", T_city_world, readings.origin)


def _write_world(path: Path, T_enu_world: Floats, origin: Floats) -> None:
    """Write world.toml: origin (lat, lon, height), T_enu_world (4, 4) and the gravity vector in the world."""
    down = np.array([0.0, 0.0, -GRAVITY])
    tree = {
        "origin_lat_lon_alt": origin.tolist(),
        "T_enu_world": T_enu_world.tolist(),
        "gravity_world": portable.rotate(T_enu_world[:3, :3].T, down).tolist(),
    }
    write_text(path, toml_text(tree))
