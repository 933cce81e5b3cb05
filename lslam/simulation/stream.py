"""Scans to disk while the next ones are traced; what is there already is not traced again."""

from __future__ import annotations

import hashlib
import json
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

import numpy as np

from lslam.formats.atomic import write_text
from lslam.formats.kitti_layout import scan_files, write_scan
from lslam.simulation.scenarios import SimulatedDrive
from lslam.types.scan import Scan
from lslam.untrusted import parse_json
from lslam.version import __version__

MARK = "simulation.json"
TRACERS = 2  # threads; Embree and NumPy let each other run
AHEAD = 4  # scans traced and not yet written, at most


def fingerprint(drive: SimulatedDrive) -> str:
    """What decides the bytes of a recording, as one digest: an unfinished one goes on only with the same."""
    said = {
        "version": __version__,
        "scenario": drive.scenario.model_dump(mode="json"),
        "lidar": asdict(drive.lidar),
        "seed": drive.seed,
        "scans": len(drive),
        "compensated": drive.motion_compensated,
    }
    digest = hashlib.sha256(json.dumps(said, sort_keys=True).encode())
    digest.update(drive.city.mesh.vertices.tobytes())
    digest.update(drive.vehicle.poses(drive.stamps_ns / 1e9).tobytes())
    return digest.hexdigest()


def read_mark(folder: Path) -> str | None:
    """The fingerprint of the recording that was begun in `folder`; None when there is none that could go on."""
    try:
        tree = parse_json((folder / MARK).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    mark = tree.get("fingerprint") if isinstance(tree, dict) else None
    return mark if isinstance(mark, str) else None


def write_mark(folder: Path, drive: SimulatedDrive) -> None:
    """Note in `folder` which recording is begun there."""
    write_text(folder / MARK, json.dumps({"fingerprint": fingerprint(drive)}))


def write_scans(drive: SimulatedDrive, folder: Path, on_scan: Callable[[int], None] | None = None) -> int:
    """Write every scan that is not in `folder` yet, as KITTI's .bin with times and rings beside; the number of points of all.

    `on_scan` is called with the index of every scan, in order, when it is on disk.
    """
    missing = [index for index in range(len(drive)) if not scan_files(folder, index)[1].is_file()]
    fresh = _traced(drive, missing)
    total = 0
    for index in range(len(drive)):
        points, beside = scan_files(folder, index)
        if beside.is_file():
            total += points.stat().st_size // 16
        else:
            scan = next(fresh)
            total += len(scan)
            # All rays of a compensated scan were fired at its stamp.
            times = np.zeros(len(scan), np.float32) if scan.times is None else scan.times
            write_scan(folder, index, scan.points, scan.intensity, times, scan.rings)
        if on_scan is not None:
            on_scan(index)
    return total


def _traced(drive: SimulatedDrive, indices: list[int]) -> Iterator[Scan]:
    """Scans in order, a few of them traced ahead; each has its own seed, so the order of tracing changes nothing."""
    waiting: deque[Future[Scan]] = deque()
    pool = ThreadPoolExecutor(TRACERS, thread_name_prefix="trace")
    try:
        for index in indices:
            waiting.append(pool.submit(drive.scan, index))
            if len(waiting) > AHEAD:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
