"""Scenarios by name, and the simulated drive: a Sequence whose scans are simulated on demand."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats, Longs
from lslam.core.errors import UsageError
from lslam.core.geometry import portable, se3, so3
from lslam.core.types.gnss import GnssStream
from lslam.core.types.imu import ImuStream, WheelStream
from lslam.core.types.scan import Scan
from lslam.core.types.sequence import Calibration, Scans
from lslam.core.types.trajectory import Trajectory
from lslam.simulation.built_scenario import build_scenario, check_path, populate
from lslam.simulation.city import City
from lslam.simulation.imu import ImuModel, find_imu
from lslam.simulation.kinematics import Motion, PosePath, shaking, smooth_motion, standing_start
from lslam.simulation.lidar import Roof, trace
from lslam.simulation.lidar_models import LidarModel, LidarMount, find_lidar
from lslam.simulation.moving import Mover, moving_meshes
from lslam.simulation.osm_place import read_extract
from lslam.simulation.routes import FIRST_VISIT, Visit, WayPoints, read_way_points
from lslam.simulation.scenario_files import Scenario, find_scenario
from lslam.simulation.scene_mesh import RayScene
from lslam.simulation.sensors import BASE, ORIGIN, GnssModel, Sensors, WheelModel, read_sensors

FASTEST = 40.0  # m/s
LONGEST_STAND = 600.0  # s
SPARE_REACH = 10.0  # m that anything may get nearer while a scan is taken
_SHAKING_SEED = 2**32 - 13  # of the generator of the LiDAR's vibration
_MOUNT_SEED = 2**32 - 17  # of those of further LiDARs


@dataclass(frozen=True)
class MountedMotion:
    """Motion of a sensor at `T_lidar_other` (4, 4) from the LiDAR with motion `motion`."""

    motion: Motion
    T_lidar_other: Floats

    def poses(self, times: NDArray[Any]) -> Floats:
        """(M, 4, 4) T_city_other at `times` (M,), s."""
        return portable.product(self.motion.poses(times), self.T_lidar_other)


class SimulatedDrive(Scans):
    """A drive through a generated city; satisfies the `Sequence` protocol without touching the disk.

    `ground_truth` is T_world_lidar at the scans' stamps, world = LiDAR at the first scan; `T_city_world` transforms it into
    the frame of `city`. Scans are traced on demand, each with its own seed: any order gives the same bytes.

    further : the scans of other LiDARs on the same vehicle, in the order of the scenario, with truth and extrinsics of their own
    motion_compensated : whether all points of a scan are seen from one pose; scene : of `city`, None to make it
    origin : (3,) lat, lon (deg), height (m) of the city's origin; visit : of several to one city, with noise of its own
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
        movers: Sequence[Mover] = (),
        scene: RayScene | None = None,
        origin: Floats = ORIGIN,
        visit: Visit = FIRST_VISIT,
    ) -> None:
        self.scenario, self.city, self.lidar, self.movers = scenario, city, lidar, list(movers)
        # One function of time for the rays, the truth and all other sensors.
        self.vehicle = smooth_motion(path)
        self._motion: Motion | MountedMotion = self.vehicle
        self.seed, self.visit = seed, visit
        self._seeds = visit.seeds(seed)
        self.name = f"{scenario.name}-{seed}" + (f"-visit{visit.number}" if visit.number else "")
        self.path = Path(self.name)
        self.rate_hz = scenario.rate_hz
        self.motion_compensated: bool | None = motion_compensated
        self.stamps_ns: Longs = np.round(np.arange(count) * (1e9 / self.rate_hz)).astype(np.int64)
        poses = self.vehicle.poses(self.stamps_ns / 1e9)
        self.T_city_world = poses[0]
        self.ground_truth: Trajectory | None = Trajectory(
            self.stamps_ns, se3.relative(poses[0], poses), "lidar", source=f"simulation of {self.name}"
        )
        self.end = self.stamps_ns[-1] / 1e9 + 1 / self.rate_hz
        self.sensors = sensors or Sensors()
        self.readings = read_sensors(self.vehicle, self.sensors, scenario.carrier, self.end, self._seeds, origin)
        imu, gnss, wheels = self.readings.imu, self.readings.gnss, self.readings.wheels
        self.calibration = Calibration(
            T_cam0_lidar=kitti_like_cam0(),
            T_lidar_imu=None if imu is None else imu.T_lidar_imu,
            T_lidar_gnss=None if gnss is None else gnss.T_lidar_gnss,
            frames={} if wheels is None or wheels.stream.T_lidar_base is None else {BASE: wheels.stream.T_lidar_base},
        )
        self.imu: ImuStream | None = None if imu is None else imu.stream
        self.gnss: GnssStream | None = None if gnss is None else gnss.stream
        self.wheels: WheelStream | None = None if wheels is None else wheels.stream
        self.notes: list[str] = []
        self.problems: list[str] = []
        self._shaking = shaking(scenario.vibration, np.random.default_rng([*self._seeds, _SHAKING_SEED]))
        self._roof = None if scenario.roof is None else Roof(*scenario.roof, scenario.roof_returns)
        self.scene = RayScene(city.mesh) if scene is None else scene
        self.further = [self._beside(mount, number) for number, mount in enumerate(scenario.lidars)]

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __iter__(self) -> Iterator[Scan]:
        return (self.scan(index) for index in range(len(self)))

    @property
    def city_poses(self) -> Floats:
        """(N, 4, 4) T_city_lidar at the scans' stamps."""
        return self._motion.poses(self.stamps_ns / 1e9)

    def _beside(self, mount: LidarMount, number: int) -> SimulatedDrive:
        """The drive by another LiDAR, with its own noise, without the roof; UsageError if no sweep of it is whole."""
        other, T, late_ns = copy.copy(self), mount.T_lidar_other, round(1e6 * mount.offset_ms)
        other.name, other.path = f"{self.name}-{mount.name}", Path(f"{self.name}-{mount.name}")
        other.lidar = self.lidar if mount.lidar is None else _with_ring_errors(find_lidar(mount.lidar), self.scenario)
        # A last sweep that begins late would end after the drive.
        other.stamps_ns = self.stamps_ns[: len(self) - (late_ns > 0)] + late_ns
        if not len(other.stamps_ns):
            raise UsageError(
                f"{mount.name} begins its sweeps {mount.offset_ms:g} ms late: at least two scans are needed"
            )
        other._motion, other._roof, other._seeds = (
            MountedMotion(self.vehicle, T),
            None,
            (*self._seeds, _MOUNT_SEED, number),
        )
        other._shaking = shaking(self.scenario.vibration, np.random.default_rng([*other._seeds, _SHAKING_SEED]))
        poses = other.city_poses
        other.T_city_world = poses[0]
        other.ground_truth = Trajectory(
            other.stamps_ns, se3.relative(poses[0], poses), "lidar", source=f"simulation of {other.name}"
        )
        known = self.calibration
        imu, gnss = (None if S is None else se3.relative(T, S) for S in (known.T_lidar_imu, known.T_lidar_gnss))
        assert known.T_cam0_lidar is not None
        other.calibration = Calibration(portable.product(known.T_cam0_lidar, T), imu, gnss)
        return other

    def scan(self, index: int) -> Scan:
        """Trace scan `index`; raises IndexError outside 0 <= index < len."""
        if not 0 <= index < len(self):
            raise IndexError(f"scan {index} of {len(self)}")
        start, period = self.stamps_ns[index] / 1e9, 1 / self.rate_hz
        poses = self._motion.poses(np.array([start]))[0]
        fired = start + np.arange(self.lidar.columns) * (period / self.lidar.columns)
        if not self.motion_compensated:
            poses = self._motion.poses(fired)
        if self._shaking is not None:
            poses = self._shaking.shake(poses, fired)
        rng = np.random.default_rng([*self._seeds, index])
        here = poses if poses.ndim == 2 else poses[len(poses) // 2]
        bodies = moving_meshes(self.movers, here[:3, 3], start, self.lidar.range_max + SPARE_REACH)
        return trace(
            self.scene,
            self.lidar,
            poses,
            rng,
            index,
            int(self.stamps_ns[index]),
            period,
            bodies,
            self.scenario.world.glass,
            self._roof,
            self.scenario.real_returns,
            self.motion_compensated,
        )


def simulate(
    scenario: str | Scenario,
    *,
    seed: int = 0,
    lidar: str | LidarModel | None = None,
    count: int | None = None,
    speed: float | None = None,
    start_speed: float | None = None,
    motion_compensated: bool | None = None,
    settings: Iterable[str] = (),
    way_points: WayPoints | Path | None = None,
    osm: Path | None = None,
    origin: Iterable[float] | None = None,
    imu: str | ImuModel | None = None,
    gnss: GnssModel | None = None,
    wheels: WheelModel | None = None,
    static_start: float = 0.0,
    visit: Visit = FIRST_VISIT,
) -> SimulatedDrive:
    """Set up a drive: the city is built now, scans are traced later.

    Parameters
    ----------
    scenario : a name of `scenario_names()` or a `Scenario`; seed : of the city, the path and the noise, >= 0
    lidar : a name of `LIDARS` or a model; count : scans (default: one lap, or to the end of the street; on a closed line
        more scans mean more laps)
    speed, start_speed : m/s, cruising and at the first scan (0: from rest); lower in tight bends
    motion_compensated : False fires every column from its own pose and gives times per point; None: as the scenario says
    settings : overrides of a scenario given by name, "world.relief=1"
    way_points : a line, or a file of one, instead of the scenario's; the city is built round it
    osm : an OpenStreetMap extract (XML or Overpass JSON) whose buildings are the city, x east and y north of the origin;
        without `way_points` the drive goes along its streets
    origin : lat, lon (deg) and perhaps height (m) of the city's x = y = 0 (default: the middle of the extract's buildings,
        else the first point of GeoJSON way-points, else an arbitrary position)
    imu, gnss : an IMU (a name of `IMUS` or a model) and a receiver on the carrier; wheels : of a car
    static_start : s of standstill before the drive begins, 0: as in the scenario; its scans add to a default `count`
    visit : another drive through the same town: other traffic and noise, another start, the opposite direction

    Raises
    ------
    UsageError : unknown names and keys, numbers out of range, more scans than the street is long, an impossible path:
        through a building or the ground, or too sharp a bend
    InputError : a file that is missing or damaged, an extract without buildings or far from the path
    """
    chosen = find_scenario(scenario, settings) if isinstance(scenario, str) else scenario
    model = chosen.lidar if lidar is None else lidar
    model = _with_ring_errors(find_lidar(model) if isinstance(model, str) else model, chosen)
    cruise = chosen.speed if speed is None else speed
    begin = (
        (cruise if chosen.carrier == "drone" and chosen.start_speed else min(chosen.start_speed, cruise))
        if start_speed is None
        else start_speed
    )
    _check(seed, count, cruise, begin)
    if not 0 <= static_start <= LONGEST_STAND:
        raise UsageError(f"--static-start {static_start:g} is out of range: 0 to {LONGEST_STAND:g} s")
    measuring = find_imu(imu) if isinstance(imu, str) else imu
    sensors = Sensors(None if measuring is None else chosen.imu.of(measuring), gnss, wheels)
    chosen = chosen.model_copy(update={"speed": cruise, "start_speed": begin})
    given = None if origin is None else checked_origin(origin)
    extract = None if osm is None else read_extract(osm, given)
    at = given if extract is None else extract.origin
    line = read_way_points(way_points, at) if isinstance(way_points, Path) else way_points
    if at is None:
        at = line.origin if line is not None and line.origin is not None else ORIGIN
    if osm is not None:
        chosen = chosen.model_copy(
            update={"name": osm.stem, "summary": f"As {chosen.name!r}, in the city of {osm.name}."}
        )
    static_start = static_start or chosen.stand_s
    standing = int(static_start * chosen.rate_hz)
    place = build_scenario(chosen, seed, count, line, extract, standing, visit)
    scene = RayScene(place.city.mesh)
    if chosen.path.clearance:
        check_path(scene, place.city, place.path.poses, place.path.duration)
    path: PosePath = place.path
    scans = place.scans
    if static_start > 0:
        path = standing_start(path, static_start)
        scans += 0 if count is not None else int((path.duration - place.path.duration) * chosen.rate_hz)
    movers = populate(chosen, place.city, path, visit.seeds(seed))
    still = chosen.motion_compensated if motion_compensated is None else motion_compensated
    return SimulatedDrive(chosen, place.city, path, model, scans, seed, still, sensors, movers, scene, at, visit)


def checked_origin(origin: Iterable[float]) -> Floats:
    """(3,) lat, lon (deg), height (m) of two or three numbers. Raises UsageError when they are no position on the Earth."""
    values = [float(value) for value in origin]
    if len(values) not in (2, 3) or not np.isfinite(values).all():
        raise UsageError(f"--origin {','.join(f'{v:g}' for v in values)}: expected LAT,LON or LAT,LON,HEIGHT")
    lat, lon = values[:2]
    if not (abs(lat) < 90 and abs(lon) <= 180):
        raise UsageError(
            f"--origin {lat:g},{lon:g} is out of range: latitude above -90 and below 90, longitude -180 to 180 degrees"
        )
    return np.array([*values, 0.0][:3])


def kitti_like_cam0() -> Floats:
    """(4, 4) T_cam0_lidar as on KITTI's car: x right, y down, z forward, and a misalignment below one degree."""
    axes = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    return se3.make(
        portable.product(so3.from_euler_rpy(np.radians([0.45, -0.4, 0.02])), axes), np.array([-0.012, -0.06, -0.28])
    )


def _with_ring_errors(model: LidarModel, scenario: Scenario) -> LidarModel:
    """LiDAR model with the calibration errors of a scenario."""
    share = scenario.returns.calibration
    return replace(model, ring_bias=share * model.ring_bias, ring_tilt_deg=share * model.ring_tilt_deg)


def _check(seed: int, count: int | None, speed: float, start_speed: float) -> None:
    """Raise UsageError for a seed, number of scans or speed out of range."""
    if not 0 <= seed < 2**32:
        raise UsageError(f"--seed {seed} is out of range: 0 to {2**32 - 1}")
    if count is not None and count < 1:
        raise UsageError(f"--count {count} is out of range: at least one scan")
    if not 0 < speed <= FASTEST:
        raise UsageError(f"--speed {speed:g} is out of range: above 0, at most {FASTEST:g} m/s")
    if not 0 <= start_speed <= speed:
        raise UsageError(f"a start at {start_speed:g} m/s is out of range: 0 to the speed of {speed:g} m/s")
