"""Every method on simulated drives: ATE se3, scans that a recovery policy or the motion prior posed, runs that were doubted.

    python tests/benchmarks/methods.py [--scenarios urban,motorway:vlp16] [--methods icp,loam+recovery.fallback=all-points]
        [--seeds 100-104] [--scans 60] [--write docs/results.md]

Each method in its default, but for the keys that follow its name. Sensors are the scenarios' own, or follow their names.
"""

from __future__ import annotations

import argparse
import logging
from collections import Counter

import tables
from traced import Traced, run_on, traced

from lslam.core.errors import LslamError

METHODS = (
    "icp,icp-point,gicp,vgicp,ndt,icp-svd,dlo,loam-odom,loam,loam+recovery.fallback=all-points,floam,lego-loam,"
    "kiss-icp,small-gicp"
)


def judged(drive: Traced, method: str) -> tuple[float, int, str]:
    """ATE se3, m, scans that it did not pose, and how the run ended."""
    name, *settings = method.split("+")
    try:
        outcome = run_on(drive, f"odometry.method={name}", "map.write=false", *settings)
    except LslamError:
        return float("inf"), 0, "failed"
    assert outcome.evaluation is not None
    ate = outcome.evaluation.ate["se3"].translation
    assert ate is not None
    others = sum(r.poser(name) != name and not r.repeats_pose for r in outcome.record.results)
    return ate.rmse, others, str(outcome.record.manifest["status"])


def cell(found: list[tuple[float, int, str]]) -> str:
    text, ends = tables.spread([ate for ate, _, _ in found], 3), Counter(end for _, _, end in found)
    others = sum(count for _, count, _ in found)
    notes = [f"{others} scans"] * bool(others) + [f"{ends[end]} {end}" for end in ("degraded", "failed") if ends[end]]
    return f"{text} ({', '.join(notes)})" if notes else text


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenarios", default="urban,street,carpark,motorway,motorway:vlp16")
    parser.add_argument("--methods", default=METHODS)
    parser.add_argument("--scans", type=int, default=60)
    tables.offer(parser)
    args = parser.parse_args()
    logging.getLogger("lslam").setLevel(logging.CRITICAL)
    scenarios, methods, seeds = args.scenarios.split(","), args.methods.split(","), tables.numbers(args.seeds)
    found: dict[tuple[str, str], list[tuple[float, int, str]]] = {}
    sensors = {}
    for scenario in scenarios:
        for seed in seeds:
            name, _, lidar = scenario.partition(":")
            drive = traced(name, seed, count=args.scans, lidar=lidar or None)
            sensors[scenario] = drive.lidar.name
            for method in methods:
                one = judged(drive, method)
                found.setdefault((method, scenario), []).append(one)
                print(f"{scenario:12} {seed:4d} {method:36} {one[0]:9.4f} {one[1]:4d} {one[2]}", flush=True)
    caption = (
        f"ATE se3, m, median / worst of {tables.seeds_named(seeds)}, {args.scans} scans each. In brackets: scans of all "
        "runs that a recovery policy, all points or the motion prior posed in place of the method, and runs that said "
        "`degraded`."
    )
    header = ["method", *(f"{scenario.partition(':')[0]}, {sensors[scenario]}" for scenario in scenarios)]
    rows = [[method, *(cell(found[method, scenario]) for scenario in scenarios)] for method in methods]
    tables.table("methods", caption, header, rows, args.write)


if __name__ == "__main__":
    main()
