"""Time per scan of our methods beside their peers, and of whole processes, on the same scans; wall and CPU.

    python tests/benchmarks/speed.py SEQUENCE... [--rounds 5] [--scans N] [--methods icp,kiss-icp] [--write docs/results.md]

Every run is a process of its own; methods and sequences alternate within a round, there and back, and ratios are taken
round by round, so that a machine whose speed drifts does not decide. Each scan is read and converted before it is timed.
The processes are `lslam run` with its map, loops and report, and kiss-icp's own program with its own reader, on the same
folder of .bin files, without stamps or times of points.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import platform
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import tables
from numpy.typing import NDArray
from peers import CORES, LOOKED_AT, OURS, PEERS, Beginning, timed
from recorded import PLACES
from speed_tables import Rounds, rows_of_processes, rows_of_ratios, rows_of_times, rows_published

from lslam.io.readers import open_sequence

Floats = NDArray[np.float64]
INSIDE = ("velodyne_points/data", "velodyne", "data", ".")
WARM_UP = 12


def name_of(path: Path) -> str:
    """As the other tables name it."""
    return next((name for name, place in PLACES.items() if place.name == path.name), open_sequence(path).name)


def worker(method: str, path: Path, scans: int, answer: Path) -> None:
    """One run of one method; seconds per scan go to a file, for cores print."""
    logging.getLogger("lslam").setLevel(logging.ERROR)
    sequence = open_sequence(path)
    first = [sequence.scan(i) for i in range(min(LOOKED_AT, len(sequence)))]
    peer = PEERS[method](Beginning(first, sequence.imu, sequence.calibration.T_lidar_imu))
    _, seconds = timed(peer, (sequence.scan(i) for i in range(min(scans, len(sequence)))))
    answer.write_text(json.dumps({"threads": peer.threads, "seconds": seconds.tolist()}))


def measured(method: str, path: Path, scans: int) -> tuple[Floats, int]:
    """Seconds (scans, 2) of a process of its own, and its threads."""
    with tempfile.TemporaryDirectory() as folder:
        answer = Path(folder) / "answer.json"
        command = [sys.executable, __file__, str(path), "--worker", method, "--scans", str(scans), "--answer", answer]
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
        if ended.returncode:
            sys.exit(f"{method} on {path.name} ended with {ended.returncode}:\n{ended.stderr[-2000:]}")
        found = json.loads(answer.read_text())
    return np.array(found["seconds"]), found["threads"]


def scans_of(path: Path) -> Path | None:
    """The folder of .bin files of a sequence, which kiss-icp's generic reader takes without further packages."""
    return next((path / inside for inside in INSIDE if any((path / inside).glob("*.bin"))), None)


def commands(path: Path, scans: int, out: Path) -> dict[str, list[str]]:
    """Programs by what a table calls them; ours first."""
    lslam = [sys.executable, "-m", "lslam", "run", str(path), "--count", str(scans), "--out", str(out / "run")]
    kiss = str(Path(sys.executable).with_name("kiss_icp_pipeline"))
    return {
        "lslam run": [*lslam, "--overwrite", "-q"],
        "kiss_icp_pipeline": [kiss, str(path), "-n", str(scans)],
        "lslam run --method kiss-icp": [*lslam, "--method", "kiss-icp", "--overwrite", "-q"],
    }


def spent(command: list[str], out: Path) -> tuple[float, float]:
    """Seconds of a process by the wall and by the CPU, those that it waited for included."""
    began = time.perf_counter()
    with (out / "said").open("w") as said:
        child = subprocess.Popen(
            command, stdout=said, stderr=subprocess.STDOUT, cwd=out, env={**os.environ, "kiss_icp_out_dir": str(out)}
        )
        _, status, used = os.wait4(child.pid, 0)
    wall, child.returncode = time.perf_counter() - began, os.waitstatus_to_exitcode(status)
    if child.returncode:
        sys.exit(f"{' '.join(command)} ended with {child.returncode}:\n{(out / 'said').read_text()[-2000:]}")
    return wall, used.ru_utime + used.ru_stime


def there_and_back(k: int, names: list[str]) -> list[str]:
    return names if k % 2 == 0 else names[::-1]


def registrations(paths: dict[str, Path], methods: list[str], rounds: int, scans: int) -> dict[str, dict[str, Rounds]]:
    runs: dict[tuple[str, str], list[Floats]] = {(name, m): [] for name in paths for m in methods}
    threads = {}
    for method in methods:
        # Kernels are compiled, files are in memory.
        measured(method, next(iter(paths.values())), WARM_UP)
    for k in range(rounds):
        for name in there_and_back(k, list(paths)):
            for method in there_and_back(k, methods):
                seconds, threads[method] = measured(method, paths[name], scans)
                runs[name, method].append(seconds)
                wall, cpu = 1e3 * np.median(seconds, axis=0)
                print(f"round {k + 1}  {name:22} {method:18} {wall:8.1f} ms  CPU {cpu:8.1f}", flush=True)
    return {name: {m: Rounds(tuple(runs[name, m]), threads[m]) for m in methods} for name in paths}


