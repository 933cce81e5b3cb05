"""Where the milliseconds of the merged map go: reading a scan, deskewing it, adding it to the voxels.

    python tests/benchmarks/merging.py SEQUENCE [--count 150] [--voxel 0.2]

One thread, at the true poses: nothing runs beside a stage, and scans overlap as they do in a run.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from lslam.core.errors import UsageError
from lslam.core.geometry.se3 import poses_at
from lslam.io.readers import open_sequence
from lslam.maps import merge
from lslam.odometry.inertial.constant_velocity import Course
from lslam.pipeline.map_pass import motion_within
from lslam.registration.preprocessing.deskew import deskew_points


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence")
    parser.add_argument("--count", type=int, default=150)
    parser.add_argument("--voxel", type=float, default=0.2)
    args = parser.parse_args()
    sequence = open_sequence(args.sequence)
    truth = sequence.ground_truth
    if truth is None:
        raise UsageError(f"{args.sequence} has no ground truth, at whose poses scans are merged")
    count = min(args.count, len(sequence))
    stamps = sequence.stamps_ns[:count]
    poses = poses_at(truth.stamps_ns, truth.poses, stamps)
    merge.warm_up()
    merger = merge.MapMerger(args.voxel)
    seconds = np.zeros((count, 3))
    points = np.zeros(count)
    for i in range(count):
        marks = [time.perf_counter()]
        scan = sequence.scan(i)
        marks.append(time.perf_counter())
        moved = deskew_points(scan.points, scan.times, motion_within(scan, Course(stamps, poses)))
        marks.append(time.perf_counter())
        merger.add(moved, poses[i], scan.intensity)
        marks.append(time.perf_counter())
        seconds[i], points[i] = np.diff(marks), len(scan)
    began = time.perf_counter()
    merged = merger.result()
    print(f"{count} scans of {np.median(points):.0f} points, {len(merged)} voxels of {args.voxel:g} m")
    for name, column in zip(("read", "deskew", "add"), seconds.T, strict=True):
        print(f"{name:8} {1e3 * np.median(column):7.2f} ms, p95 {1e3 * np.percentile(column, 95):.2f}")
    print(f"sorted in {time.perf_counter() - began:.2f} s")


if __name__ == "__main__":
    main()
