"""`icp` with its default configuration beside its peers: recordings, simulated streets and motorways, starts at unknown speed.

    python tests/benchmarks/accuracy.py [FOLDER_WITH_UNPACKED_RECORDINGS] [--peers icp,kiss-icp] [--seeds 100-104]
        [--write docs/results.md]

Recordings are looked up by their names in the folder given, and untwisted for all alike where they are distorted. Rotation
RPE: every scan with the first one at least 10 m further along the reference. A start is lost when the
first registered scan is off by 0.1 m or more.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import tables
from peers import PEERS, drive
from recorded import Case, thinned
from scores import ate, rotation_rpe

from lslam.core.geometry import se3
from lslam.simulation.scenarios import simulate

PEERS_SHOWN = ("icp", "kiss-icp", "small-gicp")
# ATE se3, m; rotation over 10 m, deg.
Score = tuple[float, float]
Scores = list[dict[str, Score]]


def simulated(scenario: str, lidar: str, seeds: Iterable[int], **given: float) -> Iterator[Case]:
    for seed in seeds:
        line = simulate(scenario, seed=seed, lidar=lidar, motion_compensated=True, **given)  # type: ignore[arg-type]
        poses = line.ground_truth.poses
        yield (
            f"{scenario} {seed} {lidar}",
            [line.scan(i).points for i in range(len(line))],
            se3.relative(poses[0], poses),
        )


def scored(case: Case, methods: list[str]) -> dict[str, Score]:
    name, scans, truth = case
    found = {}
    for method in methods:
        poses, _ = drive(method, scans)
        found[method] = ate(poses, truth), rotation_rpe(poses, truth)
        print(f"{name:26} {method:12} " + " ".join(f"{v:9.4f}" for v in found[method]), flush=True)
    return found


def lost_starts(case: Case, methods: list[str]) -> dict[str, Score]:
    """1 in the first place for every first step, at each of three speeds, that is off by 0.1 m."""
    name, scans, truth = case
    lost = dict.fromkeys(methods, 0)
    for stride in (1, 2, 3):
        some, true = scans[: 4 * stride : stride], se3.relative(truth[0], truth)[: 4 * stride : stride]
        errors = {m: float(np.linalg.norm(drive(m, some)[0][1, :3, 3] - true[1, :3, 3])) for m in methods}
        for method, error in errors.items():
            lost[method] += error >= 0.1
        step = np.linalg.norm(true[1, :3, 3])
        print(f"start of {name:17} {step:5.2f} m  " + "  ".join(f"{errors[m]:9.3f}" for m in methods), flush=True)
    return {method: (float(count), 0.0) for method, count in lost.items()}


def cells(found: Scores, methods: list[str], part: int, digits: int) -> list[str]:
    return [tables.spread((one[method][part] for one in found), digits) for method in methods]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="?", type=Path)
    parser.add_argument("--peers", default=",".join(PEERS_SHOWN), help=f"of {', '.join(PEERS)}")
    tables.offer(parser)
    args = parser.parse_args()
    methods, seeds = args.peers.split(","), tables.numbers(args.seeds)
    rows: list[list[str]] = []
    starts: Scores = []
    recorded: dict[str, Scores] = {}
    for case in thinned(args.recordings) if args.recordings else ():
        name = case[0].partition(",")[0]
        if name not in recorded:
            starts.append(lost_starts(case, methods))
        recorded.setdefault(name, []).append(scored(case, methods))
    for name, found in recorded.items():
        # Positions of OXTS wander by decimetres: its rotations are what is judged.
        part, metric = (1, "rotation over 10 m, deg") if name.startswith("KITTI") else (0, "ATE se3, m")
        values = ["; ".join(f"{one[method][part]:.3f}" for one in found) for method in methods]
        rows.append([f"{name}, 64; 32; 16 rings", metric, *values])
    for scenario, lidar, words in (
        ("street", "hdl64", {"count": 120, "speed": 10.0}),
        ("street", "vlp16", {"count": 120, "speed": 10.0}),
        ("motorway", "vlp16", {"count": 30}),
        ("motorway", "os1-16", {"count": 30}),
    ):
        found = [scored(case, methods) for case in simulated(scenario, lidar, seeds, **words)]
        # A motorway is driven at 30 m/s from the first scan on.
        name = f"simulated {scenario}, {lidar}" + (", 30 m/s at once" if scenario == "motorway" else "")
        rows.append([name, "ATE se3, m", *cells(found, methods, 0, 4)])
    fast = simulated("street", "hdl64", seeds, count=12, speed=8.3, start_speed=8.3)
    starts += [lost_starts(case, methods) for case in fast]
    counts = [f"{sum(one[method][0] for one in starts):.0f}" for method in methods]
    rows.append([f"{3 * len(starts)} starts, speed unknown, to 2.5 m per scan", "lost", *counts])
    caption = (
        f"Simulated drives: median / worst of {tables.seeds_named(seeds)}, 120 scans (motorway 30). ATE: rotation and "
        "translation aligned over positions. Rotation: each scan with the first one at least 10 m on along the reference, rmse."
    )
    tables.table("accuracy", caption, ["scans", "metric", *methods], rows, args.write)


if __name__ == "__main__":
    main()
