"""What a Dask cluster adds to every run of a batch, and what it leaves behind (issue 18: under 0.2 s a run, 1,000 runs, no leak).

    python tests/benchmarks/scheduling.py [--workers 2 4 8] [--runs 200] [--sleep 0.5] [--long 1000] [--disturb]

Recordings that only sleep, read by a reader of another package as any reader is, go through `lslam batch --scheduler` to a
scheduler and workers that are processes of their own. `whole` is what a worker did not sleep, per run; `in the run` what of it
lies between a run's begin and end (folder, files, imports), and `scheduling` the rest: sending, the archive that comes home, its
row of the results, and waiting for them. Workers beyond the cores slow each other down within the run, not here.

`--long N`: so many runs without sleep, and memory and open files of scheduler, workers and client after a tenth and at the end.
`--disturb`: a worker is killed after a third of the runs, the scheduler after two thirds and started anew.
"""

from __future__ import annotations

import argparse
import csv
import os
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from lslam.studies.results_csv import read_state

LIMIT_S = 0.2
GROWTH_MB = 50.0
READER = """
import time
from pathlib import Path
import numpy as np
from lslam.core.types.sequence import Calibration
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
FILE = "sleep.txt"
GRID = np.stack(np.meshgrid(np.arange(1, 21), np.arange(1, 21), [0.0]), -1).reshape(-1, 3).astype(np.float32)
class Sleeping:
    kind, rate_hz, motion_compensated, ground_truth, imu, gnss = "sleeping", 10.0, True, None, None, None
    def __init__(self, path):
        self.name, self.path, self.calibration, self.notes, self.problems = path.name, path, Calibration(), [], []
        self.stamps_ns = np.arange(2, dtype=np.int64) * 100_000_000
        self.seconds = float((path / FILE).read_text())
    def __len__(self):
        return 2
    def scan(self, index):
        seconds, self.seconds = self.seconds, 0.0  # once a run, which reads its first scans several times
        time.sleep(seconds)
        return Scan(GRID, int(self.stamps_ns[index]), index)
class Still(Traits):
    def prepare(self, scan):
        return None
    def register(self, scan, prepared, prior):
        return ScanResult(scan.index, scan.stamp_ns, np.eye(4))
    def warm_up(self):
        return None
def locate(path):
    return (path, "") if (path / FILE).is_file() else None
def open_folder(path, overrides, rest):
    return Sleeping(path)
def still(config):
    return Still()
"""
BATCH = """
[config]
map.write = false
report.html = false
loops.use = false

[[jobs]]
sequences = [{sequences}]
methods = ["still"]
"""


def install(site: Path) -> None:
    """The package with the sleeping reader and a method that does nothing, as pip would leave it."""
    info = site / "sleeper-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: sleeper\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[lslam.readers]\nsleeper = sleeper\n\n[lslam.methods]\nstill = sleeper:still\n"
    )
    (site / "sleeper.py").write_text(READER)


def write_batch(folder: Path, runs: int, seconds: float) -> Path:
    """A batch of so many recordings that sleep."""
    paths = []
    for k in range(runs):
        path = folder / f"rec{k:05d}"
        path.mkdir(parents=True)
        (path / "sleep.txt").write_text(str(seconds))
        paths.append(f'"{path}"')
    file = folder / "jobs.toml"
    file.write_text(BATCH.format(sequences=", ".join(paths)))
    return file


