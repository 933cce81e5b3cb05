"""How fast an MCAP streams, uncompressed and zstd, and how much memory that takes.

    python tests/benchmarks/bag_reading.py SEQUENCE [--scans 500]

SEQUENCE is converted, its scans repeated until there are enough; each file is then read, all scans decoded, by a process of
its own. Its peak memory is that process' own, interpreter and libraries included; scans per second of its
processor time say what a busy machine hides.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.types.scan import Scan
from lslam.core.types.sequence import Sequence
from lslam.io.readers import open_sequence
from lslam.pipeline.convert.convert_sequence import convert_sequence


class Repeated:
    """A sequence whose scans begin again when they are through, without truth, IMU and GNSS; time goes on."""

    imu = gnss = ground_truth = None

    def __init__(self, sequence: Sequence, scans: int) -> None:
        self._sequence = sequence
        step = round(1e9 / sequence.rate_hz)
        self.stamps_ns: NDArray[np.int64] = sequence.stamps_ns[0] + step * np.arange(scans, dtype=np.int64)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._sequence, name)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def scan(self, index: int) -> Scan:
        found = self._sequence.scan(index % len(self._sequence))
        return replace(found, index=index, stamp_ns=int(self.stamps_ns[index]))


def worker(path: str) -> None:
    """Read every scan; facts as JSON on stdout."""
    began = time.perf_counter()
    sequence = open_sequence(path)
    opened, cpu = time.perf_counter(), time.process_time()
    points = 0
    for i in range(len(sequence)):
        points += len(sequence.scan(i))
    read, used = time.perf_counter(), time.process_time() - cpu
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3)
    facts = {
        "open_s": opened - began,
        "read_s": read - opened,
        "cpu_s": used,
        "scans": len(sequence),
        "points": points,
        "peak_mb": peak,
    }
    print(json.dumps(facts))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence")
    parser.add_argument("--scans", type=int, default=500)
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.worker:
        worker(given.sequence)
        return
    repeated: Any = Repeated(open_sequence(given.sequence), given.scans)
    print(
        f"{'file':14} {'MB':>7} {'scans':>6} {'points':>9} {'open s':>7} {'scans/s':>8} {'per CPU s':>9} {'peak MB':>8}"
    )
    with tempfile.TemporaryDirectory() as folder:
        for name, is_zstd in (("plain", False), ("zstd", True)):
            path = Path(folder) / f"{name}.mcap"
            convert_sequence(repeated, "mcap", path, is_zstd=is_zstd)
            size = path.stat().st_size / 1e6
            command = [sys.executable, __file__, str(path), "--worker"]
            out = subprocess.run(command, capture_output=True, text=True, check=True).stdout
            f = json.loads(out.splitlines()[-1])
            print(
                f"{name:14} {size:7.0f} {f['scans']:6d} {f['points'] / f['scans']:9.0f} {f['open_s']:7.2f} "
                f"{f['scans'] / f['read_s']:8.1f} {f['scans'] / f['cpu_s']:9.1f} {f['peak_mb']:8.0f}",
                flush=True,
            )
            path.unlink()


if __name__ == "__main__":
    main()
