"""What satellite fixes bring to odometry that drifts, without loops.

    python tests/benchmarks/gnss.py [--scenario small-eight] [--seeds 100,101,102,103,104] [--drift 1.0,0.5] [--kinds lasting]
        [--write docs/results.md]

A fix a second errs by .5 m on its own and by .8 m that wanders over 100 s. Horizontal error on the Earth, m, rmse, of odometry
laid on the fixes as a whole, of fixes alone, smoothed by a parabola over so many that the error is least, and of the graph;
then the same of odometry and graph where their own best fit to the truth is taken (shape).
"""

from __future__ import annotations

import argparse
import logging

import numpy as np
import tables
from numpy.typing import NDArray
from scipy.signal import savgol_filter
from traced import Traced, run_on, traced

from lslam.core.geometry import geodesy, se3
from lslam.core.geometry.se3 import umeyama
from lslam.simulation.sensors import ORIGIN, GnssModel

Floats = NDArray[np.float64]

KINDS = {
    "none": ("debug.drift=false",),
    "lasting": ("debug.drift=true",),
    "wandering": ("debug.drift=true", "debug.drift_memory=20"),
    "random-walk": ("debug.drift=true", "debug.drift_kind=random-walk"),
}
MODEL = GnssModel(rate_hz=1.0, white=0.5, slow=0.8, memory=100.0)
WINDOWS = (5, 7, 9, 13, 17, 23)


def horizontal(found: Floats, real: Floats) -> float:
    return float(np.sqrt(((found - real)[:, :2] ** 2).sum(axis=1).mean()))


def judged(drive: Traced, settings: list[str], mode: str) -> tuple[float, float]:
    """Error on the Earth, and of the shape."""
    outcome = run_on(drive, *settings, f"gnss.mode={mode}", "loops.use=false", "map.write=false")
    place, poses = outcome.record.georeference, outcome.record.trajectory.poses
    assert place is not None
    assert drive.ground_truth is not None
    real = (drive.T_city_world @ drive.ground_truth.poses)[:, :3, 3]
    there = poses if place.method == "graph" else place.T_enu_world @ poses
    found = geodesy.to_local(geodesy.from_local(there[:, :3, 3], place.origin), ORIGIN)
    T, _, _ = umeyama(found, real)
    return horizontal(found, real), horizontal(se3.apply(T, found), real)


def smoothed(drive: Traced) -> float:
    """Of the fixes alone."""
    assert drive.gnss is not None
    found = geodesy.to_local(drive.gnss.lat_lon_alt, ORIGIN)
    assert drive.readings.gnss is not None
    real = drive.readings.gnss.antenna
    return min(horizontal(savgol_filter(found, n, 2, axis=0), real) for n in WINDOWS)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="small-eight")
    parser.add_argument("--drift", default="1.0,0.5", help="PERCENT,DEG_PER_100M")
    parser.add_argument("--kinds", default=",".join(KINDS))
    tables.offer(parser)
    args = parser.parse_args()
    logging.getLogger("lslam").setLevel(logging.ERROR)
    percent, deg = args.drift.split(",")
    columns = ("odometry", "fixes", "graph", "odometry's shape", "graph's")
    print(f"{'drift':12} {'seed':>5} " + " ".join(f"{name:>16}" for name in columns))
    found: dict[str, list[list[float]]] = {}
    seeds, scans, length = tables.numbers(args.seeds), 0, 0.0
    for seed in seeds:
        drive = traced(args.scenario, seed, gnss=MODEL)
        scans, length = len(drive), drive.ground_truth.path_lengths[-1]
        for kind in args.kinds.split(","):
            settings = [
                *KINDS[kind], f"debug.drift_percent={percent}", f"debug.drift_deg_per_100m={deg}",
                f"debug.drift_seed={seed}",
            ]  # fmt: skip
            fit, graph = (judged(drive, settings, mode) for mode in ("fit", "graph"))
            row = [fit[0], smoothed(drive), graph[0], fit[1], graph[1]]
            found.setdefault(kind, []).append(row)
            print(f"{kind:12} {seed:5d} " + " ".join(f"{v:16.3f}" for v in row), flush=True)
    caption = (
        f"Horizontal error on the Earth, m, rmse, median / worst of {tables.seeds_named(seeds)}, `{args.scenario}` "
        f"({scans} scans, {length:.0f} m), no loops: of odometry laid on the fixes as a whole, of the fixes smoothed, of the "
        f"graph; then of the shapes, each fitted to the truth. A fix a second errs by {MODEL.white} m on its own and by "
        f"{MODEL.slow} m that wanders over {MODEL.memory:.0f} s; {percent} % and {deg} deg/100 m of drift in odometry."
    )
    rows = [[kind, *(tables.spread(column) for column in zip(*rows, strict=True))] for kind, rows in found.items()]
    tables.table("gnss", caption, ["drift", *columns], rows, args.write)


if __name__ == "__main__":
    main()
