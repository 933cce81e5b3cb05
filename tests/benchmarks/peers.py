"""The peers our registration is measured against, each as its authors recommend it, and our own methods beside them.

A peer turns a scan into what its fastest public entry takes (`convert`, which nobody times) and then registers it, whole:
preprocessing, alignment and update of its map (`register`, which is timed). kiss-icp and genz-icp are their compiled cores,
which are handed vectors of their own and hand each other nothing else; `kiss-icp-python` is kiss-icp as its users call it,
whose every step copies to numpy and back. All take every core but ours, which take one.
"""

from __future__ import annotations

import os
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import chain, count, islice
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lslam.core.config import Config, load_config
from lslam.core.geometry import se3
from lslam.core.types.imu import ImuStream
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.odometry import create_odometry, small_gicp
from lslam.odometry import open3d as open3d_method
from lslam.odometry.frontend.tracker import ScanInput, Tracker
from lslam.odometry.inertial.constant_velocity import ConstantVelocity
from lslam.odometry.scan_outcome import measurable
from lslam.registration.preprocessing.prepare import clean_points
from lslam.registration.preprocessing.rings import decide_rings

Floats = NDArray[np.float64]
CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
# What is known of a recording before its first scan is registered: so many scans of it.
LOOKED_AT = 3
SCAN_NS = 100_000_000


@dataclass(frozen=True)
class Beginning:
    """The first scans of a recording, and its IMU with `T_lidar_imu` (4, 4) where it has one."""

    scans: list[Scan]
    imu: ImuStream | None = None
    T_lidar_imu: Floats | None = None

    @property
    def holds_motion(self) -> bool:
        """Whether points have times, so that there is something to deskew."""
        return any(scan.times is not None for scan in self.scans)


class Peer(Protocol):
    """`threads` is how many it works with."""

    threads: int

    def convert(self, scan: Scan) -> Any:
        """What `register` takes; not timed."""
        ...

    def register(self, converted: Any) -> Floats:
        """Pose (4, 4) of the next scan."""
        ...

    def convert_within(self, converted: Any) -> None:
        """Once more the conversion that no public entry lets be done beforehand: its time is taken off."""
        ...


class Timed:
    """A peer without such a conversion."""

    threads = CORES

    def convert_within(self, converted: Any) -> None:
        """Nothing."""


class Ours(Timed):
    """A method of the house from float32 points in memory: rings where it wants them, gate, down-sampling, deskew,
    registration and map, as in `lslam run`. What stands is registered, too, and nothing checks the poses afterwards.
    """

    threads = 1

    def __init__(self, method: str, beginning: Beginning) -> None:
        self._odometry = create_odometry(load_config(None, [f"odometry.method={method}", "input.threads=1"], {}))
        self._odometry.warm_up()
        self._tracker = Tracker(self._odometry)
        self._rings = decide_rings(beginning.scans) if self._odometry.needs_rings else None

    def convert(self, scan: Scan) -> Scan:
        return scan

    def register(self, converted: Scan) -> Floats:
        scan = converted if self._rings is None else replace(converted, rings=self._rings.rings_of(converted))
        scan = measurable(scan)
        loaded = ScanInput(scan.index, scan.stamp_ns, scan, self._odometry.prepare(scan))
        return self._tracker.track(loaded).T_world_lidar


def finite_points(scan: Scan) -> tuple[Floats, list[float]]:
    """Points (N, 3) and their times as shares of the sweep, 0 to 1; no times where points have none.

    A list, of which pybind11 makes a vector three times as fast as of an array.
    """
    finite = np.isfinite(scan.points).all(axis=1)
    points = np.ascontiguousarray(scan.points[finite], np.float64)
    if scan.times is None:
        return points, []
    times = scan.times[finite].astype(np.float64)
    return points, ((times - times.min()) / max(float(np.ptp(times)), 1e-9)).tolist()


