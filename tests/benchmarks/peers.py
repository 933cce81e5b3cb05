"""The peers our registration is measured against, each as a function from scans to poses with its seconds per scan.

Every peer gets the same arrays from the same reader and is timed around its whole register call: its own
preprocessing, alignment and map update. kiss-icp and genz-icp run with their defaults; small_gicp as GICP against
a keyframe local map and as VGICP scan-to-model (its own example), with two threads.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

Register = Callable[[NDArray[np.float32]], NDArray[np.float64]]


def icp() -> Register:
    from lslam import Registration

    registration = Registration()
    return lambda points: registration.register(points).T_world_lidar


def kiss_icp() -> Register:
    from kiss_icp.config import load_config
    from kiss_icp.kiss_icp import KissICP

    config = load_config(None)
    config.data.deskew = False
    kiss = KissICP(config)

    def register(points: NDArray[np.float32]) -> NDArray[np.float64]:
        kiss.register_frame(points.astype(np.float64), np.zeros(len(points)))
        return np.array(kiss.last_pose)

    return register


def genz_icp() -> Register:
    from genz_icp.config import GenZConfig
    from genz_icp.genz_icp import GenZICP

    genz = GenZICP(GenZConfig())

    def register(points: NDArray[np.float32]) -> NDArray[np.float64]:
        genz.register_frame(points.astype(np.float64), np.zeros(0))
        return np.array(genz.last_pose)

    return register


def gicp_keyframes() -> Register:
    """The method `small-gicp` itself, its preprocessing timed with it."""
    from lslam.config import Config
    from lslam.odometry.small_gicp import create
    from lslam.registration.constant_velocity import ConstantVelocity
    from lslam.types.motion_prior import MotionPrior
    from lslam.types.scan import Scan

    method, motion, count = create(Config()), ConstantVelocity(), iter(range(1_000_000))

    def register(points: NDArray[np.float32]) -> NDArray[np.float64]:
        index = next(count)
        scan = Scan(points, index * 100_000_000, index)
        prior = MotionPrior.at_once(motion.predict(scan.stamp_ns))
        pose = method.register(scan, method.prepare(scan), prior).T_world_lidar
        motion.correct(scan.stamp_ns, pose)
        return pose

    return register


def vgicp_model(leaf: float = 0.25, voxel: float = 1.0) -> Register:
    import small_gicp

    model = small_gicp.GaussianVoxelMap(voxel)
    model.set_lru(horizon=100, clear_cycle=10)
    poses: list[NDArray[np.float64]] = []

    def register(points: NDArray[np.float32]) -> NDArray[np.float64]:
        kept = points[(np.linalg.norm(points, axis=1) < 100.0)].astype(np.float64)
        source, _ = small_gicp.preprocess_points(kept, downsampling_resolution=leaf, num_threads=2)
        if not poses:
            poses.append(np.eye(4))
        else:
            prior = poses[-1] if len(poses) < 2 else poses[-1] @ np.linalg.inv(poses[-2]) @ poses[-1]
            result = small_gicp.align(model, source, prior, max_correspondence_distance=1.0, num_threads=2)
            poses.append(np.array(result.T_target_source))
        model.insert(source, poses[-1])
        return poses[-1]

    return register


PEERS: dict[str, Callable[[], Register]] = {
    "icp": icp,
    "kiss-icp": kiss_icp,
    "small-gicp": gicp_keyframes,
    "small-vgicp": vgicp_model,
    "genz-icp": genz_icp,
}


def drive(name: str, scans: Iterable[NDArray[np.float32]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Poses (N, 4, 4) and seconds (N,) of one peer over all scans; compiling is not counted."""
    if name == "icp":
        from lslam.config import Config
        from lslam.odometry import create_odometry

        create_odometry(Config()).warm_up()
    register = PEERS[name]()
    poses, seconds = [], []
    for points in scans:
        began = time.perf_counter()
        pose = register(points)
        seconds.append(time.perf_counter() - began)
        poses.append(pose)
    return np.stack(poses), np.array(seconds)
