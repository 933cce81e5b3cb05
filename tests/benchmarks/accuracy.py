"""Accuracy of `icp` with its default configuration beside its peers: simulated streets, starts at unknown speed, recordings.

    python tests/benchmarks/accuracy.py [FOLDER_WITH_UNPACKED_RECORDINGS] [--peers icp,kiss-icp]

Recordings are looked up by the names of ../shared/data, and untwisted for all alike where they are distorted. Rotation
RPE: every scan with the first one at least 10 m further along the reference. A start is lost when the
first registered scan is off by 0.1 m or more.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from peers import PEERS, drive

from lslam.config import Config
from lslam.formats.trajectory_files import read_trajectory
from lslam.geometry import se3, so3, umeyama
from lslam.geometry.interpolate import poses_at
from lslam.odometry import create_odometry
from lslam.pipeline.front_end import estimate
from lslam.preprocessing.deskew import deskew_points, knots_over
from lslam.readers import open_sequence
from lslam.simulation.scenarios import simulate
from lslam.types.motion_prior import MotionPrior
from lslam.types.scan import Scan
from lslam.types.sequence import Sequence

Floats = NDArray[np.float64]
Case = tuple[str, list[NDArray[np.float32]], Floats]


def ate(estimate: Floats, truth: Floats) -> float:
    p, q = estimate[:, :3, 3], truth[:, :3, 3]
    T, _, _ = umeyama.align(p, q)
    return float(np.sqrt(np.mean(np.sum((se3.apply(T, p) - q) ** 2, axis=1))))


def rotation_rpe(estimate: Floats, truth: Floats, metres: float = 10.0) -> float:
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1))])
    last = np.searchsorted(along, along + metres)
    first = np.flatnonzero(last < len(along))
    if not len(first):
        return float("nan")
    last = last[first]
    e = se3.relative(se3.relative(truth[first], truth[last]), se3.relative(estimate[first], estimate[last]))
    return float(np.degrees(np.sqrt(np.mean(so3.angle(e[:, :3, :3]) ** 2))))


def yaw_at_end(estimate: Floats, truth: Floats) -> float:
    return float(np.degrees(so3.euler_rpy(se3.relative(truth[-1], estimate[-1])[:3, :3])[2]))


def simulated(scenario: str, lidars: tuple[str, ...], seeds: tuple[int, ...], **given: float) -> Iterator[Case]:
    for lidar in lidars:
        for seed in seeds:
            line = simulate(scenario, seed=seed, lidar=lidar, motion_compensated=True, **given)  # type: ignore[arg-type]
            scans = [line.scan(i).points for i in range(len(line))]
            yield f"{scenario} {seed} {lidar}", scans, _from_first(line.ground_truth.poses)


def recordings(folder: Path) -> Iterator[Case]:
    for drive_number in ("0005", "0048"):
        path = folder / "2011_09_26" / f"2011_09_26_drive_{drive_number}_sync"
        if path.is_dir():
            truth = read_trajectory(path / "reference_lidar.tum").poses
            scans = [scan.points for scan in untwisted(open_sequence(path))]
            yield f"kitti_raw_{drive_number}", scans, _from_first(truth)
    path = folder / "mcd_kth_day_06"
    if path.is_dir():
        sequence = open_sequence(path)
        assert sequence.ground_truth is not None
        scans = [scan.points for scan in untwisted(sequence)]
        yield "mcd_kth_day_06", scans, _from_first(sequence.ground_truth.poses)


def untwisted(sequence: Sequence) -> list[Scan]:
    """All scans, each with the motion of its sweep taken out along the trajectory of `icp`, so that all peers get the same."""
    scans = [sequence.scan(i) for i in range(len(sequence))]
    if all(scan.times is None for scan in scans):
        return scans
    found = estimate(sequence, create_odometry(Config()), threads=1)
    stamps, poses = sequence.stamps_ns, np.stack([result.T_world_lidar for result in found])
    clean = []
    for scan in scans:
        knots = knots_over(scan.span)
        prior = MotionPrior(knots, poses_at(stamps, poses, scan.stamp_ns + np.round(1e9 * knots).astype(np.int64)))
        clean.append(replace(scan, points=deskew_points(scan.points, scan.times, prior), times=None))
    return clean


def _from_first(poses: Floats) -> Floats:
    return se3.relative(poses[0], poses)


def table(cases: list[Case], methods: list[str]) -> None:
    print(
        f"{'sequence':20} {'method':12} {'ATE m':>8} {'rot RPE 10 m deg':>17} {'yaw at end deg':>15} {'median ms':>10} {'p95':>6}"
    )
    for name, scans, truth in cases:
        for method in methods:
            poses, seconds = drive(method, scans)
            ms = 1e3 * np.array([np.median(seconds), np.percentile(seconds, 95)])
            print(
                f"{name:20} {method:12} {ate(poses, truth):8.4f} {rotation_rpe(poses, truth):17.3f} "
                f"{yaw_at_end(poses, truth):15.3f} {ms[0]:10.1f} {ms[1]:6.1f}"
            )


def starts(cases: list[Case], methods: list[str]) -> None:
    print(
        f"\n{'start at unknown speed':24} {'m/scan':>7}  "
        + "  ".join(f"{m:>11}" for m in methods)
        + "   (error of the first scan, m)"
    )
    lost = dict.fromkeys(methods, 0)
    for name, scans, truth in cases:
        for stride in (1, 2, 3):
            some, true = scans[: 4 * stride : stride], truth[: 4 * stride : stride]
            errors = {m: float(np.linalg.norm(drive(m, some)[0][1, :3, 3] - true[1, :3, 3])) for m in methods}
            for m, error in errors.items():
                lost[m] += error >= 0.1
            step = np.linalg.norm(true[1, :3, 3])
            print(f"{name:20} x{stride}  {step:7.2f}  " + "  ".join(f"{errors[m]:11.3f}" for m in methods))
    print(f"{'lost':24} {'':7}  " + "  ".join(f"{lost[m]:11d}" for m in methods) + f"   of {3 * len(cases)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="?", type=Path)
    parser.add_argument("--peers", default=",".join(PEERS))
    args = parser.parse_args()
    methods = args.peers.split(",")
    real = list(recordings(args.recordings)) if args.recordings else []
    streets = simulated("street", ("hdl64", "vlp16"), (0, 1, 2), count=120, speed=10.0)
    # At 30 m/s from the first scan on.
    motorways = simulated("motorway", ("vlp16", "os1-16"), (0, 1), count=30)
    table([*real, *streets, *motorways], methods)
    fast = simulated("street", ("hdl64",), (0, 1, 2), count=12, speed=8.3, start_speed=8.3)
    starts([*((n, s[:12], t[:12]) for n, s, t in real), *fast], methods)


if __name__ == "__main__":
    main()