class Core:
    """A compiled core of kiss-icp's family: vectors of its own in place of arrays, and times in a list."""

    threads = CORES

    def __init__(self, core: Any) -> None:
        self._core = core
        self._idle, self._nothing = core._Preprocessor(100.0, 0.0, False, 0), core._Vector3dVector(np.zeros((0, 3)))

    def convert(self, scan: Scan) -> Any:
        points, shares = finite_points(scan)
        return self._core._Vector3dVector(points), shares

    def convert_within(self, converted: Any) -> None:
        """The times, which the core wants as a vector that Python cannot make: here with nothing to do about them."""
        self._idle._preprocess(self._nothing, converted[1], np.eye(4))


class Kiss(Core):
    """kiss-icp 1.3, the core alone: the calls of its `KissICP.register_frame`, from vector to vector.

    Its defaults (`kiss_icp/config/config.py`): range 100 m, voxels of a hundredth of that, threads automatic (TBB).
    """

    def __init__(self, beginning: Beginning) -> None:
        from kiss_icp.pybind import kiss_icp_pybind

        super().__init__(kiss_icp_pybind)
        self._kiss = kiss_as_called(beginning.holds_motion)
        self._voxel = self._kiss.config.mapping.voxel_size

    def register(self, converted: Any) -> Floats:
        kiss, core = self._kiss, self._core
        frame = kiss.preprocessor._preprocessor._preprocess(*converted, kiss.last_delta)
        for_map = core._voxel_down_sample(frame, 0.5 * self._voxel)
        source = core._voxel_down_sample(for_map, 1.5 * self._voxel)
        sigma = kiss.adaptive_threshold.get_threshold()
        guess = kiss.last_pose @ kiss.last_delta
        local_map = kiss.local_map._internal_map
        pose = kiss.registration._registration._align_points_to_map(source, local_map, guess, 3 * sigma, sigma)
        kiss.adaptive_threshold.update_model_deviation(np.linalg.inv(guess) @ pose)
        local_map._update(for_map, pose)
        kiss.last_delta = np.linalg.inv(kiss.last_pose) @ pose
        kiss.last_pose = pose
        return np.array(pose)


def kiss_as_called(with_deskew: bool) -> Any:
    from kiss_icp.config import load_config as load_kiss_config
    from kiss_icp.kiss_icp import KissICP

    config = load_kiss_config(None)
    config.data.deskew = with_deskew
    return KissICP(config)


class KissPython(Timed):
    """kiss-icp by its Python API, from the float64 arrays that its own readers give."""

    def __init__(self, beginning: Beginning) -> None:
        self._kiss = kiss_as_called(beginning.holds_motion)

    def convert(self, scan: Scan) -> Any:
        points, shares = finite_points(scan)
        return points, np.array(shares)

    def register(self, converted: Any) -> Floats:
        self._kiss.register_frame(*converted)
        return np.array(self._kiss.last_pose)


class GenZ(Core):
    """genz-icp 0.3, the core alone, in its defaults, or with a configuration that comes with it and its README names."""

    def __init__(self, beginning: Beginning, name: str | None = None) -> None:
        from genz_icp.config import load_config as load_genz_config
        from genz_icp.genz_icp import GenZICP
        from genz_icp.pybind import genz_icp_pybind

        super().__init__(genz_icp_pybind)
        config = load_genz_config(Path(name) if name else None)
        config.data.deskew = beginning.holds_motion
        self._genz = GenZICP(config)._odometry

    def register(self, converted: Any) -> Floats:
        points, shares = converted
        self._genz._register_frame(points, *([shares] if shares else []))
        return np.array(self._genz._last_pose())


