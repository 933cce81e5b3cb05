"""Rain, snow and dust: every method on a simulated street with drops in the air, `icp` also with them left in.

    python tests/benchmarks/air.py [--scenario urban] [--share 0.1] [--seeds 100-104] [--scans 60] [--write docs/results.md]

Drops are drawn anew for every scan, evenly in the air about the sensor, and take the place of as many returns.
"""

from __future__ import annotations

import argparse
import logging
from dataclasses import replace

import numpy as np
import tables
from methods import judged
from traced import Traced, traced

from lslam.core.types.scan import Scan

METHODS = "icp,icp+preprocess.least_line=0,kiss-icp,small-gicp"
# m, to either side, ahead and behind, and above the ground, which is so far below the sensor.
WIDE, HIGH, GROUND = 30.0, 10.0, -1.7


class Snow(Traced):
    """A drive with a share of each scan's returns replaced by drops."""

    def __init__(self, drive: Traced, share: float, seed: int) -> None:
        self._drive, self._scans = drive, [_snowed(s, share, seed) for s in drive._scans]


def _snowed(scan: Scan, share: float, seed: int) -> Scan:
    rng = np.random.default_rng([seed, scan.index])
    points, hit = scan.points.copy(), rng.random(len(scan)) < share
    points[hit] = rng.uniform((-WIDE, -WIDE, GROUND), (WIDE, WIDE, GROUND + HIGH), (hit.sum(), 3)).astype(np.float32)
    return replace(scan, points=points)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="urban")
    parser.add_argument("--share", type=float, default=0.1)
    parser.add_argument("--methods", default=METHODS)
    parser.add_argument("--scans", type=int, default=60)
    tables.offer(parser)
    args = parser.parse_args()
    logging.getLogger("lslam").setLevel(logging.CRITICAL)
    methods, seeds = args.methods.split(","), tables.numbers(args.seeds)
    found: dict[str, list[list[float]]] = {method: [[], []] for method in methods}
    for seed in seeds:
        clear = traced(args.scenario, seed, count=args.scans)
        for method in methods:
            for k, drive in enumerate((clear, Snow(clear, args.share, seed))):
                found[method][k].append(judged(drive, method)[0])
            print(f"{seed} {method:32} " + " ".join(f"{errors[-1]:9.4f}" for errors in found[method]), flush=True)
    caption = (
        f"ATE se3, m, median / worst of {tables.seeds_named(seeds)}, `{args.scenario}`, {args.scans} scans by its own sensor; "
        f"drops are {100 * args.share:.0f} % of the returns, within {WIDE:.0f} m of air on all sides."
    )
    rows = [[method, *(tables.spread(errors, 3) for errors in found[method])] for method in methods]
    tables.table("air", caption, ["method", "clear", "with drops"], rows, args.write)


if __name__ == "__main__":
    main()
