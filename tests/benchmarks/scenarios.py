"""Every method on every scenario of the virtual environment: ATE, KITTI drift, time per scan.

python tests/benchmarks/scenarios.py [--scans 300] [--seed 0] [--methods icp,kiss-icp] [--only closed,urban]
"""

from __future__ import annotations

import argparse
import logging
from typing import Any

import numpy as np

from lslam.config import load_config
from lslam.errors import LslamError
from lslam.pipeline.run import run
from lslam.simulation.scenario_files import scenario_names
from lslam.simulation.scenarios import SimulatedDrive, simulate
from lslam.types.scan import Scan


class Kept:
    """A simulated drive whose scans are traced once and then kept."""

    def __init__(self, drive: SimulatedDrive) -> None:
        self._drive = drive
        self._scans = [drive.scan(i) for i in range(len(drive))]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._drive, name)

    def __len__(self) -> int:
        return len(self._scans)

    def scan(self, index: int) -> Scan:
        return self._scans[index]


def row(scenario: str, kept: Kept, method: str) -> str:
    head = f"{scenario:12} {method:9} {len(kept):5d}"
    try:
        outcome = run(kept, load_config(None, [f"odometry.method={method}"], {}))  # type: ignore[arg-type]
    except LslamError as error:
        return f"{head}  failed: {error}"[:110]
    e, results = outcome.evaluation, outcome.record.results
    assert e is not None
    ms = 1e3 * np.array([sum(v for k, v in r.stages.items() if k != "read") for r in results])
    ate = [e.ate[name].translation.rmse if e.ate[name].translation else float("nan") for name in ("se3", "origin")]
    drift = f"{e.kitti_drift.translation_percent:8.3f}" if e.kitti_drift.available else f"{'n/a':>8}"
    failed, weak = sum(r.status != "ok" for r in results), sum(len(r.degenerate) > 0 for r in results)
    return (
        f"{head} {e.path_length:7.0f} {ate[0]:9.4f} {ate[1]:9.4f} {drift} "
        f"{np.median(ms):9.1f} {np.percentile(ms, 95):7.1f} {failed:6d} {weak:10d}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--methods", default="icp,kiss-icp")
    parser.add_argument("--only", default="")
    args = parser.parse_args()
    logging.getLogger("lslam").setLevel(logging.ERROR)
    print("scenario     method    scans  path m  ATE se3 ATE origin  drift % ms median     p95 failed degenerate")
    for name in args.only.split(",") if args.only else scenario_names():
        whole = simulate(name, seed=args.seed)
        drive = simulate(name, seed=args.seed, count=min(args.scans, len(whole)))
        kept = Kept(drive)
        for method in args.methods.split(","):
            print(row(name, kept, method), flush=True)


if __name__ == "__main__":
    main()