class RkoLio(Timed):
    """rko-lio 0.4 in its defaults, with the IMU where there is one and at constant velocity where there is none."""

    def __init__(self, beginning: Beginning) -> None:
        from rko_lio import rko_lio_pybind
        from rko_lio.config import LIOConfig

        config = LIOConfig(deskew=beginning.holds_motion)
        self._core, self._lio = rko_lio_pybind, rko_lio_pybind._LIO(config.to_pybind())
        self._imu, self._T_lidar_imu, self._told = beginning.imu, beginning.T_lidar_imu, 0

    def convert(self, scan: Scan) -> Any:
        finite = np.isfinite(scan.points).all(axis=1)
        seconds = np.zeros(len(scan)) if scan.times is None else scan.times.astype(np.float64)
        stamps = scan.stamp_ns + np.round(1e9 * seconds[finite]).astype(np.int64)
        points = np.ascontiguousarray(scan.points[finite], np.float64)
        first, last = (int(stamps.min()), int(stamps.max())) if len(stamps) else (scan.stamp_ns, scan.stamp_ns)
        return self._core._Vector3sVector(points), self._core._VectorInt64(stamps), first, last, self._until(last)

    def _until(self, last_ns: int) -> list[tuple[Floats, Floats, int]]:
        """What the IMU said since it was asked last."""
        if self._imu is None or self._T_lidar_imu is None:
            return []
        end = int(np.searchsorted(self._imu.stamps_ns, last_ns, side="right"))
        told = range(self._told, end)
        self._told = end
        return [(self._imu.accel[k], self._imu.gyro[k], int(self._imu.stamps_ns[k])) for k in told]

    def register(self, converted: Any) -> Floats:
        points, stamps, first, last, samples = converted
        for accel, gyro, stamp in samples:
            self._lio.add_imu_measurement(self._T_lidar_imu, accel, gyro, stamp)
        self._lio.register_scan(np.eye(4), points, stamps, first, last)
        return np.array(self._lio.pose())


class Keyframed(Timed):
    """A baseline of `lslam methods`: what its `prepare` does in its package is timed, what it does in numpy is not."""

    def __init__(self, method: Any, cloud: Callable[[Floats], Any], covered: Callable[[Any], Any]) -> None:
        self._method, self._cloud, self._covered = method, cloud, covered
        self._motion = ConstantVelocity()

    def convert(self, scan: Scan) -> Any:
        return scan, self._cloud(clean_points(scan.points, Config().preprocess).astype(np.float64))

    def register(self, converted: Any) -> Floats:
        scan, cloud = converted
        prior = MotionPrior.at_once(self._motion.predict(scan.stamp_ns))
        pose = self._method.register(scan, self._covered(cloud), prior).T_world_lidar
        self._motion.correct(scan.stamp_ns, pose)
        return np.array(pose)


def gicp_keyframes(beginning: Beginning) -> Keyframed:
    """small_gicp's GICP on a map of keyframes. Its Python has GICP between two clouds only: map and leaf are ours."""
    import small_gicp as package

    method = small_gicp.create(load_config(None, [f"input.threads={CORES}"], {}))

    def covered(cloud: Any) -> Any:
        return package.preprocess_points(cloud, downsampling_resolution=small_gicp.LEAF_M, num_threads=CORES)[0]

    return Keyframed(method, package.PointCloud, covered)


def gicp_open3d(beginning: Beginning) -> Keyframed:
    """Open3D's generalised ICP, scan to scan. It recommends no grid for LiDAR: that is ours; the rest are its defaults."""
    method = open3d_method.create(Config())
    import open3d as package

    def cloud(points: Floats) -> Any:
        return package.geometry.PointCloud(package.utility.Vector3dVector(points))

    def covered(cloud: Any) -> Any:
        thinned = cloud.voxel_down_sample(open3d_method.LEAF_M)
        thinned.estimate_covariances(package.geometry.KDTreeSearchParamKNN(open3d_method.COVARIANCE_POINTS))
        return thinned

    return Keyframed(method, cloud, covered)


