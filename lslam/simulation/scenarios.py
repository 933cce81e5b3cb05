"""Scenarios by name, and the simulated drive: a Sequence whose scans are traced when they are asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.errors import UsageError, nearest
from lslam.geometry import se3, so3
from lslam.simulation import path as paths
from lslam.simulation.city import City, Layout, build_city
from lslam.simulation.curve import Curve, rounded_rectangle, smooth_curve, winding_line
from lslam.simulation.gnss import GnssModel
from lslam.simulation.imu import ImuModel, imu_named
from lslam.simulation.lidar import RayScene, trace
from lslam.simulation.lidar_models import LidarModel, lidar_named
from lslam.simulation.motion import PosePath, smooth_motion, standing_start
from lslam.simulation.sensors import Sensors, read_sensors
from lslam.simulation.terrain import Terrain, rolling
from lslam.types.calibration import Calibration
from lslam.types.gnss import GnssStream
from lslam.types.imu import ImuStream
from lslam.types.scan import Scan
from lslam.types.trajectory import Trajectory

LIDAR_HEIGHT = 1.73  # m above the ground, as on KITTI's car
FASTEST = 40.0  # m/s
LONGEST_STAND = 600.0  # s
SPARE = 60.0  # m of street before the start and after the end of an open drive


@dataclass(frozen=True)
class Scenario:
    """A kind of place and a way to drive through it.

    lines : makes (street, driven line) from a generator; speed, start_speed : m/s; lateral : greatest acceleration in bends,
    m/s2; overlap : distance driven beyond one lap of a closed line, m
    """

    name: str
    summary: str
    lines: Callable[[np.random.Generator], tuple[Curve, Curve]]
    lidar: str
    speed: float
    start_speed: float
    lateral: float
    rate_hz: float = 10.0
    overlap: float = 2.5
    layout: Layout = field(default_factory=Layout)


def _block(rng: np.random.Generator) -> tuple[Curve, Curve]:
    """Round one block counter-clockwise, right of the middle of the street."""
    size = rounded_rectangle(35.5 + rng.uniform(-0.5, 0.5), 28.0 + rng.uniform(-0.5, 0.5), 11.0)
    street = smooth_curve(size, closed=True)
    return street, smooth_curve(street.beside(street.sample(0.5), -0.8), closed=True)


def _street(rng: np.random.Generator) -> tuple[Curve, Curve]:
    """Along a winding street, changing sides of the lane now and then."""
    street = smooth_curve(winding_line(rng, 320 + 2 * SPARE), closed=False)
    s = np.arange(SPARE, street.length - SPARE, 1.0)
    sway = -0.4 + 0.5 * np.sin(2 * np.pi * s / rng.uniform(80, 120) + rng.uniform(0, 2 * np.pi))
    return street, smooth_curve(street.beside(s, sway), closed=False)


SCENARIOS = {
    scenario.name: scenario
    for scenario in (
        Scenario(
            "block", "Once round a small block of houses, 16 x 400 rays: the sample sequence.",
            _block, "sample", 13.0, 9.0, 12.0,
            layout=Layout(house_width=(6.0, 12.0), house_depth=(5.5, 9.0), setback=(0.3, 3.0), storeys=(1, 2)),
        ),
        Scenario("street", "320 m of a winding town street, HDL-64E.", _street, "hdl64", 12.0, 12.0, 6.0),
    )
}  # fmt: skip


class SimulatedDrive:
    """A drive through a generated city; satisfies the `Sequence` protocol without touching the disk.

    `ground_truth` is T_world_lidar at the scans' stamps, world = LiDAR at the first scan; `T_city_world` carries it into
    the frame of `city`. Scans are traced when asked for, each with its own seed: any order gives the same bytes.
    """

    kind = "simulated"

    def __init__(
        self,
        scenario: Scenario,
        city: City,
        path: PosePath,
        lidar: LidarModel,
        count: int,
        seed: int,
        motion_compensated: bool,
        sensors: Sensors | None = None,
    ) -> None:
        self.scenario, self.city, self.lidar = scenario, city, lidar
        # One function of time for the rays, the truth and all other sensors.
        self.vehicle = smooth_motion(path)
        self.seed = seed
        self.name = f"{scenario.name}-{seed}"
        self.path = Path(self.name)
        self.rate_hz = scenario.rate_hz
        self.motion_compensated: bool | None = motion_compensated
        self.stamps_ns: NDArray[np.int64] = np.round(np.arange(count) * (1e9 / self.rate_hz)).astype(np.int64)
        poses = self.vehicle.poses(self.stamps_ns / 1e9)
        self.T_city_world = poses[0]
        self.ground_truth: Trajectory | None = Trajectory(
            self.stamps_ns, se3.relative(poses[0], poses), "lidar", source=f"simulation of {self.name}"
        )
        self.end = self.stamps_ns[-1] / 1e9 + 1 / self.rate_hz
        self.readings = read_sensors(self.vehicle, sensors or Sensors(), lidar.name, self.end, seed)
        imu, gnss = self.readings.imu, self.readings.gnss
        self.calibration = Calibration(
            T_cam0_lidar=kitti_like_cam0(),
            T_lidar_imu=None if imu is None else imu.T_lidar_imu,
            T_lidar_gnss=None if gnss is None else gnss.T_lidar_gnss,
        )
        self.imu: ImuStream | None = None if imu is None else imu.stream
        self.gnss: GnssStream | None = None if gnss is None else gnss.stream
        self.notes: list[str] = []
        self.problems: list[str] = []
        self._scene = RayScene(city.mesh)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __iter__(self) -> Iterator[Scan]:
        return (self.scan(index) for index in range(len(self)))

    def scan(self, index: int) -> Scan:
        """Trace scan `index`, 0 <= index < len."""
        if not 0 <= index < len(self):
            raise IndexError(f"scan {index} of {len(self)}")
        start, period = self.stamps_ns[index] / 1e9, 1 / self.rate_hz
        poses = self.vehicle.poses(np.array([start]))[0]
        if not self.motion_compensated:
            poses = self.vehicle.poses(start + np.arange(self.lidar.columns) * (period / self.lidar.columns))
        rng = np.random.default_rng([self.seed, index])
        return trace(self._scene, self.lidar, poses, rng, index, int(self.stamps_ns[index]), period)


def simulate(
    scenario: str | Scenario,
    *,
    seed: int = 0,
    lidar: str | LidarModel | None = None,
    count: int | None = None,
    speed: float | None = None,
    start_speed: float | None = None,
    motion_compensated: bool = True,
    imu: str | ImuModel | None = None,
    gnss: GnssModel | None = None,
    static_start: float = 0.0,
) -> SimulatedDrive:
    """Set up a drive: the city is built now, scans are traced later.

    Parameters
    ----------
    scenario : a name of `SCENARIOS` or one's own; seed : of the city, the path and the noise, >= 0
    lidar : a name of `LIDARS` or a model; count : scans (default: one lap, or to the end of the street; on a closed line
        more scans mean more laps)
    speed, start_speed : m/s, cruising and at the first scan (0: from rest); slower in bends that need it
    motion_compensated : False fires every column from its own pose and gives times per point
    imu, gnss : an IMU (a name of `IMUS` or a model) and a receiver that ride along
    static_start : s of standing still before the drive begins; its scans come on top of a default `count`

    Raises
    ------
    UsageError : unknown names, numbers out of range, more scans than the street is long
    """
    chosen = _scenario_named(scenario) if isinstance(scenario, str) else scenario
    model = chosen.lidar if lidar is None else lidar
    model = lidar_named(model) if isinstance(model, str) else model
    cruise = chosen.speed if speed is None else speed
    begin = min(chosen.start_speed, cruise) if start_speed is None else start_speed
    _check(seed, count, cruise, begin)
    if not 0 <= static_start <= LONGEST_STAND:
        raise UsageError(f"--static-start {static_start:g} is out of range: 0 to {LONGEST_STAND:g} s")
    sensors = Sensors(imu_named(imu) if isinstance(imu, str) else imu, gnss)
    # One generator per part: another LiDAR or speed leaves the city as it is.
    place, build, shake = (np.random.default_rng([seed, k]) for k in (2**32 - 1, 2**32 - 2, 2**32 - 3))
    street, line = chosen.lines(place)
    terrain = rolling(place)
    profile = paths.SpeedProfile(cruise, begin, lateral=chosen.lateral)
    path, scans = _drive(chosen, line, terrain, profile, count, paths.suspension(shake))
    moving: PosePath = path
    if static_start > 0:
        moving = standing_start(path, static_start)
        scans += 0 if count is not None else int((moving.duration - path.duration) * chosen.rate_hz)
    city = build_city(street, terrain, chosen.layout, build)
    return SimulatedDrive(chosen, city, moving, model, scans, seed, motion_compensated, sensors)


def kitti_like_cam0() -> NDArray[np.float64]:
    """(4, 4) T_cam0_lidar: camera 0 looks ahead (x right, y down, z forward), turned by under a degree, as on KITTI's car."""
    axes = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    return se3.make(so3.from_euler_rpy(np.radians([0.45, -0.4, 0.02])) @ axes, np.array([-0.012, -0.06, -0.28]))


