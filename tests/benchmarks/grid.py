"""The whole grid: every scenario, seed and recording with every method and peer, resumable, and a table with the targets.

    python tests/benchmarks/grid.py FOLDER [--recordings UNPACKED] [--seeds 0,1,2] [--scans 300] [--distorted]
    python tests/benchmarks/grid.py FOLDER --report

A row per run is kept in FOLDER; a row that is there is not run again. Scans are compensated, or as the sensor fires
them with --distorted. Every run is a process of its own; reading is not timed and nothing runs beside the register call.
Cases are names of scenarios, `name:lidar` with another sensor, `name@full` at full length, and recordings.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from grid_targets import report
from numpy.typing import NDArray
from peers import drive
from scores import ate, rotation_rpe
from traced import Traced

from lslam import Registration
from lslam.core.config import load_config
from lslam.core.config.config import known_presets
from lslam.core.errors import RunFailedError
from lslam.core.geometry import se3
from lslam.core.geometry.se3 import poses_at
from lslam.core.types.sequence import Sequence
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.io.readers import open_sequence
from lslam.pipeline.run import RunOutcome, Watch, run
from lslam.simulation import NUMBER
from lslam.simulation.record import record
from lslam.simulation.scenario_files import scenario_names
from lslam.simulation.scenarios import simulate

OURS = ("icp", "icp-point", "gicp", "vgicp", "ndt", "loam", "loam-odom", "floam", "lego-loam")
PEERS = ("kiss-icp", "small-gicp", "small-vgicp", "genz-icp")
# Of other packages, called as their authors do; all else runs as a method of lslam.
BESIDE = ("small-vgicp", "genz-icp")
FLIGHTS = ("closed", "open", "climbing", "small-eight", "large-eight")
PRESETS = ("thesis-icp", "thesis-loam", "thesis-loam-map")
PLAIN = (*OURS, *PEERS)
FEW_BEAMS = ("icp", "kiss-icp", "loam", "loam-odom", "lego-loam")
RECORDINGS = {
    "kitti_raw_0005": "2011_09_26/2011_09_26_drive_0005_sync",
    "kitti_raw_0048": "2011_09_26/2011_09_26_drive_0048_sync",
    "mcd_kth_day_06": "mcd_kth_day_06",
}
STARTS, STRIDE = 5, 3
DAY_NS = 86_400 * 10**9
# The thesis widened the range of its LOAM on this flight, to what it does not print: that of its ICP.
ON_THE_CLIMB = dict.fromkeys(("thesis-loam", "thesis-loam-map"), ("preprocess.range_max=70",))


@dataclass(frozen=True)
class Case:
    """name : as in --only; seed, None for a recording; methods : that make sense on it."""

    name: str
    seed: int | None
    methods: tuple[str, ...]

    def key(self, method: str) -> str:
        return f"{self.name.replace(':', '_').replace('@', '_')}-{self.seed}-{method}"


def cases(recordings: Path | None, seeds: tuple[int, ...]) -> Iterator[Case]:
    """Recordings first, then seed by seed, so that an unfinished grid has seen everything once."""
    if recordings is not None:
        for name in RECORDINGS:
            yield Case(name, None, PLAIN)
    for seed in seeds:
        for name in scenario_names():
            yield Case(name, seed, PLAIN)
        for name in FLIGHTS:
            is_whole = name in ("closed", "open", "small-eight")
            yield Case(f"{name}@full", seed, (*(("icp", *PEERS) if is_whole else ("icp", "loam")), *PRESETS))
        for lidar in ("hdl64", "vlp16", "os1-16"):
            for name in ("residential", "street", "motorway"):
                yield Case(f"{name}:{lidar}", seed, FEW_BEAMS)


def worker(path: Path, truth_file: str, method: str) -> None:
    """One run of one method: its row as JSON on stdout."""
    logging.getLogger("lslam").setLevel(logging.ERROR)
    sequence = open_sequence(path)
    if truth_file:
        truth = of_reference(read_trajectory(Path(truth_file)), sequence)
    else:
        given = sequence.ground_truth
        assert given is not None
        truth = given.poses[_nearest(given.stamps_ns, sequence)]
    truth = se3.relative(truth[0], truth)
    row: dict[str, Any] = {"method": method, "n": len(sequence)}
    if method in BESIDE:
        scans = Traced(sequence)
        poses, seconds = drive(method, (scans.scan(i).points for i in range(len(scans))))
        row |= {"status": "done", "bridged": 0, "degenerate": 0}
    else:
        poses, seconds, facts = of_ours(sequence, method)
        row |= facts
    step = configured(method).input.skip_frames if method not in BESIDE else 1
    matched = truth[::step][: len(poses)]
    row |= scores(poses, matched) | {
        "ms": 1e3 * float(np.median(seconds)),
        "p95": 1e3 * float(np.percentile(seconds, 95)),
    }
    if method == "icp":
        row["lost_starts"], row["blind_starts"] = lost_starts(sequence, truth)
    print(json.dumps(row))


def of_reference(reference: Trajectory, sequence: Sequence) -> NDArray[np.float64]:
    """Poses of a reference, whose clock begins at midnight, at the stamps of the scans."""
    return poses_at(reference.stamps_ns, reference.poses, sequence.stamps_ns % DAY_NS)


def _nearest(stamps_ns: NDArray[np.int64], sequence: Sequence) -> NDArray[np.int64]:
    """Index of the true pose of each scan."""
    used = sequence.stamps_ns
    after = np.clip(np.searchsorted(stamps_ns, used), 1, len(stamps_ns) - 1)
    return np.where(used - stamps_ns[after - 1] < stamps_ns[after] - used, after - 1, after)


def configured(method: str, *more: str) -> Any:
    key = "preset" if method in known_presets() else "method"
    # One thread: what is prepared for the next scan would otherwise slow this one's registration.
    settings = [f"odometry.{key}={method}", "input.threads=1", *more]
    return load_config(None, settings, {})


def of_ours(sequence: Sequence, method: str) -> tuple[NDArray[np.float64], NDArray[np.float64], dict[str, Any]]:
    """Poses, seconds per scan without reading, and what became of the scans."""
    ended: list[RunOutcome] = []
    kept: Any = Traced(sequence)
    status = "done"
    try:
        more = ON_THE_CLIMB.get(method, ()) if sequence.name.startswith("climbing") else ()
        run(kept, configured(method, *more), watch=Watch(on_end=ended.append))
    except RunFailedError:
        status = "diverged"
    results = ended[-1].record.results
    seconds = np.array([sum(s for stage, s in r.stages.items() if stage != "read") for r in results])
    stages = {name: 1e3 * float(np.median([r.stages.get(name, 0.0) for r in results])) for name in results[-1].stages}
    facts = {
        "status": status,
        "bridged": sum(r.status != "ok" for r in results),
        "degenerate": sum(len(r.degenerate) > 0 for r in results),
        "stages_ms": stages,
    }
    return np.stack([r.T_world_lidar for r in results]), seconds, facts


def scores(poses: NDArray[np.float64], truth: NDArray[np.float64]) -> dict[str, float]:
    """Errors in m and deg; `thesis_rmse` after equation 2.14 of Girolimetto."""
    e = poses[:, :3, 3] - truth[:, :3, 3]
    spread = np.linalg.svd(truth[:, :3, 3] - truth[:, :3, 3].mean(0), compute_uv=False)
    origin = float(np.sqrt(np.mean(np.sum(e**2, axis=1))))
    along = float(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum())
    return {
        # About a straight line the alignment may roll as it likes.
        "ate": origin if spread[1] < 0.01 * spread[0] else ate(poses, truth), "origin": origin,
        "rot_rpe": rotation_rpe(poses, truth),
        "thesis_rmse": float(np.sqrt(np.mean(e**2))), "length": along, "first": float(np.linalg.norm(e[1])),
    }  # fmt: skip


def lost_starts(sequence: Sequence, truth: NDArray[np.float64]) -> tuple[int, int]:
    """Starts at every third scan, of `STARTS`, that end 0.1 m or more from where a start at the true motion ends.

    Not from the truth: on distorted scans of a hand-held sensor both are wrong by as much. The second number is how many
    of them were flagged: nothing observes the direction in which they are off, as between bare walls.
    """
    lost = blind = 0
    for first in np.linspace(0, len(sequence) - 1 - 3 * STRIDE, STARTS).astype(int):
        step = se3.relative(truth[first], truth[first + STRIDE])
        ends = []
        for prior in (np.eye(4), step):
            registration = Registration()
            registration.register(sequence.scan(int(first)).points, np.eye(4))
            ends.append(registration.register(sequence.scan(int(first) + STRIDE).points, prior))
        apart = ends[0].T_world_lidar[:3, 3] - ends[1].T_world_lidar[:3, 3]
        away = float(np.linalg.norm(apart))
        if ends[0].ok and away < 0.1:
            continue
        lost += 1
        blind += bool(ends[0].ok and np.linalg.norm(ends[0].degenerate[:, :3] @ apart) > 0.9 * away)
    return lost, blind


def simulated(case: Case, scans: int, is_distorted: bool, out: Path) -> Path:
    """The folder of the case's scans, recorded now unless it is there."""
    name, _, length = case.name.partition("@")
    name, _, lidar = name.partition(":")
    assert case.seed is not None
    given: dict[str, Any] = {"seed": case.seed, "lidar": lidar or None, "motion_compensated": not is_distorted}
    if not length:
        given["count"] = min(scans, len(simulate(name, **given)))
    folder = out / "simulated" / f"{case.key('')}{'d' if is_distorted else 'c'}"
    recorded = folder / "sequences" / NUMBER
    return recorded if recorded.is_dir() else record(simulate(name, **given), folder, resume=folder.is_dir()).sequence


