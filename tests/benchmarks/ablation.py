"""Every recovery policy, and what the map asks of its voxels, switched off one at a time: which rows need it.

    python tests/benchmarks/ablation.py [--method loam] [--seeds 100,101] [--rows hdl64,vlp16,os1-16] [--without breadth]
        [--write docs/results.md]
    python tests/benchmarks/ablation.py --starts
    python tests/benchmarks/ablation.py --lights [--method loam] [--seeds 100-104] [--without 'held at rest']
    python tests/benchmarks/ablation.py --recordings FOLDER [--method loam]

Recordings are those of the folder given, with all rings, every second and every fourth. Drives are simulated with compensated
scans: standing 2.5 s before they drive off, and moving from the first scan. A run is lost when its error, the first pose on
the first true pose, exceeds a twentieth of the path. Starts are ten scans from the first step at 30 m/s, or forty metres above a
town, by sixteen beams, on seeds from 200 on. At lights the sensor stands. One of both is lost half a metre off. `acted` counts
scans that a policy posed.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from itertools import product
from pathlib import Path
from unittest import mock

import numpy as np
import tables
from numpy.typing import NDArray
from recorded import thinned
from scores import ate, origin, rotation_rpe
from sparse import length

from lslam.core.config import load_config
from lslam.core.errors import UsageError
from lslam.core.types.scan import Scan
from lslam.odometry import create_odometry, feature_policies
from lslam.odometry.frontend import tracker
from lslam.odometry.frontend.tracker import ScanInput, Tracker
from lslam.odometry.inertial import constant_velocity
from lslam.registration import alignment, local_map, policies, residuals
from lslam.simulation.scenarios import simulate

Floats = NDArray[np.float64]
Case = tuple[str, list[Scan], Floats]
# Keys to set, and attributes to patch: owner, name, value.
Variant = tuple[tuple[str, ...], tuple[tuple[object, str, object], ...]]

SPEEDS = {"motorway": (5.0, 30.0), "carpark": (5.0, 12.0), "street": (5.0, 12.0)}
SLOW = ("urban", "residential", "corridor", "walk", "block", "closed", "climbing")
SCANS = 100
# Scans as `--skip-frames 2` leaves them: three times as far apart.
THIRDS = ("street", "corridor", "urban")


BLOBS_AS_BEFORE = {**residuals.RESIDUALS, "plane": replace(residuals.RESIDUALS["plane"], axial_weight=1.0)}
WITHOUT_BLOBS = {**residuals.RESIDUALS, "plane": residuals.PLANES_ALONE}
MAP: dict[str, Variant] = {
    "breadth": ((), ((local_map, "LEAST_BREADTH", 0.0),)),
    "wide voxels": ((), ((local_map, "WIDE_FACTORS", ()),)),
    "wide weigh less": ((), ((alignment, "part_of_usual", lambda size, usual: 1.0),)),
}
WITHOUT: dict[str, dict[str, Variant]] = {
    "icp": {
        **MAP,
        "blobs": ((), ((residuals, "RESIDUALS", WITHOUT_BLOBS),)),
        "along": ((), ((residuals, "RESIDUALS", BLOBS_AS_BEFORE),)),
        "coarse-to-fine": (("recovery.coarse_to_fine=false",), ()),
        "start search": (("recovery.start_search=false",), ()),
        "held at rest": (("recovery.at_rest=false",), ()),
        "at rest": ((), ((policies, "is_at_rest", lambda pose, last: False),)),
        "HIGH_M": ((), ((policies, "HIGH_M", 0.3),)),
        "CLEAR_RATIO": ((), ((policies, "CLEAR_RATIO", 1.0),)),
        "MUCH_RATIO": ((), ((policies, "MUCH_RATIO", 1.0),)),
        "agreement": (("registration.min_agreement=0",), ()),
        "possible jumps": ((), ((tracker, "fault", lambda pose, stamp_ns, last: ""),)),
        "bounded acceleration": ((), ((constant_velocity, "MOST_ACCELERATION_M_S2", np.inf),)),
    },
    "loam": {
        **MAP,
        "coarse-to-fine": (("recovery.coarse_to_fine=false",), ()),
        "start search": (("recovery.start_search=false",), ()),
        "held at rest": (("recovery.at_rest=false",), ()),
        "less planar": (("recovery.less_planar=false",), ()),
        "remapping": ((), ((feature_policies.SolutionRemapping, "recover", lambda self, attempt, result: result),)),
        "agreement": (("registration.min_agreement=0",), ()),
    },
}


def drives(lidars: list[str], seeds: list[int]) -> Iterator[Case]:
    for scenario in (*SPEEDS, *SLOW):
        for speed in SPEEDS.get(scenario, (None,)):
            for stands in (2.5, 0.0):
                for lidar in lidars:
                    for seed in seeds:
                        start = {} if speed is None else {"speed": speed, "start_speed": 0.0 if stands else speed}
                        try:
                            line = simulate(
                                scenario, seed=seed, lidar=lidar, count=SCANS, static_start=stands,
                                motion_compensated=True, **start,
                            )  # fmt: skip
                        except UsageError:
                            # A drone does not stand.
                            continue
                        name = f"{scenario} {speed or 0:g} {'standing' if stands else 'moving'} {lidar} {seed}"
                        scans = [line.scan(i) for i in range(SCANS)]
                        yield name, scans, line.ground_truth.poses
                        if scenario in THIRDS and not stands:
                            yield f"{name} thirds", scans[::3], line.ground_truth.poses[::3]


def starts() -> Iterator[Case]:
    """First steps at a speed that nobody knows, where few rings are all there is."""
    kinds = [(scenario, lidar) for scenario in ("motorway", "street", "closed") for lidar in ("vlp16", "os1-16")]
    for (scenario, lidar), seed in product(kinds, range(200, 208)):
        moves = {} if scenario == "closed" else {"speed": 30.0, "start_speed": 30.0}
        line = simulate(scenario, seed=seed, lidar=lidar, count=10, motion_compensated=True, **moves)
        yield f"{scenario} start {lidar} {seed}", [line.scan(i) for i in range(10)], line.ground_truth.poses


def lights(lidars: list[str], seeds: list[int]) -> Iterator[Case]:
    """Standing among traffic that starts."""
    for lidar, seed in product(lidars, seeds):
        line = simulate("lights", seed=seed, lidar=lidar, count=SCANS, motion_compensated=True)
        yield f"lights {lidar} {seed}", [line.scan(i) for i in range(SCANS)], line.ground_truth.poses


def recorded(folder: Path) -> Iterator[Case]:
    """Their rings are thinned, so that no method asks for them: stamps are those of ten scans a second."""
    for name, clouds, truth in thinned(folder):
        yield name, [Scan(points, 100_000_000 * i, i) for i, points in enumerate(clouds)], truth


def row(method: str, variant: Variant, case: Case) -> tuple[float, float, float, int, Counter[str]]:
    """ATE origin and se3, m, rotation over 10 m, deg, failed scans, and who posed."""
    _, scans, truth = case
    settings, patches = variant
    results = []
    with ExitStack() as stack:
        for patch in patches:
            stack.enter_context(mock.patch.object(*patch))
        odometry = create_odometry(load_config(settings=[f"odometry.method={method}", *settings], environ={}))
        tracker = Tracker(odometry)
        for k, scan in enumerate(scans):
            results.append(tracker.track(ScanInput(k, scan.stamp_ns, scan, odometry.prepare(scan))))
    found = np.stack([result.T_world_lidar for result in results])
    acted = Counter(result.posed_by for result in results if result.posed_by)
    failed = sum(result.status != "ok" for result in results)
    return origin(found, truth), ate(found, truth), rotation_rpe(found, truth), failed, acted


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=Path)
    parser.add_argument("--starts", action="store_true")
    parser.add_argument("--lights", action="store_true")
    parser.add_argument("--rows", default="hdl64,vlp16,os1-32")
    parser.add_argument("--method", default="icp", choices=list(WITHOUT))
    parser.add_argument("--without", help="names of this table, comma-separated; default: all")
    tables.offer(parser, "100,101")
    args = parser.parse_args()
    known = WITHOUT[args.method]
    asked = args.without.split(",") if args.without else list(known)
    if set(asked) - set(known):
        parser.error(f"--without takes {', '.join(known)}")
    if args.recordings:
        cases = recorded(args.recordings)
    elif args.starts:
        cases = starts()
    elif args.lights:
        cases = lights(args.rows.split(","), tables.numbers(args.seeds))
    else:
        cases = drives(args.rows.split(","), tables.numbers(args.seeds))
    variants: dict[str, Variant] = {"-": ((), ()), **{name: known[name] for name in asked}}
    lost, worse, count = Counter[str](), Counter[str](), 0
    print(f"{'case':38} {'without':15} {'origin m':>9} {'se3 m':>8} {'deg/10 m':>9} {'failed':>7}  acted")
    for case in cases:
        whole, count = 0.0, count + 1
        for name, variant in variants.items():
            start, shape, turn, failed, acted = row(args.method, variant, case)
            limit = 0.5 if args.starts or args.lights else 0.05 * length(case[2])
            is_lost = start > limit and not args.recordings
            whole = shape if name == "-" else whole
            lost[name] += is_lost
            worse[name] += shape > max(1.5 * whole, whole + 0.01)
            if name == "-" or is_lost or shape > max(1.1 * whole, whole + 0.002):
                who = ", ".join(f"{k} {v}" for k, v in acted.items())
                print(f"{case[0]:38} {name:15} {start:9.3f} {shape:8.4f} {turn:9.3f} {failed:7d}  {who}", flush=True)
    drive = f"lights-{args.method}" if args.lights else args.method
    kind = f"recordings-{args.method}" if args.recordings else "starts" if args.starts else drive
    limit = "half a metre off" if args.starts or args.lights else "a twentieth of its path off"
    caption = (
        f"{args.method}, {count} runs: lost is one {limit}, worse one whose ATE se3 grows by half and a centimetre."
    )
    rows = [["nothing" if name == "-" else name, str(lost[name]), str(worse[name])] for name in variants]
    tables.table(f"ablation-{kind}", caption, ["without", "lost", "worse"], rows, args.write)


if __name__ == "__main__":
    main()
