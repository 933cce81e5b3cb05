"""Where the milliseconds of a method go, stage by stage, beside the floor, and what its slow scans have in common.

    python tests/benchmarks/stages.py SEQUENCE [--method icp] [--count 150]

One thread: nothing runs beside a stage. The floor is what no method can leave out: reading a scan, and one pass of all
its points through a hash of voxels.
"""

from __future__ import annotations

import argparse
import logging
import time

import numpy as np
from numpy.typing import NDArray

from lslam.core.config import load_config
from lslam.core.kernels import voxel
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.sequence import Sequence
from lslam.io.readers import open_sequence
from lslam.odometry import create_odometry
from lslam.odometry.base import Odometry
from lslam.odometry.frontend.register_scans import estimate
from lslam.registration.preprocessing.prepare import NO_TIMES

Floats = NDArray[np.float64]

# The first scans are registered coarse to fine, by design: they are no slow scans.
START = 10


class Beginning:
    """The first scans of a sequence, counted and timed as they are read; the floor's pass is timed beside."""

    def __init__(self, sequence: Sequence, count: int) -> None:
        self._sequence, self._count = sequence, min(count, len(sequence))
        self.reading, self.passing, self.points = (np.zeros(self._count) for _ in range(3))

    def __getattr__(self, name: str) -> object:
        return getattr(self._sequence, name)

    def __len__(self) -> int:
        return self._count

    def measure(self, leaf: float) -> None:
        """Read every scan and send its points once through voxels of `leaf`, m."""
        for i in range(self._count):
            began = time.perf_counter()
            points = self._sequence.scan(i).points
            read = time.perf_counter()
            voxel.centroids(points, NO_TIMES, leaf)
            self.reading[i], self.passing[i] = read - began, time.perf_counter() - read
            self.points[i] = len(points)


def line(name: str, seconds: Floats, whole: float) -> str:
    ms = 1e3 * seconds
    return f"{name:28} {np.median(ms):8.2f} {np.percentile(ms, 95):8.2f} {100 * np.median(seconds) / whole:7.0f} %"


def table(results: list[ScanResult], beginning: Beginning) -> None:
    used = results[START:]
    names = [name for name in used[-1].stages if name != "read"]
    stages = {name: np.array([r.stages.get(name, 0.0) for r in used]) for name in names}
    total = np.sum(list(stages.values()), axis=0)
    whole = float(np.median(total))
    print(f"{len(used)} scans of {np.median(beginning.points):.0f} points")
    print(f"{'':28} {'median':>8} {'p95 ms':>8} {'of total':>9}")
    for name, seconds in stages.items():
        print(line(name, seconds, whole))
    print(line("total", total, whole))
    print(line("floor: reading", beginning.reading[START:], whole))
    print(line("floor: one pass over voxels", beginning.passing[START:], whole))
    slow = total >= np.percentile(total, 95)
    print(
        f"\nthe slowest {slow.sum()} scans against the median, p95 / median of all {np.percentile(total, 95) / whole:.2f}"
    )
    facts = {
        "iterations": np.array([r.iterations for r in used], float),
        "source points": np.array([r.source_points for r in used], float),
        "points": beginning.points[START : START + len(used)],
        **{f"{name}, ms": 1e3 * seconds for name, seconds in stages.items()},
    }
    for name, values in facts.items():
        print(f"{name:28} {np.mean(values[slow]):10.2f} {np.median(values):10.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence")
    parser.add_argument("--method", default="icp")
    parser.add_argument("--count", type=int, default=150)
    args = parser.parse_args()
    logging.getLogger("lslam").setLevel(logging.ERROR)
    config = load_config(None, [f"odometry.method={args.method}"], {})
    beginning = Beginning(open_sequence(args.sequence), args.count)
    odometry: Odometry = create_odometry(config)
    odometry.warm_up()
    beginning.measure(config.preprocess.map_leaf)
    table(estimate(beginning, odometry, threads=1), beginning)  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