class SmallGicp(Timed, ABC):
    """small_gicp 1.0 as in its `src/example/kitti_odometry.py`: leaf 0.25 m, ten neighbours, correspondences within 1 m."""

    LEAF, REACH, VOXEL = 0.25, 1.0, 1.0

    def __init__(self) -> None:
        import small_gicp as package

        self._package = package
        self._pose, self._step = np.eye(4), np.eye(4)

    def convert(self, scan: Scan) -> Any:
        kept = np.linalg.norm(scan.points, axis=1) < 100.0
        return self._package.PointCloud(scan.points[kept].astype(np.float64))

    def register(self, converted: Any) -> Floats:
        source, tree = self._package.preprocess_points(converted, self.LEAF, num_threads=CORES)
        pose = self._located(source)
        self._step, self._pose = se3.relative(self._pose, pose), pose
        self._enter(source, tree)
        return pose

    @abstractmethod
    def _located(self, source: Any) -> Floats:
        """Pose (4, 4) of the scan."""

    @abstractmethod
    def _enter(self, source: Any, tree: Any) -> None:
        """Make the scan part of what the next one is registered on."""


class GicpScans(SmallGicp):
    """GICP, each scan on the one before."""

    def __init__(self, beginning: Beginning) -> None:
        super().__init__()
        self._target: Any = None

    def _located(self, source: Any) -> Floats:
        if self._target is None:
            return self._pose
        cloud, tree = self._target
        found = self._package.align(
            cloud, source, tree, self._step, max_correspondence_distance=self.REACH, num_threads=CORES
        )
        return np.asarray(self._pose @ found.T_target_source)

    def _enter(self, source: Any, tree: Any) -> None:
        self._target = source, tree


class VgicpModel(SmallGicp):
    """VGICP on a map of Gaussian voxels that forgets what was not seen for a hundred scans."""

    def __init__(self, beginning: Beginning) -> None:
        super().__init__()
        self._model = self._package.GaussianVoxelMap(self.VOXEL)
        self._model.set_lru(horizon=100, clear_cycle=10)

    def _located(self, source: Any) -> Floats:
        if self._model.size() == 0:
            return self._pose
        guess = self._pose @ self._step
        found = self._package.align(
            self._model, source, guess, max_correspondence_distance=self.REACH, num_threads=CORES
        )
        return np.array(found.T_target_source)

    def _enter(self, source: Any, tree: Any) -> None:
        self._model.insert(source, self._pose)


OURS = ("icp", "gicp", "vgicp", "ndt", "loam", "floam")
PEERS: dict[str, Callable[[Beginning], Peer]] = {
    **{name: lambda beginning, name=name: Ours(name, beginning) for name in OURS},  # type: ignore[misc]
    "kiss-icp": Kiss,
    "kiss-icp-python": KissPython,
    "genz-icp": GenZ,
    "genz-icp-outdoor": lambda beginning: GenZ(beginning, "outdoor.yaml"),
    "rko-lio": RkoLio,
    "small-gicp": gicp_keyframes,
    "small-gicp-scans": GicpScans,
    "small-vgicp": VgicpModel,
    "open3d-gicp": gicp_open3d,
}


def timed(peer: Peer, scans: Iterable[Scan]) -> tuple[Floats, Floats]:
    """Poses (N, 4, 4), and seconds (N, 2) of each registration by the wall and by the CPU, all threads together."""
    poses, seconds = [], []
    for scan in scans:
        converted = peer.convert(scan)
        began = time.perf_counter(), time.process_time()
        pose = peer.register(converted)
        done = time.perf_counter(), time.process_time()
        peer.convert_within(converted)
        after = time.perf_counter(), time.process_time()
        # A first scan, which is only kept, may take less than the noise of its conversion.
        seconds.append([max(2 * done[k] - began[k] - after[k], 0.0) for k in (0, 1)])
        poses.append(pose)
    return np.stack(poses), np.array(seconds)


def drive(name: str, scans: Iterable[NDArray[np.float32]]) -> tuple[Floats, Floats]:
    """Poses (N, 4, 4) and seconds (N,) by the wall of one peer over clouds (n, 3) that hold no motion, ten a second."""
    numbered = (Scan(points, k * SCAN_NS, k) for k, points in zip(count(), scans))
    first = list(islice(numbered, LOOKED_AT))
    poses, seconds = timed(PEERS[name](Beginning(first)), chain(first, numbered))
    return poses, seconds[:, 0]
