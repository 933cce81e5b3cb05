"""Long drives without loops: what odometry is off by at the end, which tables of sixty scans do not show.

    python tests/benchmarks/long_drives.py [--scenarios urban/hdl64,motorway/vlp16] [--methods icp,loam,kiss-icp] [--scans 700]
        [--seeds 301-305] [--write docs/results.md]

Scans are compensated, so that deskewing has no part in it.
"""

from __future__ import annotations

import argparse
import logging

import numpy as np
import tables
from scores import ate, origin
from traced import run_on, traced

from lslam.core.errors import LslamError
from lslam.core.geometry import se3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenarios", default="urban/hdl64")
    parser.add_argument("--methods", default="icp,loam,kiss-icp")
    parser.add_argument("--scans", type=int, default=700)
    tables.offer(parser, "301-305")
    args = parser.parse_args()
    logging.getLogger("lslam").setLevel(logging.CRITICAL)
    seeds, methods, rows = tables.numbers(args.seeds), args.methods.split(","), []
    for drive in args.scenarios.split(","):
        scenario, lidar = drive.split("/")
        found: dict[str, list[tuple[float, float, float]]] = {method: [] for method in methods}
        for seed in seeds:
            line = traced(scenario, seed, lidar=lidar, count=args.scans, motion_compensated=True)
            truth = line.ground_truth.poses
            path = float(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum())
            for method in methods:
                try:
                    outcome = run_on(line, f"odometry.method={method}", "loops.use=false", "map.write=false")
                except LslamError:
                    found[method].append((np.inf,) * 3)
                    continue
                poses = outcome.record.trajectory.poses
                end, goal = (se3.relative(p[0], p[-1])[:3, 3] for p in (poses, truth))
                off = 100 * float(np.linalg.norm(end - goal)) / path
                found[method].append((ate(poses, truth), origin(poses, truth), off))
                print(f"{drive} {seed} {path:.0f} m {method}", *(f"{v:.4f}" for v in found[method][-1]), flush=True)
        for method in methods:
            rows.append([drive, method, *(tables.spread(column, 3) for column in zip(*found[method], strict=True))])
    caption = (
        f"{args.scans} scans, {tables.seeds_named(seeds)}, median / worst: ATE aligned (se3), ATE with the first pose on the "
        "first true pose, m, and the distance of the last pose from the true one in % of the path."
    )
    tables.table("long-drives", caption, ["drive", "method", "ATE se3", "ATE origin", "end, %"], rows, args.write)


if __name__ == "__main__":
    main()
