"""Sixteen beams on open ground: `icp` beside its peers after a standing start, on the same compensated scans.

    python tests/benchmarks/sparse.py [--methods icp,kiss-icp] [--scenarios carpark] [--speeds 2,5] [--seeds 100,101]
        [--write docs/results.md]

A VLP-16 stands 2.5 s, then drives off. ATE over positions, first pose on the first true pose, no other alignment: what
slips at the start counts. A run is lost when that exceeds a twentieth of the path.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from itertools import product

import numpy as np
import tables
from numpy.typing import NDArray
from peers import PEERS, drive
from recorded import Case
from scores import origin

from lslam.simulation.scenarios import simulate

Floats = NDArray[np.float64]

STANDING_S, SCANS = 2.5, 120


def simulated(scenario: str, speed: float, seed: int) -> Case:
    line = simulate(
        scenario, seed=seed, lidar="vlp16", count=SCANS, speed=speed, start_speed=0.0, static_start=STANDING_S,
        motion_compensated=True,
    )  # fmt: skip
    return f"{scenario} {speed:g} {seed}", [line.scan(i).points for i in range(SCANS)], line.ground_truth.poses


def length(truth: Floats) -> float:
    return float(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum())


def grid(scenarios: list[str], speeds: list[float], seeds: list[int], methods: list[str]) -> list[list[str]]:
    """A row per scenario and speed: of each method median / worst, m, and how many runs are lost."""
    rows = []
    for scenario, speed in product(scenarios, speeds):
        found = defaultdict(list)
        for seed in seeds:
            name, scans, truth = simulated(scenario, speed, seed)
            for method in methods:
                poses, seconds = drive(method, scans)
                error = origin(poses, truth)
                found[method].append((error, error > 0.05 * length(truth)))
                print(f"{name:20} {method:12} {error:9.4f} {1e3 * np.median(seconds):6.1f} ms", flush=True)
        cells = [
            tables.spread((error for error, _ in found[method]), 3)
            + f", {sum(is_lost for _, is_lost in found[method])}"
            for method in methods
        ]
        rows.append([f"{scenario} {speed:g}", *cells])
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--methods", default="icp,kiss-icp,small-gicp,genz-icp")
    parser.add_argument("--scenarios", default="carpark,motorway,street")
    parser.add_argument("--speeds", default="2,5,12,30")
    tables.offer(parser)
    args = parser.parse_args()
    methods = args.methods.split(",")
    if set(methods) - set(PEERS):
        parser.error(f"--methods takes {', '.join(PEERS)}")
    speeds, seeds = [float(v) for v in args.speeds.split(",")], tables.numbers(args.seeds)
    rows = grid(args.scenarios.split(","), speeds, seeds, methods)
    caption = (
        f"A VLP-16 stands {STANDING_S} s and drives off, {SCANS} scans, {tables.seeds_named(seeds)}: ATE with the first pose on "
        "the first true pose, m, median / worst, and runs lost, a twentieth of their path off."
    )
    tables.table("sparse", caption, ["scenario, m/s", *methods], rows, args.write)


if __name__ == "__main__":
    main()