def processes(paths: dict[str, Path], rounds: int, scans: int) -> dict[str, dict[str, Floats]]:
    found: dict[str, dict[str, Floats]] = {}
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        for name, path in paths.items():
            inside = scans_of(path)
            if inside is None:
                print(f"{name}: no .bin files, which kiss_icp_pipeline could read")
                continue
            programs = commands(inside.resolve(), scans, out)
            runs: dict[str, list[tuple[float, float]]] = {what: [] for what in programs}
            for program in programs.values():
                spent(program, out)
            for k in range(rounds):
                for what in there_and_back(k, list(programs)):
                    runs[what].append(spent(programs[what], out))
                    print(f"round {k + 1}  {name:22} {what:28} {runs[what][-1][0]:6.2f} s", flush=True)
            found[name] = {what: np.array(seconds) for what, seconds in runs.items()}
    return found


def machine() -> str:
    """Cores, their name where the system tells it, and what else they do."""
    about = Path("/proc/cpuinfo")
    model = re.search(r"^model name\s*: (.+)$", about.read_text(), re.MULTILINE) if about.exists() else None
    return f"{CORES} cores ({model[1] if model else platform.machine()}), load {os.getloadavg()[0]:.1f} before"


def print_registrations(found: dict[str, dict[str, Rounds]], rounds: int, about: str, write: Path | None) -> None:
    lengths = ", ".join(f"{name}: {len(next(iter(by.values())).rounds[0])}" for name, by in found.items())
    count = rounds * sum(map(len, found.values()))
    caption = (
        f"{count} runs, each a process of its own, in {rounds} alternating rounds; scans: {lengths}; {about}. Per scan: medians "
        "over the rounds of a run's median and 95th percentile, and CPU time of all threads together. Conversions to what a "
        "peer takes are not timed. kiss-icp, genz-icp and rko-lio: the compiled core alone, -python: as its users call it."
    )
    header = ["scans", "method", "threads", "ms", "p95", "p95 / median", "CPU ms"]
    tables.table("speed", caption, header, [r for n, by in found.items() for r in rows_of_times(n, by)], write)
    caption = f"The same runs: time of ours over that of the peer, round by round, median (least to largest); {rounds} rounds."
    rows = [r for n, by in found.items() for r in rows_of_ratios(n, by)]
    tables.table("speed-ratios", caption, ["scans", "ours", "peer", "wall", "CPU"], rows, write)
    caption = "The same runs beside published times of other machines, ms per scan, which no ratio is drawn from."
    header = ["ours", "here, ms", "system", "published, ms", "threads", "on", "source"]
    tables.table("speed-published", caption, header, rows_published(found), write)


def print_processes(found: dict[str, dict[str, Floats]], rounds: int, about: str, write: Path | None) -> None:
    count = rounds * sum(map(len, found.values()))
    caption = (
        f"{count} runs of whole processes in {rounds} alternating rounds, from a folder of .bin files to the trajectory, of "
        f"lslam also loops, map and report: s, and lslam run over the other, median (least to largest); {about}."
    )
    header = ["scans", "command", "wall", "CPU", "ratio, wall", "ratio, CPU"]
    tables.table(
        "speed-processes", caption, header, [r for n, by in found.items() for r in rows_of_processes(n, by)], write
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequences", nargs="+", type=Path)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--scans", type=int, default=10**6, help="of each sequence, from its first one on")
    parser.add_argument("--methods", default=",".join(PEERS), help=f"ours are {', '.join(OURS)}")
    parser.add_argument("--only", choices=("registrations", "processes"), help="one half of it")
    tables.offer(parser, seeds=None)
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    parser.add_argument("--answer", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.worker:
        worker(args.worker, args.sequences[0], args.scans, args.answer)
        return
    methods = args.methods.split(",")
    if set(methods) - set(PEERS):
        parser.error(f"--methods takes {', '.join(PEERS)}")
    paths, about = {name_of(path): path.resolve() for path in args.sequences}, machine()
    if args.only != "processes":
        print_registrations(registrations(paths, methods, args.rounds, args.scans), args.rounds, about, args.write)
    if args.only != "registrations":
        print_processes(processes(paths, args.rounds, args.scans), args.rounds, about, args.write)


if __name__ == "__main__":
    main()