def _scenario_named(name: str) -> Scenario:
    if name not in SCENARIOS:
        raise UsageError(f"no scenario {name!r}; {nearest(name, SCENARIOS)}")
    return SCENARIOS[name]


def _check(seed: int, count: int | None, speed: float, start_speed: float) -> None:
    if not 0 <= seed < 2**32:
        raise UsageError(f"--seed {seed} is out of range: 0 to {2**32 - 1}")
    if count is not None and count < 1:
        raise UsageError(f"--count {count} is out of range: at least one scan")
    if not 0 < speed <= FASTEST:
        raise UsageError(f"--speed {speed:g} is out of range: above 0, at most {FASTEST:g} m/s")
    if not 0 <= start_speed <= speed:
        raise UsageError(f"a start at {start_speed:g} m/s is out of range: 0 to the speed of {speed:g} m/s")


def _drive(
    scenario: Scenario,
    line: Curve,
    terrain: Terrain,
    profile: paths.SpeedProfile,
    count: int | None,
    shaking: paths.Suspension,
) -> tuple[paths.VehiclePath, int]:
    """The path, and how many scans there are: `count`, or one lap, or all that fit on an open line."""
    distance = line.length
    if line.closed:
        wanted = distance + scenario.overlap if count is None else profile.cruise * count / scenario.rate_hz
        # The columns of the last scan need its whole period on the path.
        distance = wanted + 2 * profile.cruise / scenario.rate_hz
    path = paths.drive(line, terrain, profile, distance, LIDAR_HEIGHT, shaking)
    fits = int(np.floor(path.duration * scenario.rate_hz + 1e-6))
    if not line.closed:
        if count is not None and count > fits:
            raise UsageError(
                f"scenario {scenario.name!r} ends after {fits} scans at {profile.cruise:g} m/s: ask for fewer with "
                "--count, or drive slower with --speed"
            )
        return path, fits if count is None else count
    if count is None:
        reached = path.travelled(np.arange(fits) / scenario.rate_hz)
        count = int(np.searchsorted(reached, line.length + scenario.overlap)) + 1
    return path, count
