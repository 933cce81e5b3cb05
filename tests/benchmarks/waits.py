"""What somebody waits for, in milliseconds on this machine: the help, a server that sleeps, a scan that joins the merged map.

    python tests/benchmarks/waits.py SEQUENCE [--scans 50]

Each against what was asked of it once: 300 ms for `lslam --help` (best of ten), 500 ms for a drive of 200 poses past a server
that never answers, 50 ms for a scan of SEQUENCE in the merged map (median). The tests count the work behind these instead:
clocks on a busy machine fail without a fault.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from lslam.core.config.backend import OsmConfig
from lslam.io.readers import open_sequence
from lslam.maps.merge import MapMerger
from lslam.osm.bounds import Bounds
from lslam.osm.source import OsmBuffer


def help_ms(tries: int = 10) -> float:
    """Of the best try."""
    spent = []
    for _ in range(tries):
        began = time.perf_counter()
        subprocess.run([sys.executable, "-m", "lslam", "--help"], capture_output=True, check=True)
        spent.append(time.perf_counter() - began)
    return 1e3 * min(spent)


def sleeping_server_ms(poses: int = 200) -> float:
    """Of a whole drive, a pose every 2 m."""
    gate = threading.Semaphore(0)

    def fetch(bounds: Bounds) -> dict[str, Any]:
        gate.acquire()
        return {"elements": []}

    began = time.perf_counter()
    with OsmBuffer(fetch, np.array([49.0, 8.4, 110.0]), OsmConfig()) as buffer:
        for k in range(poses):
            buffer.ask(np.array([2.0 * k, 0.0]))
        spent = time.perf_counter() - began
    gate.release(poses)
    return 1e3 * spent


def merge_ms(drive: Path, scans: int) -> float:
    """Of a scan, the median; all of them at one place, so that voxels are found as often as made."""
    sequence, merger, spent = open_sequence(drive), MapMerger(0.2, 2.0, 80.0), []
    for k in range(min(scans, len(sequence))):
        points = np.ascontiguousarray(sequence.scan(k).points)
        began = time.perf_counter()
        merger.add(points, np.eye(4))
        spent.append(time.perf_counter() - began)
    return 1e3 * float(np.median(spent))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--scans", type=int, default=50)
    given = parser.parse_args()
    rows = [
        ("lslam --help", help_ms(), 300.0),
        ("a drive past a sleeping server", sleeping_server_ms(), 500.0),
        ("a scan into the merged map", merge_ms(given.sequence, given.scans), 50.0),
    ]
    print("| what | ms | at most |")
    print("|---|---|---|")
    for name, spent, most in rows:
        print(f"| {name} | {spent:.1f} | {most:g} |")


if __name__ == "__main__":
    main()
