"""Where the sensors of a bag sit, and its ground truth."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from lslam.formats.bag_files import Bag
from lslam.formats.bag_streams import Stream, chain, read_poses
from lslam.formats.sequence_toml import SequenceInfo
from lslam.geometry import se3
from lslam.readers.bag_topics import put_in_order, say_broken
from lslam.readers.ground_truth import Voice
from lslam.types.calibration import Calibration
from lslam.types.trajectory import Trajectory

Transforms = dict[tuple[str, str], NDArray[np.float64]]

CAMERA = "cam0"
# Odometry in a bag is somebody's estimate, unless its name says that it is the truth.
_TRUTH = re.compile(r"(^|[/_])(ground_?truth|gt)([/_]|$)", re.IGNORECASE)


def find_extrinsics(
    transforms: Transforms, lidar: str, imu: Stream | None, gnss: Stream | None, info: SequenceInfo, voice: Voice
) -> tuple[Calibration, bool]:
    """Extrinsics that the user or the recording states, else from /tf_static, else the identity with a warning (True).

    transforms : `T_parent_child` of /tf_static; lidar : the frame of the scans
    """
    T_cam0_lidar = chain(transforms, CAMERA, lidar) if info.T_cam0_lidar is None else info.T_cam0_lidar
    T_lidar_imu, T_lidar_gnss = info.T_lidar_imu, info.T_lidar_gnss
    is_assumed = False
    if imu is not None and T_lidar_imu is None:
        T_lidar_imu = _find(transforms, lidar, imu.frame, "IMU", voice)
        if T_lidar_imu is None:
            voice.problems.append(
                f"extrinsics: {_why_not(transforms, lidar, imu.frame)}, so the IMU is taken to sit in the LiDAR, axes alike; "
                "--extrinsics states T_lidar_imu"
            )
            T_lidar_imu, is_assumed = np.eye(4), True
    if gnss is not None and T_lidar_gnss is None:
        T_lidar_gnss = _find(transforms, lidar, gnss.frame, "GNSS", voice)
        if T_lidar_gnss is None:
            voice.notes.append(
                f"extrinsics: {_why_not(transforms, lidar, gnss.frame)}: the place of the antenna is unknown"
            )
    return Calibration(T_cam0_lidar, T_lidar_imu, T_lidar_gnss), is_assumed


def find_truth(bag: Bag, transforms: Transforms, lidar: str, voice: Voice) -> Trajectory | None:
    """LiDAR poses of the first topic whose name says ground truth (Odometry or PoseStamped), None when there is none."""
    topics = [t for t in bag.of_type("Odometry", "PoseStamped") if _TRUTH.search(t.name)]
    if not topics:
        return None
    topic = topics[0]
    broken: list[str] = []
    stamps, poses, body = read_poses(bag, topic, broken)
    say_broken(broken, topic.name, voice)
    order, stamps = put_in_order(stamps, np.zeros(len(stamps), np.int64), f"{topic.name}: poses", voice)
    if not len(order):
        return None
    poses = poses[order]
    T_body_lidar = chain(transforms, body, lidar)
    if T_body_lidar is None:
        voice.problems.append(
            f"ground truth {topic.name} holds poses of {body or 'an unnamed body'} and no static transform leads from there to "
            f"{lidar}: they are taken as LiDAR poses"
        )
    elif body != lidar:
        poses = se3.normalise(poses @ T_body_lidar)
        voice.notes.append(f"ground truth {topic.name}: poses of {body}, carried to {lidar} with /tf_static")
    return Trajectory(stamps, poses, "lidar", True, None, f"{bag.path}, {topic.name}")


def _find(transforms: Transforms, lidar: str, frame: str, what: str, voice: Voice) -> NDArray[np.float64] | None:
    if not lidar or not frame:
        return None
    T = chain(transforms, lidar, frame)
    if T is not None:
        how = "the same frame" if lidar == frame else "from /tf_static"
        voice.notes.append(f"extrinsics of the {what}: T_{lidar}_{frame}, {how}")
    return T


def _why_not(transforms: Transforms, lidar: str, frame: str) -> str:
    if not lidar or not frame:
        return "messages name no frame"
    return (
        f"{'no transform leads' if transforms else 'there is no /tf_static that leads'} from frame {lidar} to {frame}"
    )
