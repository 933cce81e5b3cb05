"""Time per scan of `icp` beside kiss-icp and small_gicp, on the same scans.

    python tests/benchmarks/speed.py SEQUENCE [--rounds 3] [--peers icp,kiss-icp,small-gicp]

Each run is a process of its own; runs alternate, and the ratios are taken round by round, so that a machine whose speed
drifts does not decide. The register call is timed whole: preprocessing, alignment, map update. Then whole `lslam run`
processes, map and report included, with each method in turn.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from peers import PEERS, drive

from lslam.readers import open_sequence


def worker(method: str, path: str) -> None:
    """One run of one peer: seconds per scan as JSON on stdout."""
    sequence = open_sequence(path)
    scans = [sequence.scan(i).points for i in range(len(sequence))]
    _, seconds = drive(method, scans)
    print(json.dumps(seconds.tolist()))


def register_calls(path: str, methods: list[str], rounds: int) -> None:
    times: dict[str, list[np.ndarray]] = {m: [] for m in methods}
    for _ in range(rounds):
        for m in methods:
            out = subprocess.run(
                [sys.executable, __file__, path, "--worker", m], capture_output=True, text=True, check=True
            )
            times[m].append(np.array(json.loads(out.stdout.splitlines()[-1])))
    medians = {m: np.array([np.median(t) for t in runs]) for m, runs in times.items()}
    print(f"register call, {len(times[methods[0]][0])} scans, {rounds} alternating rounds")
    print(f"{'method':14} {'median ms':>10} {'p95 ms':>8} {'p95/median':>11} {'icp / it':>9}")
    for m in methods:
        p95 = np.median([np.percentile(t, 95) for t in times[m]])
        ratio = np.median(medians["icp"] / medians[m])
        mid = np.median(medians[m])
        print(f"{m:14} {1e3 * mid:10.1f} {1e3 * p95:8.1f} {p95 / mid:11.2f} {ratio:9.3f}")


def whole_processes(path: str, rounds: int) -> None:
    walls: dict[str, list[float]] = {"icp": [], "kiss-icp": []}
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(rounds + 1):
            for m, wall in walls.items():
                out = Path(folder) / m
                command = [
                    sys.executable,
                    "-m",
                    "lslam",
                    "run",
                    path,
                    "--method",
                    m,
                    "--out",
                    str(out),
                    "--overwrite",
                    "-q",
                ]
                began = time.perf_counter()
                subprocess.run(command, capture_output=True, check=True)
                wall.append(time.perf_counter() - began)
    a, b = np.array(walls["icp"][1:]), np.array(walls["kiss-icp"][1:])
    print(
        f"whole process: icp {np.median(a):.2f} s, kiss-icp {np.median(b):.2f} s, median ratio {np.median(a / b):.3f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--peers", default=",".join(PEERS))
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.worker:
        worker(args.worker, args.sequence)
        return
    register_calls(args.sequence, args.peers.split(","), args.rounds)
    whole_processes(args.sequence, args.rounds)


if __name__ == "__main__":
    main()
