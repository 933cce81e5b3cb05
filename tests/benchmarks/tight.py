"""Tightly coupled LiDAR and IMU where it matters: violent motion, degenerate places, consumer IMUs, three kinds of LiDAR.

    python tests/benchmarks/tight.py --runs FOLDER [--methods icp,icp+imu.use=true,fast-lio2] [--scenarios stairs]
        [--lidars vlp16] [--imus icm20948] [--seeds 100-104] [--scans 100] [--write docs/results.md]

What was run once stands in FOLDER/tight.json and is not run again, whatever became of the code: take another folder for
that. Every drive is a process of its own: a method that ends it is counted as failed, and the others go on. `quadrotor` and
`stairs` are run whole. A run is lost when its ATE exceeds a twentieth of the path or it ends without a result. Every drive has
satellite fixes, and loops where it is long enough, for methods with `+loops.use=true+gnss.mode=graph`.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import tables
from inertial_peers import rko_lio, score
from nees import errors, nees
from numpy.typing import NDArray
from traced import Traced, run_on, traced

from lslam.core.errors import LslamError
from lslam.core.geometry import se3
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats.atomic import write_text
from lslam.simulation.sensors import GnssModel

SCENARIOS = "walk,urban-hard,residential-hard,corridor,carpark,quadrotor,stairs"
METHODS = "icp,icp+imu.use=true,fast-lio2,dlo+imu.use=true,rko-lio"
WHOLE = ("quadrotor", "stairs")
LOST = 1 / 20  # of the path
WARM = 12  # scans before the clock runs: kernels are compiled or loaded
Found = dict[str, Any]


def one(drive: Traced, method: str) -> Found:
    """What a method makes of a drive: ATE, drift, status, CPU seconds a scan and NEES, as far as there are any."""
    if method == "rko-lio":
        return _peer(drive)
    name, *settings = method.split("+")
    given = (f"odometry.method={name}", "map.write=false", "loops.use=false", *settings)
    truth = drive.ground_truth
    assert truth is not None
    try:
        run_on(drive, *given, f"input.count={WARM}")
    except LslamError:
        logging.getLogger("lslam").debug("%s has no result of %d scans", method, WARM)
    began = time.process_time()
    try:
        outcome = run_on(drive, *given)
    except LslamError as error:
        return {"status": "failed", "reason": str(error)[:300]}
    cpu = (time.process_time() - began) / len(drive)
    assert outcome.evaluation is not None
    ate = outcome.evaluation.ate["se3"].translation
    assert ate is not None
    found = {"ate": ate.rmse, "cpu": cpu, "status": str(outcome.record.manifest["status"])}
    if outcome.record.trajectory.covariances is not None:
        e, C = errors(outcome, drive)  # type: ignore[arg-type]
        found["nees"] = nees(e[1:], C[1:])
    poses = np.stack([r.T_world_lidar for r in outcome.record.results])
    return found | {"drift": _drift(poses, truth), "scans": len(poses)}


def _peer(drive: Traced) -> Found:
    """rko-lio at the instant of the sweep that suits it best; it says nothing of how sure it is."""
    fine_ns = np.arange(int(drive.end * 100) + 1, dtype=np.int64) * 10**7
    exact = se3.relative(drive.T_city_world, drive.vehicle.poses(fine_ns / 1e9))
    began = time.process_time()
    try:
        poses, _ = rko_lio(drive, len(drive))  # type: ignore[arg-type]
    except (ValueError, RuntimeError) as error:
        return {"status": "failed", "reason": str(error)[:300]}
    cpu = (time.process_time() - began) / len(drive)
    ate, _ = score(drive, Trajectory(fine_ns, exact, "lidar"), poses, False)  # type: ignore[arg-type]
    return {"ate": ate, "cpu": cpu, "status": "-", "drift": _drift(poses, drive.ground_truth)}


def _drift(poses: NDArray[np.float64], truth: Trajectory) -> float:
    """How far the end is off the truth from the first pose on, by the way until there."""
    end = (truth.poses[0] @ se3.inverse(poses[0]) @ poses[-1])[:3, 3]
    last = min(len(poses), len(truth)) - 1
    return float(np.linalg.norm(end - truth.positions[last]) / truth.path_lengths[last])


def work(case: Found) -> None:
    """In a process of its own: a drive, and one line of JSON a method."""
    logging.getLogger("lslam").setLevel(logging.CRITICAL)
    count = None if case["scenario"] in WHOLE else case["scans"]
    given = {"lidar": case["lidar"], "imu": case["imu"], "gnss": GnssModel(), "count": count}
    drive = traced(case["scenario"], case["seed"], **given, motion_compensated=False)
    length = float(drive.ground_truth.path_lengths[-1])
    for method in case["methods"]:
        found = one(drive, method) | {"length": length}
        print(json.dumps({"method": method, "found": found}), flush=True)


def key(scenario: str, lidar: str, imu: str, seed: int, method: str, scans: int) -> str:
    return " ".join([scenario, lidar, imu, str(seed), method, "whole" if scenario in WHOLE else str(scans)])


def fill(known: dict[str, Found], case: Found, file: Path) -> None:
    """Run what is missing of a drive, and keep every method as soon as it is done."""
    words = [case[word] for word in ("scenario", "lidar", "imu", "seed")]
    missing = [m for m in case["methods"] if key(*words, m, case["scans"]) not in known]
    while missing:
        given = json.dumps({**case, "methods": missing})
        with subprocess.Popen(
            [sys.executable, __file__, "--case", given], stdout=subprocess.PIPE, text=True
        ) as process:
            assert process.stdout is not None
            # Peers write to stdout, too.
            for line in (each for each in process.stdout if each.startswith('{"method"')):
                told = json.loads(line)
                _keep(known, key(*words, missing.pop(0), case["scans"]), told["found"], file)
        if missing:
            ended = {"status": "failed", "reason": f"the process ended with {process.returncode}"}
            _keep(known, key(*words, missing.pop(0), case["scans"]), ended, file)


def _keep(known: dict[str, Found], name: str, found: Found, file: Path) -> None:
    known[name] = found
    write_text(file, json.dumps(known, indent=1) + "\n")
    shown = " ".join(f"{k} {found[k]:.4g}" for k in ("ate", "drift", "cpu", "nees") if k in found)
    print(f"{name:60} {shown} {found['status']} {found.get('reason', '')[:90]}", flush=True)


def is_lost(found: Found) -> bool:
    return "ate" not in found or not found["ate"] <= LOST * found["length"]


def cell(runs: list[Found]) -> str:
    """ATE, and how many runs were lost without and with a word of it."""
    text = tables.spread([run.get("ate", float("inf")) for run in runs], 3)
    lost = [run for run in runs if is_lost(run)]
    silent = sum(run["status"] in ("ok", "done", "-") for run in lost)
    return f"{text} ({len(lost)} lost{f', {silent} silently' if silent else ''})" if lost else text


def middle(runs: list[Found], what: str, factor: float, digits: int) -> str:
    return tables.spread([factor * run[what] for run in runs if what in run and not is_lost(run)], digits)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", help=argparse.SUPPRESS)
    parser.add_argument("--runs", type=Path, help="folder of what is done")
    parser.add_argument("--scenarios", default=SCENARIOS)
    parser.add_argument("--lidars", default="vlp16,os1-64,livox")
    parser.add_argument("--imus", default="icm20948,phone-calibrated")
    parser.add_argument("--methods", default=METHODS)
    parser.add_argument("--scans", type=int, default=100)
    parser.add_argument("--table", default="tight", help="name of the first table; the second adds -sums")
    tables.offer(parser)
    args = parser.parse_args()
    if args.case:
        work(json.loads(args.case))
        return
    if args.runs is None:
        parser.error("--runs FOLDER says where to keep what is done")
    os.makedirs(args.runs, exist_ok=True)
    file = args.runs / "tight.json"
    known: dict[str, Found] = json.loads(file.read_text()) if file.is_file() else {}
    methods, seeds = args.methods.split(","), tables.numbers(args.seeds)
    places = [
        (s, lidar, imu)
        for s in args.scenarios.split(",")
        for lidar in args.lidars.split(",")
        for imu in args.imus.split(",")
    ]
    for seed in seeds:
        for scenario, lidar, imu in places:
            case = {
                "scenario": scenario,
                "lidar": lidar,
                "imu": imu,
                "seed": seed,
                "scans": args.scans,
                "methods": methods,
            }
            fill(known, case, file)
    runs = {(p, m): [known[key(*p, s, m, args.scans)] for s in seeds] for p in places for m in methods}
    caption = (
        f"ATE se3, m, median / worst of {tables.seeds_named(seeds)}, {args.scans} scans each, {' and '.join(WHOLE)} whole; lost: "
        "off by a twentieth of the path or without a result, silently where the run did not say `degraded` either. "
        "rko-lio in its defaults, at the instant of the sweep that suits it best."
    )
    rows = [[" ".join(p), *(cell(runs[p, m]) for m in methods)] for p in places]
    tables.table(f"{args.table}", caption, ["drive", *methods], rows, args.write)
    caption = (
        "The same runs: how many were lost, and of those that were not the end's distance from the truth in % of the path, "
        "ms of CPU a scan, and NEES per degree of freedom, median / worst."
    )
    sums = []
    for m in methods:
        all_of = [run for p in places for run in runs[p, m]]
        lost = sum(map(is_lost, all_of))
        measures = [middle(all_of, *how) for how in (("drift", 100, 2), ("cpu", 1e3, 1), ("nees", 1, 2))]
        sums.append([m, f"{lost} of {len(all_of)}", *measures])
    tables.table(f"{args.table}-sums", caption, ["method", "lost", "drift, %", "ms a scan", "NEES"], sums, args.write)


if __name__ == "__main__":
    main()