@dataclass
class Net:
    """A scheduler and its workers, each a process of its own."""

    site: Path
    count: int
    port: int = 0
    scheduler: subprocess.Popen[bytes] | None = None
    others: list[subprocess.Popen[bytes]] = field(default_factory=list)

    @property
    def address(self) -> str:
        return f"tcp://127.0.0.1:{self.port}"

    def environment(self) -> dict[str, str]:
        path = os.pathsep.join(filter(None, [str(self.site), os.environ.get("PYTHONPATH", "")]))
        return os.environ | {"PYTHONPATH": path, "NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}

    def start(self, *words: object) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-m", *map(str, words)], env=self.environment(), stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL, start_new_session=True,
        )  # fmt: skip

    def start_scheduler(self) -> None:
        self.scheduler = self.start(
            "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", self.port, "--no-dashboard"
        )

    def start_workers(self) -> None:
        for _ in range(self.count):
            self.others.append(
                self.start(
                    "distributed.cli.dask_worker", self.address, "--nthreads", 1, "--no-dashboard", "--local-directory",
                    self.site / "scratch",
                )
            )  # fmt: skip

    def worker_pids(self) -> list[int]:
        """Those that do the work: the children of the nannies."""
        return [pid for nanny in self.others for pid in working(children(nanny.pid))]


@contextmanager
def net(site: Path, count: int) -> Iterator[Net]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    made = Net(site, count, port)
    try:
        made.start_scheduler()
        made.start_workers()
        yield made
    finally:
        for process in filter(None, [*made.others, made.scheduler]):
            end(process)


def end(process: subprocess.Popen[bytes], with_signal: int = signal.SIGTERM) -> None:
    """End a process that was started here, and its session with it."""
    for said in (with_signal, signal.SIGKILL):
        try:
            os.killpg(process.pid, said)
            process.wait(10)
        except (ProcessLookupError, subprocess.TimeoutExpired):
            continue


def children(pid: int) -> list[int]:
    """Of any of its threads."""
    found = []
    for path in Path(f"/proc/{pid}/task").glob("*/children"):
        found += [int(word) for word in path.read_text().split()]
    return found


def working(pids: list[int]) -> list[int]:
    """Without the process that only tracks resources."""
    return [pid for pid in pids if b"resource_tracker" not in Path(f"/proc/{pid}/cmdline").read_bytes()]


def memory_mb(pid: int) -> float:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def open_files(pid: int) -> int:
    return len(os.listdir(f"/proc/{pid}/fd"))


def states_in(out: Path) -> int:
    return len(list((out / "runs").glob("*/*.json"))) if (out / "runs").is_dir() else 0


Sizes = dict[str, tuple[float, int]]


def sizes(made: Net, client: int) -> Sizes:
    """MB and open files, the largest of the workers."""
    assert made.scheduler is not None
    own = {"scheduler": made.scheduler.pid, "client": client}
    found = {name: (memory_mb(pid), open_files(pid)) for name, pid in own.items()}
    workers = [(memory_mb(pid), open_files(pid)) for pid in made.worker_pids()]
    return found | {"worker": (max(m for m, _ in workers), max(n for _, n in workers))}


@dataclass
class Batch:
    """One batch: what it took, and the sizes on the way."""

    wall_s: float
    run_s: list[float]
    rows: list[dict[str, str]]
    early: Sizes = field(default_factory=dict)
    late: Sizes = field(default_factory=dict)


