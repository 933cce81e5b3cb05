"""Recordings by the names of their folders, untwisted for all alike where they are distorted, with all rings and thinned ones."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.core.config import Config
from lslam.core.config.input import PreprocessConfig
from lslam.core.geometry.se3 import poses_at
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.core.types.sequence import Sequence
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.io.readers import open_sequence
from lslam.odometry import create_odometry
from lslam.odometry.frontend.point_times import with_point_times
from lslam.odometry.frontend.register_scans import estimate
from lslam.registration.preprocessing.deskew import deskew_points, knots_over
from lslam.registration.preprocessing.rings import decide_rings

Floats = NDArray[np.float64]
# Name, clouds, true poses (N, 4, 4).
Case = tuple[str, list[NDArray[np.float32]], Floats]

PLACES = {
    "KITTI raw 0005": Path("2011_09_26", "2011_09_26_drive_0005_sync"),
    "KITTI raw 0048": Path("2011_09_26", "2011_09_26_drive_0048_sync"),
    "MCD KTH day 06": Path("mcd_kth_day_06"),
}


# s from the stamp of a scan to the instant its true pose belongs to: KTH's is the end of the sweep.
TRUTH_AT_S = {"MCD KTH day 06": 0.1}


def untwisted(sequence: Sequence, at_s: float = 0.0) -> list[Scan]:
    """All scans, each with the motion of its sweep taken out along the trajectory of `icp`, so that all peers get the same.

    Points without a time field are timed by their order, as `lslam run` does. They are seen from where the sensor was `at_s`,
    s, after the stamp.
    """
    sequence = with_point_times(sequence, PreprocessConfig())
    scans = [sequence.scan(i) for i in range(len(sequence))]
    if all(scan.times is None for scan in scans):
        return scans
    found = estimate(sequence, create_odometry(Config()), threads=1)
    stamps, poses = sequence.stamps_ns, np.stack([result.T_world_lidar for result in found])
    clean = []
    for scan in scans:
        assert scan.times is not None
        late = replace(scan, times=scan.times - np.float32(at_s))
        knots = knots_over(late.span)
        at_ns = scan.stamp_ns + np.round(1e9 * (knots + at_s)).astype(np.int64)
        points = deskew_points(scan.points, late.times, MotionPrior(knots, poses_at(stamps, poses, at_ns)))
        clean.append(replace(scan, points=points, times=None))
    return clean


def thinned(folder: Path) -> Iterator[Case]:
    """Drives 0005 and 0048 and KTH with all of their rings, every second and every fourth."""
    for name, place in PLACES.items():
        path = folder / place
        if not path.is_dir():
            continue
        sequence = open_sequence(path)
        rule, known = decide_rings([sequence.scan(i) for i in range(3)]), sequence.ground_truth
        rings = [rule.rings_of(sequence.scan(i)) for i in range(len(sequence))]
        scans, reference = untwisted(sequence, TRUTH_AT_S.get(name, 0.0)), path / "reference_lidar.tum"
        truth = read_trajectory(reference) if reference.is_file() else known
        assert truth is not None
        for step in (1, 2, 4):
            yield (
                f"{name}, {64 // step} rings",
                [_thin(s, r, step) for s, r in zip(scans, rings, strict=True)],
                truth.poses,
            )


def _thin(scan: Scan, rings: NDArray[np.uint16], step: int) -> NDArray[np.float32]:
    return replace(scan, intensity=None, times=None, rings=None).points[rings % step == step // 2]
