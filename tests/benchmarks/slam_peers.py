"""Loops and pose graph beside kiss-slam's on the same scans: ATE, closures and time.

    python tests/benchmarks/slam_peers.py SEQUENCE... --venv FOLDER [--scans N]

kiss-slam pins numpy below 2.3, so it lives in the virtual environment FOLDER, which is made (pip install kiss-slam, some
300 MB) when it is not there. Both run in their defaults and without their maps. Seconds are those of the process, all its
threads, and of the wall; ours include reading the scans, kiss-slam gets them from a pipe and is not charged for that.
"""

from __future__ import annotations

import argparse
import io
import logging
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from inertial_peers import score, shares_of, truth_of
from numpy.typing import NDArray

from lslam.core.config import load_config
from lslam.core.types.sequence import Sequence
from lslam.io.readers import open_sequence
from lslam.pipeline.run import run

WORKER = Path(__file__).with_name("kiss_slam_worker.py")


def environment(folder: Path) -> Path:
    """The python of kiss-slam's environment."""
    python = folder / "bin" / "python"
    if not python.exists():
        subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
        subprocess.run([str(python), "-m", "pip", "install", "-q", "kiss-slam", "libusb-package"], check=True)
    return python


def kiss_slam(sequence: Sequence, scans: int, python: Path) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    """Poses, seconds (process, wall) and closures."""
    mode = "as-is" if sequence.motion_compensated else "deskew"
    with subprocess.Popen(
        [str(python), str(WORKER), mode], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as worker:
        assert worker.stdin is not None
        assert worker.stdout is not None
        for i in range(scans):
            scan = sequence.scan(i)
            packed = io.BytesIO()
            np.savez(packed, points=scan.points, times=shares_of(scan, sequence))
            worker.stdin.write(len(packed.getvalue()).to_bytes(8, "little") + packed.getvalue())
        worker.stdin.close()
        answer = worker.stdout.read()
    if worker.returncode:
        raise SystemExit(f"kiss-slam ended with {worker.returncode}")
    found = np.load(io.BytesIO(answer))
    return found["poses"], found["seconds"], int(found["closures"])


def ours(sequence: Sequence, scans: int) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    began, began_wall = time.process_time(), time.perf_counter()
    record = run(sequence, load_config(None, [f"input.count={scans}"], {})).record
    seconds = np.array([time.process_time() - began, time.perf_counter() - began_wall])
    closures = sum(c.verdict == "accepted" for c in record.loops)
    return np.stack([r.T_world_lidar for r in record.results]), seconds, closures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequences", nargs="+")
    parser.add_argument("--venv", type=Path, required=True)
    parser.add_argument("--scans", type=int)
    given = parser.parse_args()
    logging.getLogger("lslam").setLevel(logging.ERROR)
    python = environment(given.venv)
    print(
        f"{'sequence':16} {'system':10} {'n':>5} {'closures':>8} {'ATE se3':>9} {'origin':>9} {'cpu ms':>7} {'wall ms':>8}"
    )
    for path in given.sequences:
        sequence = open_sequence(path)
        scans, truth = min(given.scans or len(sequence), len(sequence)), truth_of(sequence)
        ours(open_sequence(path), min(scans, 30))  # kernels, imports
        for name, found in (
            ("icp", lambda path=path, scans=scans: ours(open_sequence(path), scans)),
            ("kiss-slam", lambda path=path, scans=scans: kiss_slam(open_sequence(path), scans, python)),
        ):
            poses, seconds, closures = found()
            se3, origin = score(sequence, truth, poses, is_at_start=name == "icp" or sequence.motion_compensated)
            cpu, wall = 1e3 * seconds / scans
            head = f"{sequence.name:16} {name:10} {scans:5d} {closures:8d}"
            print(f"{head} {se3:9.4f} {origin:9.4f} {cpu:7.1f} {wall:8.1f}", flush=True)


if __name__ == "__main__":
    main()