def run_batch(made: Net, file: Path, out: Path, runs: int, disturb: bool = False) -> Batch:
    """Make it by the command, and watch. The wall time begins with the first run that ends and leaves that one out."""
    words = ["lslam", "batch", str(file), "--scheduler", made.address, "--out", str(out), "-q"]
    client = made.start(*words)
    to_come = [(runs // 3, "a worker"), (2 * runs // 3, "the scheduler")] if disturb else []
    batch, first, done = Batch(0.0, [], []), (0.0, 0), 0
    while client.poll() is None:
        time.sleep(0.02)
        seen, now = states_in(out), time.perf_counter()
        if seen and not first[1] and seen >= made.count:  # every worker has its imports behind it
            first = (now, seen)
        if seen > done:
            done, batch.wall_s = seen, now - first[0]
            if not batch.early and done >= runs // 10:
                batch.early = sizes(made, client.pid)
            elif done >= runs - made.count and client.poll() is None:
                batch.late = sizes(made, client.pid)
        if to_come and done >= to_come[0][0]:
            disturbed(made, to_come.pop(0)[1], done)
    if client.returncode != 0:
        raise SystemExit(f"the batch ended with {client.returncode}")
    in_order = sorted((out / "runs").glob("*/*.json"), key=lambda path: path.stat().st_mtime_ns)
    states = [read_state(path) for path in in_order]
    assert all(state is not None and state.status in ("done", "degraded") for state in states), states[:3]
    batch.run_s = [state.seconds for state in states if state is not None][first[1] :]
    with (out / "results.csv").open() as stream:
        batch.rows = list(csv.DictReader(stream))
    return batch


def disturbed(made: Net, whom: str, done: int) -> None:
    assert made.scheduler is not None
    if whom == "a worker":
        os.kill(made.worker_pids()[0], signal.SIGKILL)
    else:
        end(made.scheduler, signal.SIGKILL)
        for nanny in made.others:
            end(nanny)
        made.others.clear()
        made.start_scheduler()
        made.start_workers()
    print(f"{whom} was killed after {done} runs", flush=True)


def overhead(args: argparse.Namespace, folder: Path) -> None:
    print(f"{'workers':>7s}{'runs':>6s}{'wall s':>9s}{'whole':>9s}{'in the run':>12s}{'scheduling':>12s}   s per run")
    for count in args.workers:
        place = folder / f"w{count}"
        file = write_batch(place / "recordings", args.runs, args.sleep)
        with net(folder / "site", count) as made:
            batch = run_batch(made, file, place / "out", args.runs)
        runs = len(batch.run_s)
        whole = (batch.wall_s * count - args.sleep * runs) / runs
        inside = statistics.fmean(batch.run_s) - args.sleep
        said = "met" if whole - inside < LIMIT_S else "missed"
        print(
            f"{count:7d}{runs:6d}{batch.wall_s:9.2f}{whole:9.3f}{inside:12.3f}{whole - inside:12.3f}   "
            f"under {LIMIT_S} is {said}",
            flush=True,
        )


def leak(args: argparse.Namespace, folder: Path) -> None:
    file = write_batch(folder / "long" / "recordings", args.long, 0.0)
    with net(folder / "site", 2) as made:
        batch = run_batch(made, file, folder / "long" / "out", args.long)
    per_run = 2 * batch.wall_s / max(1, len(batch.run_s)) - statistics.fmean(batch.run_s)
    print(
        f"\n{args.long} runs without sleep on 2 workers in {batch.wall_s:.1f} s, {per_run:.3f} s of scheduling per run"
    )
    for name, (mb, files) in batch.early.items():
        late_mb, late_files = batch.late[name]
        said = "none" if late_mb - mb < GROWTH_MB and late_files - files < 10 else "LEAK"
        print(
            f"{name:10s}{mb:8.1f} -> {late_mb:6.1f} MB ({late_mb - mb:+6.1f}){files:6d} -> {late_files:4d} files  {said}"
        )


def disturb(args: argparse.Namespace, folder: Path) -> None:
    file = write_batch(folder / "disturbed" / "recordings", args.runs, args.sleep)
    out = folder / "disturbed" / "out"
    with net(folder / "site", 2) as made:
        batch = run_batch(made, file, out, args.runs, disturb=True)
    once = len({row["run"] for row in batch.rows}) == len(batch.rows) == args.runs
    whole = all((out / row["folder"] / "manifest.json").is_file() for row in batch.rows)
    parts = [*out.rglob("*.part")]
    print(f"{len(batch.rows)} rows, each once: {once}; all run folders whole: {whole}; half-written: {len(parts)}")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", type=int, nargs="*", default=[2, 4, 8])
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--sleep", type=float, default=0.5)
    parser.add_argument("--long", type=int, default=0)
    parser.add_argument("--disturb", action="store_true")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="lslam-scheduling-") as folder:
        install(Path(folder) / "site")
        if args.workers:
            overhead(args, Path(folder))
        if args.long:
            leak(args, Path(folder))
        if args.disturb:
            disturb(args, Path(folder))


if __name__ == "__main__":
    main()
