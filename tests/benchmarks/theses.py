"""The first thesis' presets, without and with the IMU, on its five flights, as its section 4.2 scores them.

    python tests/benchmarks/theses.py [--flights closed,open] [--seeds 100-104] [--write docs/results.md]

`thesis_rmse` of the odometry, m: root mean square over all 3 N coordinates, first pose on the first true pose. The climb is
scored a second time up to where it is 70 m high: above that hardly a beam of its 50 m comes back.
"""

from __future__ import annotations

import argparse
import logging
from itertools import product

import numpy as np
import tables
from traced import Traced, run_on, traced

from lslam.errors import LslamError
from lslam.evaluation.associate import associate
from lslam.evaluation.thesis import axis_errors

FLIGHTS = ("closed", "open", "climbing", "small-eight", "large-eight")
PRESETS = ("thesis-icp", "thesis-loam", "thesis-loam-map")
# What the thesis prints, before its optimisation, m, without and with the IMU.
PRINTED = {
    "closed": ("2.05", "0.43", "1.57", "", "0.86", "0.65"),
    "open": ("0.84", "0.42", "0.84", "", "0.58", "0.51"),
    "climbing": ("0.35", "", "1.95", "", "1.04", ""),
    "small-eight": ("0.68", "0.34", "0.70", "", "0.41", "0.38"),
    "large-eight": ("0.72", "", "2.16", "", "0.64", ""),
}
LOW = 70.0


def judged(drive: Traced, preset: str, uses_imu: bool) -> tuple[float, float]:
    """`thesis_rmse`, m, of all scans and of those up to LOW m of height; inf where the run failed."""
    settings = [f"odometry.preset={preset}", f"imu.use={str(uses_imu).lower()}", "loops.use=false", "map.write=false"]
    try:
        outcome = run_on(drive, *settings)
    except LslamError:
        return float("inf"), float("inf")
    matches = associate(outcome.trajectory, drive.ground_truth, 0.01, 0)
    high = np.flatnonzero(matches.truth[:, 2, 3] - matches.truth[0, 2, 3] > LOW)
    low = high[0] if len(high) else len(matches.truth)
    return tuple(axis_errors(matches.estimate[:n], matches.truth[:n]).thesis_rmse for n in (len(matches.truth), low))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", default=",".join(FLIGHTS))
    parser.add_argument("--seeds", default=tables.SEEDS)
    tables.offer(parser)
    args = parser.parse_args()
    logging.getLogger("lslam").setLevel(logging.CRITICAL)
    flights, seeds = args.flights.split(","), tables.numbers(args.seeds)
    systems = list(product(PRESETS, (False, True)))
    found: dict[str, list[list[float]]] = {}
    for flight, seed in product(flights, seeds):
        drive = traced(flight, seed, imu="icm20948")
        for system in systems:
            whole, low = judged(drive, *system)
            print(
                f"{flight:12} {seed:4d} {system[0]:16} {'imu' if system[1] else '-':4} {whole:9.3f} {low:9.3f}",
                flush=True,
            )
            found.setdefault(flight, [[] for _ in systems])[systems.index(system)].append(whole)
            if flight == "climbing":
                found.setdefault(f"climbing, {LOW:.0f} m", [[] for _ in systems])[systems.index(system)].append(low)
    caption = (
        f"`thesis_rmse` of the odometry, m, first pose on the first true pose, whole flights, median / worst of "
        f"{tables.seeds_named(seeds)}; in brackets what the thesis prints before its optimisation."
    )
    header = ["flight", *(name + (" --imu" if uses_imu else "") for name, uses_imu in systems)]
    rows = []
    for flight, columns in found.items():
        printed = PRINTED.get(flight, ("",) * len(systems))
        cells = [
            tables.spread(values) + (f" ({told})" if told else "")
            for values, told in zip(columns, printed, strict=True)
        ]
        rows.append([flight, *cells])
    tables.table("theses", caption, header, rows, args.write)


if __name__ == "__main__":
    main()
