"""`--refine` beside the same run without it: error, thickness of planes that were kept out, and time.

    python tests/benchmarks/refinement.py [--seeds 321-325] [--recordings FOLDER] [--write docs/results.md]

`+ drift` is odometry that was made to drift by 1 % and 1 deg/100 m, steadily, without loops; fixes err by 0.3 m on their own and
by 0.8 m that wanders. Recordings lie in FOLDER under the names that `recorded.py` knows.
"""

from __future__ import annotations

import argparse
import logging
from pathlib import Path

import numpy as np
import recorded
import tables
from traced import Traced, run_on, traced

from lslam.io.readers import open_sequence
from lslam.simulation.sensors import GnssModel

DRIFT = ("debug.drift=true", "debug.drift_percent=1", "debug.drift_deg_per_100m=1", "loops.use=false")
# Scenario, sensor, scans, whether the sweeps are distorted, and settings.
DRIVES: dict[str, tuple[str, str, int, bool, tuple[str, ...]]] = {
    "car park": ("carpark", "vlp16", 300, True, ()),
    "urban-hard": ("urban-hard", "vlp16", 200, True, ()),
    "residential": ("residential", "vlp16", 300, True, ()),
    "residential + drift": ("residential", "vlp16", 300, True, DRIFT),
    "urban + drift": ("urban", "hdl64", 200, False, DRIFT),
    "residential + drift + fixes": ("residential", "vlp16", 300, True, (*DRIFT, "gnss.mode=graph")),
    "corridor": ("corridor", "vlp16", 200, True, ()),
    "stairs": ("stairs", "vlp16", 200, True, ()),
    "room": ("room", "vlp16", 150, True, ()),
    "walk": ("walk", "vlp16", 200, True, ()),
}
Row = tuple[float, float, float, float, bool]


def compared(drive: Traced, settings: tuple[str, ...]) -> Row:
    """ATE without and with it, m; share by which planes are thinner, %, and of the run's time, %; whether it was taken."""
    before, after = (run_on(drive, *settings, "map.write=false", f"graph.refine={r}") for r in ("false", "true"))
    facts = after.record.manifest["refinement"]
    timings = after.record.manifest["timings"]
    share = 100 * timings["refine_s"] / timings["odometry_s"]
    errors = [np.inf if o.errors is None else float(np.sqrt(np.mean(o.errors**2))) for o in (before, after)]
    return errors[0], errors[1], facts.get("thinner_percent", 0.0), share, facts["is_taken"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", default=",".join(DRIVES))
    parser.add_argument("--recordings", type=Path)
    tables.offer(parser, "321-325")
    args = parser.parse_args()
    logging.getLogger("lslam").setLevel(logging.CRITICAL)
    seeds, rows = tables.numbers(args.seeds), []
    found: dict[str, list[Row]] = {}
    for name in filter(None, args.drives.split(",")):
        scenario, lidar, count, is_distorted, settings = DRIVES[name]
        for seed in seeds:
            receiver = GnssModel() if "gnss.mode=graph" in settings else None
            drive = traced(scenario, seed, lidar=lidar, count=count, motion_compensated=not is_distorted, gnss=receiver)
            found.setdefault(name, []).append(compared(drive, settings))
            print(name, seed, *found[name][-1], flush=True)
    for name, place in recorded.PLACES.items() if args.recordings else ():
        found[name] = [compared(Traced(open_sequence(args.recordings / place)), ())]
        print(name, *found[name][-1], flush=True)
    for name, runs in found.items():
        before, after, thinner, share, taken = zip(*runs, strict=True)
        ratio = [b / a for a, b in zip(before, after, strict=True)]
        rows.append([
            name, tables.spread(before, 4), tables.spread(after, 4), tables.spread(ratio), f"{np.median(thinner):.0f}",
            f"{sum(taken)} of {len(taken)}", f"{np.median(share):.0f}",
        ])  # fmt: skip
    caption = (
        f"`icp`, {tables.seeds_named(seeds)}, median / worst, recordings once: ATE aligned (se3), m, without and with "
        "`--refine`, their ratio, by how much planes of the points kept out are thinner, %, in how many runs it was taken, and "
        "its time as % of odometry's, beside other work."
    )
    heads = ["drive", "ATE", "ATE refined", "ratio", "thinner", "taken", "time"]
    tables.table("refinement", caption, heads, rows, args.write)


if __name__ == "__main__":
    main()
