"""Sixteen beams on open ground: `icp` beside its peers after a standing start, on the same compensated scans.

    python tests/benchmarks/sparse.py [--methods icp,kiss-icp] [--scenarios carpark] [--speeds 2,5] [--seeds 100,101]
    python tests/benchmarks/sparse.py --recordings FOLDER      real scans thinned to 32 and 16 rings instead

A VLP-16 stands 2.5 s, then drives off. ATE over positions, first pose on the first true pose, no other alignment: what
slips at the start counts. A run is lost when that exceeds a twentieth of the path. Recordings are looked up by the names of
../shared/data and untwisted; rings are then every second or fourth of the sensor's.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from accuracy import Case, ate, rotation_rpe, untwisted
from numpy.typing import NDArray
from peers import PEERS, drive

from lslam.formats.trajectory_files import read_trajectory
from lslam.geometry import se3
from lslam.preprocessing.rings import decide_rings
from lslam.readers import open_sequence
from lslam.simulation.scenarios import simulate
from lslam.types.scan import Scan

Floats = NDArray[np.float64]

STANDING_S, SCANS = 2.5, 120


def simulated(scenario: str, speed: float, seed: int) -> Case:
    line = simulate(
        scenario, seed=seed, lidar="vlp16", count=SCANS, speed=speed, start_speed=0.0, static_start=STANDING_S,
        motion_compensated=True,
    )  # fmt: skip
    return f"{scenario} {speed:g} {seed}", [line.scan(i).points for i in range(SCANS)], line.ground_truth.poses


def thinned(folder: Path) -> Iterator[Case]:
    """Drive 0005 and KTH with all of their rings, every second and every fourth."""
    for name, path in (
        ("0005", folder / "2011_09_26" / "2011_09_26_drive_0005_sync"), ("KTH", folder / "mcd_kth_day_06"),
    ):  # fmt: skip
        if not path.is_dir():
            continue
        sequence = open_sequence(path)
        rule, known = decide_rings([sequence.scan(i) for i in range(3)]), sequence.ground_truth
        rings = [rule.rings_of(sequence.scan(i)) for i in range(len(sequence))]
        scans = untwisted(sequence)
        poses = read_trajectory(path / "reference_lidar.tum").poses if known is None or name == "0005" else known.poses
        for step in (1, 2, 4):
            yield f"{name} {64 // step} rings", [_thin(s, r, step) for s, r in zip(scans, rings, strict=True)], poses


def _thin(scan: Scan, rings: NDArray[np.uint16], step: int) -> NDArray[np.float32]:
    return replace(scan, intensity=None, times=None, rings=None).points[rings % step == step // 2]


def origin(estimate: Floats, truth: Floats) -> float:
    """ATE, m, rmse, with the first pose on the first true pose."""
    e, t = (se3.relative(poses[0], poses)[:, :3, 3] for poses in (estimate, truth))
    return float(np.sqrt(np.mean(np.sum((e - t) ** 2, axis=1))))


def length(truth: Floats) -> float:
    return float(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum())


def grid(scenarios: list[str], speeds: list[float], seeds: list[int], methods: list[str]) -> None:
    print(f"{'scenario':10} {'m/s':>4} {'method':12} {'median m':>9} {'worst m':>9} {'lost':>5} {'ms':>6}   ATE origin")
    for scenario in scenarios:
        for speed in speeds:
            found, took = defaultdict(list), defaultdict(list)
            for seed in seeds:
                _, scans, truth = simulated(scenario, speed, seed)
                for method in methods:
                    poses, seconds = drive(method, scans)
                    found[method].append((origin(poses, truth), length(truth)))
                    took[method].append(1e3 * float(np.median(seconds)))
            for method in methods:
                errors = np.array([error for error, _ in found[method]])
                lost = sum(error > 0.05 * metres for error, metres in found[method])
                print(
                    f"{scenario:10} {speed:4g} {method:12} {np.median(errors):9.4f} {errors.max():9.4f} "
                    f"{lost:2d}/{len(errors):d} {np.median(took[method]):6.1f}",
                    flush=True,
                )


def recordings(folder: Path, methods: list[str]) -> None:
    print(f"{'recording':14} {'method':12} {'rotation over 10 m, deg':>23} {'ATE se3, m':>11} {'ms':>6}")
    for name, scans, truth in thinned(folder):
        for method in methods:
            poses, seconds = drive(method, scans)
            # Positions of drive 0005's reference wander by decimetres: its rotations are what is judged.
            rotation, error = rotation_rpe(poses, truth), ate(poses, truth)
            print(f"{name:14} {method:12} {rotation:23.3f} {error:11.4f} {1e3 * np.median(seconds):6.1f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--methods", default=",".join(name for name in PEERS if name != "small-vgicp"))
    parser.add_argument("--scenarios", default="carpark,motorway,street")
    parser.add_argument("--speeds", default="2,5,12,30")
    parser.add_argument("--seeds", default="100,101,102,103,104")
    parser.add_argument("--recordings", type=Path)
    args = parser.parse_args()
    methods = args.methods.split(",")
    if set(methods) - set(PEERS):
        parser.error(f"--methods takes {', '.join(PEERS)}")
    if args.recordings is not None:
        recordings(args.recordings, methods)
        return
    speeds, seeds = [float(v) for v in args.speeds.split(",")], [int(v) for v in args.seeds.split(",")]
    grid(args.scenarios.split(","), speeds, seeds, methods)


if __name__ == "__main__":
    main()
