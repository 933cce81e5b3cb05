"""Classes of points by geometry against the surfaces that simulated rays met."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.core.config.input import PreprocessConfig
from lslam.core.geometry import se2, se3
from lslam.core.labels import CLASSES
from lslam.core.types.motion_prior import MotionPrior
from lslam.odometry.frontend.keyframing import keyframe_cloud, keyframe_labels
from lslam.osm.walls import classify
from lslam.simulation.scenarios import simulate

TRUE = {
    "ground": ("road", "sidewalk", "terrain"),
    "wall": ("building",),
    "pole": ("pole", "trunk"),
    "vegetation": ("vegetation",),
    "vehicle": ("car", "moving-car"),
}
FOUND = (CLASSES["other-ground"], CLASSES["building"], CLASSES["pole"], CLASSES["vegetation"], CLASSES["car"])
NAMES = tuple(TRUE)
SPACING_M, SCANS = 2.0, 5
REACH_M = 60.0  # as `WALL_RANGE_M`


def submap_of(
    scenario: str, seed: int, lidar: str | None, places: int
) -> list[tuple[NDArray[np.float32], NDArray[np.uint16]]]:
    """Points (N, 3), m, z up, and their true classes (N,), at places that are spread evenly over the drive."""
    drive = simulate(scenario, seed=seed, lidar=lidar, motion_compensated=True)
    poses = drive.city_poses
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))])
    found = []
    for start in np.linspace(0.0, way[-1] - SPACING_M * SCANS, places):
        numbers = np.searchsorted(way, start + SPACING_M * np.arange(SCANS))
        middle = poses[numbers[SCANS // 2]]
        level = se2.to_se3(se2.of_se3(middle))
        level[2, 3] = middle[2, 3]
        parts = []
        for k in numbers.tolist():
            scan = drive.scan(k)
            given = scan, MotionPrior.at_once(np.eye(4)), PreprocessConfig()
            labels = keyframe_labels(*given)
            assert labels is not None
            parts.append((se3.apply(se3.relative(level, poses[k]), keyframe_cloud(*given)), labels))
        cloud = np.concatenate([points for points, _ in parts]).astype(np.float32)
        near = (np.abs(cloud[:, :2]) < REACH_M).all(axis=1)
        found.append((cloud[near], np.concatenate([labels for _, labels in parts])[near]))
    return found


def confusion(scenario: str, seed: int, lidar: str | None, places: int) -> NDArray[np.float64]:
    """(5, 6) points of each true class that were taken for each of `NAMES`, the last column for none of them."""
    counts = np.zeros((len(NAMES), len(NAMES) + 1))
    for cloud, truth in submap_of(scenario, seed, lidar, places):
        found = classify(cloud)
        for k, names in enumerate(TRUE.values()):
            of_class = found[np.isin(truth, [CLASSES[name] for name in names])]
            row = [np.count_nonzero(of_class == number) for number in FOUND]
            counts[k] += [*row, len(of_class) - sum(row)]
    return counts


def scores(counts: NDArray[np.float64]) -> NDArray[np.float64]:
    """(5, 3) precision, recall and IoU of each class."""
    right, taken, there = np.diag(counts), counts[:, :-1].sum(0), counts.sum(1)
    return np.stack([right / np.maximum(taken, 1), right / there, right / (taken + there - right)], axis=1)
