"""What a long run costs as it goes on: a sequence driven to and fro, time per scan and memory by its length.

    python tests/benchmarks/long_run.py SEQUENCE FOLDER [--scans 50000] [--figure docs/long_run.png] [-- OPTIONS OF RUN]

SEQUENCE has the layout of KITTI odometry and compensated scans, so that driven backwards it is a drive too. Its scans
are linked to, not copied. FOLDER takes the linked sequence and the run, and is kept.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
import shutil
import subprocess
import sys
import time
from itertools import chain, cycle, islice
from pathlib import Path

import numpy as np

from lslam.io.readers import open_sequence

WINDOWS = 10
STAGES = ("read", "prepare", "register", "update", "keyframe", "back end: loops")


def to_and_fro(source: Path, folder: Path, count: int) -> Path:
    """`count` scans of a KITTI odometry folder, forwards and backwards by turns, without the turning points twice."""
    sequence = folder / "sequences" / "00"
    if sequence.exists():
        return sequence
    scans = sorted((source / "velodyne").iterdir())
    there = range(len(scans))
    order = list(islice(cycle(chain(there, reversed(there[1:-1]))), count))
    (sequence / "velodyne").mkdir(parents=True)
    for number, k in enumerate(order):
        (sequence / "velodyne" / f"{number:06d}.bin").symlink_to(scans[k].resolve())
    shutil.copy(source / "calib.txt", sequence)
    (sequence / "times.txt").write_text("".join(f"{0.1 * k:.6f}\n" for k in range(count)))
    (sequence / "sequence.toml").write_text(
        'name = "to and fro"\nmotion_compensated = true\nvertical_correction_deg = 0.0\nrate_hz = 10.0\n'
        'ground_truth = "../../poses/00.txt"\nground_truth_frame = "cam0"\n'
    )
    lines = (source.parents[1] / "poses" / f"{source.name}.txt").read_text().splitlines()
    (folder / "poses").mkdir()
    (folder / "poses" / "00.txt").write_text("".join(f"{lines[k]}\n" for k in order))
    return sequence


def run(sequence: Path, out: Path, words: list[str]) -> tuple[float, list[tuple[float, float]]]:
    """Seconds of `lslam run`, and its memory, MB, by time."""
    command = [sys.executable, "-m", "lslam", "run", str(sequence), "--out", str(out), "--overwrite", "-q", *words]
    began = time.monotonic()
    process = subprocess.Popen(command)
    memory: list[tuple[float, float]] = []
    while process.poll() is None:
        status = Path(f"/proc/{process.pid}/status").read_text()
        if (found := re.search(r"VmRSS:\s+(\d+)", status)) is not None:
            memory.append((time.monotonic() - began, int(found[1]) / 1e3))
        time.sleep(0.5)
    if process.returncode not in (0, 4):
        raise SystemExit(f"lslam run ended with {process.returncode}")
    return time.monotonic() - began, memory


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scans", type=int, default=50_000)
    parser.add_argument("--figure", type=Path)
    args, words = parser.parse_known_args()
    sequence = to_and_fro(open_sequence(args.sequence).path, args.folder, args.scans)
    out = args.folder / "run"
    seconds, memory = run(sequence, out, [word for word in words if word != "--"])
    with (out / "timing.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    cost = np.array([[float(row.get(stage) or 0) for stage in STAGES] for row in rows])
    manifest = json.loads((out / "manifest.json").read_text())
    print(f"{len(rows)} scans in {seconds:.0f} s, {len(rows) / 10 / seconds:.1f} x real time at 10 Hz")
    print("; ".join(f"{name} {value:.1f}" for name, value in manifest["timings"].items() if name.endswith("_s")))
    print("memory, MB: " + ", ".join(f"{name} {value:.0f}" for name, value in peaks(memory, manifest["timings"])))
    print("ms per scan, mean of each tenth: " + ", ".join(STAGES))
    for part in np.array_split(np.arange(len(rows)), WINDOWS):
        print(f"{part[0]:6d} to {part[-1]:6d} " + " ".join(f"{1e3 * value:7.2f}" for value in cost[part].mean(axis=0)))
    if args.figure is not None:
        draw(args.figure, cost, memory)


def peaks(memory: list[tuple[float, float]], timings: dict[str, float]) -> list[tuple[str, float]]:
    """Largest memory, MB, in the four quarters of odometry, and after it."""
    times, sizes = np.array(memory).T
    end = float(timings["odometry_s"])
    cuts = [*np.linspace(0, end, 5), np.inf]
    names = ("1st quarter of odometry", "2nd", "3rd", "4th", "after it")
    return [
        (name, float(sizes[(times >= low) & (times < high)].max(initial=0)))
        for name, low, high in zip(names, cuts[:-1], cuts[1:], strict=True)
    ]


def draw(path: Path, cost: np.ndarray, memory: list[tuple[float, float]]) -> None:
    """Time per scan by length, and memory by time."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (left, right) = pyplot.subplots(1, 2, figsize=(10, 3.2), constrained_layout=True)
    width = max(len(cost) // 100, 1)
    smooth = cost[: len(cost) // width * width].reshape(-1, width, len(STAGES)).mean(axis=1)
    left.stackplot(width * np.arange(len(smooth)), 1e3 * smooth.T, labels=STAGES)
    left.set(xlabel="scan", ylabel="ms per scan")
    left.legend(loc="upper left", fontsize=7, ncols=2)
    right.plot(*np.array(memory).T)
    right.set(xlabel="s since the start", ylabel="memory, MB", ylim=(0, None))
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