def fill(args: argparse.Namespace) -> None:
    rows = args.out / "rows"
    rows.mkdir(parents=True, exist_ok=True)
    chosen = args.methods.split(",") if args.methods else None
    only = args.only.split(",") if args.only else None
    for case in cases(args.recordings, tuple(int(s) for s in args.seeds.split(","))):
        methods = [m for m in case.methods if chosen is None or m in chosen]
        if args.distorted:
            methods = [m for m in methods if m not in BESIDE]
        missing = [m for m in methods if not (rows / f"{case.key(m)}.json").is_file()]
        if not missing or (only is not None and case.name not in only):
            continue
        truth = ""
        if case.seed is None:
            path = args.recordings / RECORDINGS[case.name]
            truth = str(path / "reference_lidar.tum") if (path / "reference_lidar.tum").is_file() else ""
        else:
            path = simulated(case, args.scans, args.distorted, args.out)
        for method in missing:
            one(case, method, path, truth, rows)
        if case.seed is not None and not args.keep:
            shutil.rmtree(args.out / "simulated")


def one(case: Case, method: str, path: Path, truth: str, rows: Path) -> None:
    """Run a worker and keep its row; a worker that dies is a row too."""
    began = time.monotonic()
    call = [sys.executable, __file__, str(path), "--worker", method, "--truth", truth]
    done = subprocess.run(call, capture_output=True, text=True, check=False)
    row: dict[str, Any] = {"method": method, "status": "failed"}
    if done.returncode == 0:
        row = json.loads(done.stdout.splitlines()[-1])
    else:
        row["reason"] = (done.stderr.strip().splitlines() or ["no word"])[-1][:200]
    row |= {"case": case.name, "seed": case.seed, "load": os.getloadavg()[0]}
    part = rows / f"{case.key(method)}.part"
    part.write_text(json.dumps(row))
    part.rename(part.with_suffix(".json"))
    said = f"ATE {row['ate']:.4f} m, {row['ms']:.1f} ms" if "ate" in row else row["reason"]
    print(f"{case.name} {case.seed} {method}: {row['status']}, {said} ({time.monotonic() - began:.0f} s)", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--recordings", type=Path)
    parser.add_argument("--seeds", default="0,1,2")
    parser.add_argument("--scans", type=int, default=300)
    parser.add_argument("--methods", help="only these")
    parser.add_argument("--only", help="only these cases")
    parser.add_argument("--distorted", action="store_true")
    parser.add_argument("--keep", action="store_true", help="the simulated scans")
    parser.add_argument("--report", action="store_true", help="run nothing")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    parser.add_argument("--truth", default="", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.worker:
        worker(args.out, args.truth, args.worker)
        return
    if not args.report:
        fill(args)
    print(report(args.out / "rows"))


if __name__ == "__main__":
    main()
