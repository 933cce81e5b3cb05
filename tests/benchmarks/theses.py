"""Girolimetto's presets, without and with the IMU, on its flights, clean and hard, before and after the pose graph.

    python tests/benchmarks/theses.py [--flights closed,open,open-hard] [--seeds 100-104] [--write docs/theses.md]

`thesis_rmse` of the odometry and of what the graph made of it, m: root mean square over all 3 N coordinates, first pose on
the first true pose; below them the angular error of the odometry, deg, equation 2.15: how hard a flight is. `failed` is a run
that said `diverged`. The climb is flown a second time with returns of 70 m: hardly a beam ends within the 50 m of the presets.
"""

from __future__ import annotations

import argparse
import logging
from itertools import product

import tables
from traced import Traced, run_on, traced

from lslam.core.errors import LslamError
from lslam.evaluation.associate import associate
from lslam.evaluation.thesis import axis_errors

# Name, scenario, and keys beside the preset's: for the climb the thesis widened its range, by how much it does not say.
FLIGHTS: dict[str, tuple[str, tuple[str, ...]]] = {
    "open": ("open", ()),
    "open-hard": ("open-hard", ()),
    "small-eight": ("small-eight", ()),
    "closed": ("closed", ()),
    "large-eight": ("large-eight", ()),
    "climbing": ("climbing", ()),
    "climbing-70m": ("climbing", ("preprocess.range_max=70",)),
}
PRESETS = ("thesis-icp", "thesis-loam", "thesis-loam-map")
QUANTITIES = ("before the graph, m", "after it, m", "angular, deg")
NONE = ("",) * 6
# What the thesis prints of each quantity (tables 4.3 to 4.16, 5.2 to 5.4), without and with the IMU.
PRINTED: dict[str, tuple[tuple[str, ...], ...]] = {
    "closed": (
        ("2.05", "0.43", "1.57", "", "0.86", "0.65"),
        ("1.17", "0.41", "1.00", "", "0.86", "0.65"),
        ("1.31", "0.83", "1.28", "", "1.37", "0.96"),
    ),
    "open": (("0.84", "0.42", "0.84", "", "0.58", "0.51"), NONE, ("2.12", "1.55", "1.67", "", "1.61", "1.57")),
    "climbing": (("0.35", "", "1.95", "", "1.04", ""), NONE, ("1.56", "", "3.32", "", "2.19", "")),
    "small-eight": (
        ("0.68", "0.34", "0.70", "", "0.41", "0.38"),
        ("0.45", "0.33", "0.63", "", "0.40", "0.36"),
        ("1.93", "1.70", "2.81", "", "1.85", "1.96"),
    ),
    "large-eight": (
        ("0.72", "", "2.16", "", "0.64", ""),
        ("0.53", "", "1.07", "", "0.61", ""),
        ("1.29", "", "3.43", "", "1.84", ""),
    ),
}


def judged(drive: Traced, preset: str, uses_imu: bool, more: tuple[str, ...]) -> tuple[float, float, float]:
    """Each of QUANTITIES; inf where the run failed."""
    settings = [f"odometry.preset={preset}", f"imu.use={str(uses_imu).lower()}", "map.write=false", *more]
    try:
        outcome = run_on(drive, *settings)
    except LslamError:
        return (float("inf"),) * 3
    poses = (outcome.record.odometry or outcome.trajectory, outcome.trajectory)
    matches = [associate(trajectory, drive.ground_truth, 0.01, 0) for trajectory in poses]
    before, after = (axis_errors(m.estimate, m.truth) for m in matches)
    return before.thesis_rmse, after.thesis_rmse, before.angular_rmse_deg


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", default=",".join(FLIGHTS))
    tables.offer(parser)
    args = parser.parse_args()
    logging.getLogger("lslam").setLevel(logging.CRITICAL)
    flights, seeds = args.flights.split(","), tables.numbers(args.seeds)
    systems = list(product(PRESETS, (False, True)))
    found: dict[str, list[list[tuple[float, float, float]]]] = {}
    for flight, seed in product(flights, seeds):
        scenario, more = FLIGHTS[flight]
        drive = traced(scenario, seed, imu="icm20948")
        for system in systems:
            errors = judged(drive, *system, more)
            said = " ".join(f"{error:9.3f}" for error in errors)
            print(f"{flight:12} {seed:4d} {system[0]:16} {'imu' if system[1] else '-':4} {said}", flush=True)
            found.setdefault(flight, [[] for _ in systems])[systems.index(system)].append(errors)
    caption = (
        f"`thesis_rmse`, first pose on the first true pose, and the angular error of the odometry, whole flights, median / "
        f"worst of {tables.seeds_named(seeds)}; in brackets what the thesis prints."
    )
    header = ["flight", "", *(name + (" --imu" if uses_imu else "") for name, uses_imu in systems)]
    rows = []
    for flight, columns in found.items():
        printed = PRINTED.get(flight.removesuffix("-hard").removesuffix("-70m"), (NONE,) * 3)
        for k, quantity in enumerate(QUANTITIES):
            cells = [
                tables.spread([errors[k] for errors in runs]) + (f" ({told})" if told else "")
                for runs, told in zip(columns, printed[k], strict=True)
            ]
            rows.append([flight, quantity, *cells])
    tables.table("theses", caption, header, rows, args.write)


if __name__ == "__main__":
    main()
