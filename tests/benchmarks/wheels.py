"""`icp` with the wheels of a car beside `icp` without: error along drives that hold the LiDAR, and along such that do not.

    python tests/benchmarks/wheels.py [--seeds 321-325] [--write docs/results.md]

The wheels err in scale and yaw rate, are late, and slip (`lslam.simulation.sensors.WheelModel`). Those of another robot are the
wheels of a drive elsewhere, in feet, with the yaw rate of the wrong sign.
"""

from __future__ import annotations

import argparse
import logging
from dataclasses import replace

import numpy as np
import tables
from traced import Traced, run_on, traced

from lslam.core.geometry import se3
from lslam.core.types.imu import WheelStream
from lslam.simulation.scenarios import simulate
from lslam.simulation.sensors import WheelModel

# Scenario, sensor, scans, and every how many of them are used.
DRIVES: dict[str, tuple[str, str, int, int]] = {
    "tunnel, vlp16": ("tunnel", "vlp16", 200, 1),
    "corridor, vlp16": ("corridor", "vlp16", 300, 1),
    "corridor, vlp16, every third scan": ("corridor", "vlp16", 300, 3),
    "motorway, vlp16": ("motorway", "vlp16", 200, 1),
    "motorway, vlp16, every third scan": ("motorway", "vlp16", 200, 3),
    "urban, hdl64": ("urban", "hdl64", 120, 1),
    "residential, hdl64": ("residential", "hdl64", 120, 1),
}
FOOT_M = 0.3048


def another(drive: Traced, seed: int) -> WheelStream:
    """Wheels of another robot, with the stamps of those of the drive."""
    own: WheelStream = drive.wheels
    other = simulate("urban", seed=seed + 1000, count=len(drive), wheels=WheelModel()).wheels
    assert other is not None
    assert other.yaw_rate is not None
    k = np.minimum(np.arange(len(own)), len(other) - 1)
    return replace(own, speed=other.speed[k] / FOOT_M, yaw_rate=-other.yaw_rate[k])


def error(drive: Traced, step: int, wheels: WheelStream | None) -> float:
    """ATE, m; positions on a line are aligned but for the turn about it, which moves none."""
    drive.wheels = wheels
    source = () if wheels is None else ("wheels.source=simulated",)
    outcome = run_on(drive, f"input.skip_frames={step}", "map.write=false", *source)
    places, truth = outcome.record.trajectory.poses[:, :3, 3], drive.ground_truth.poses[::step, :3, 3]
    T, _, _ = se3.umeyama(places, truth)
    return float(np.sqrt(np.mean(np.sum((se3.apply(T, places) - truth) ** 2, axis=1))))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", default=None, help="names as in the table, with semicolons between them")
    tables.offer(parser, "321-325")
    args = parser.parse_args()
    logging.getLogger("lslam").setLevel(logging.CRITICAL)
    seeds, rows = tables.numbers(args.seeds), []
    for name in args.drives.split(";") if args.drives else DRIVES:
        scenario, lidar, count, step = DRIVES[name]
        found = []
        for seed in seeds:
            drive = traced(scenario, seed, lidar=lidar, count=count, wheels=WheelModel())
            kinds = (None, drive.wheels, another(drive, seed))
            found.append([error(drive, step, wheels) for wheels in kinds])
            print(name, seed, *found[-1], flush=True)
        ate = np.array(found)  # seeds, kinds
        rows.append(
            [name, *(tables.spread(ate[:, kind], 4) for kind in range(3)), tables.spread(ate[:, 1] / ate[:, 0], 4)]
        )
    caption = (
        f"`icp`, {tables.seeds_named(seeds)}, median / worst: ATE aligned (se3), m, without wheels, with the car's and with "
        "those of another robot; and of the car's the ratio to without."
    )
    heads = ["drive", "without", "wheels", "another robot's", "ratio"]
    tables.table("wheels", caption, heads, rows, args.write)


if __name__ == "__main__":
    main()
