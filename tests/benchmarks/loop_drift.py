"""What loops make of odometry that drifts: ATE before and after the pose graph, for every kind of drift.

    python tests/benchmarks/loop_drift.py [--scenario closed] [--seeds 100-104] [--drift 1.0,0.5] [--write docs/results.md]

The first pose is laid on the first true pose, so that what drift does to the whole flight counts.
"""

from __future__ import annotations

import argparse
import logging

import tables
from gnss import KINDS
from traced import Traced, run_on, traced

from lslam.core.types.trajectory import Trajectory
from lslam.evaluation.evaluate import evaluate


def judged(drive: Traced, settings: list[str]) -> tuple[float, float, int]:
    """ATE origin, m, of odometry and of the graph, and the loops closed."""
    record = run_on(drive, "map.write=false", *settings).record
    before = record.odometry if record.odometry is not None else record.trajectory
    errors = []
    for trajectory in (before, record.trajectory):
        ate = evaluate(Trajectory(trajectory.stamps_ns, trajectory.poses), drive.ground_truth).ate["origin"].translation
        assert ate is not None
        errors.append(ate.rmse)
    return errors[0], errors[1], sum(c.verdict == "accepted" for c in record.loops)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="closed")
    parser.add_argument("--drift", default="1.0,0.5", help="PERCENT,DEG_PER_100M")
    tables.offer(parser)
    args = parser.parse_args()
    logging.getLogger("lslam").setLevel(logging.CRITICAL)
    percent, deg = args.drift.split(",")
    seeds = tables.numbers(args.seeds)
    found: dict[str, list[tuple[float, float, int]]] = {}
    length, scans = 0.0, 0
    for seed in seeds:
        drive = traced(args.scenario, seed)
        length, scans = drive.ground_truth.path_lengths[-1], len(drive)
        for kind, words in KINDS.items():
            drift = [f"debug.drift_percent={percent}", f"debug.drift_deg_per_100m={deg}", f"debug.drift_seed={seed}"]
            found.setdefault(kind, []).append(judged(drive, [*words, *drift]))
            print(f"{kind:12} {seed:4d} " + " ".join(f"{v:9.4f}" for v in found[kind][-1]), flush=True)
    caption = (
        f"ATE origin (first pose on the first true pose), m, of `icp` on `{args.scenario}` ({scans} scans, {length:.0f} m), "
        f"median / worst of {tables.seeds_named(seeds)}; {percent} % and {deg} deg/100 m put into odometry: rates that last, "
        "that are drawn anew after 20 m, or at every step."
    )
    rows = [
        [kind, tables.spread([b for b, _, _ in rows], 3), tables.spread([a for _, a, _ in rows], 3),
         f"{min(n for _, _, n in rows)} to {max(n for _, _, n in rows)}"]
        for kind, rows in found.items()
    ]  # fmt: skip
    tables.table("loop-drift", caption, ["drift", "odometry", "after the graph", "loops closed"], rows, args.write)


if __name__ == "__main__":
    main()
