"""Deskew and IMU on distorted scans beside the peers': ATE and time per scan of each on the same sequence.

    python tests/benchmarks/inertial_peers.py [--scenarios walk,urban] [--seeds 100-104] [--write docs/results.md]
    python tests/benchmarks/inertial_peers.py SEQUENCE... [--scans 300]      sequences of one's own

Ours are `icp` with and without the IMU; kiss-icp and genz-icp deskew by constant velocity; rko-lio (pip install rko-lio)
takes the IMU. All in their defaults. The instant that a peer's pose is valid for is the scan's start, middle or end,
whichever scores best.
"""

from __future__ import annotations

import argparse
import logging
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import tables
from numpy.typing import NDArray

from lslam.core.config import load_config
from lslam.core.errors import LslamError
from lslam.core.types.scan import Scan
from lslam.core.types.sequence import Sequence
from lslam.core.types.trajectory import Trajectory
from lslam.evaluation.evaluate import evaluate
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.io.readers import open_sequence
from lslam.pipeline.run import run
from lslam.studies.subjects import Scene, simulate_once

Floats = NDArray[np.float64]
# Poses (N, 4, 4) in any world, and seconds per scan (N,).
Outcome = tuple[Floats, Floats]


def ours(sequence: Sequence, scans: int, method: str, use_imu: bool) -> Outcome:
    """A method of the house."""
    settings = [f"odometry.method={method}", f"imu.use={str(use_imu).lower()}", f"input.count={scans}"]
    results = run(sequence, load_config(None, settings, {})).record.results
    seconds = [sum(v for name, v in r.stages.items() if name != "read") for r in results]
    return np.stack([r.T_world_lidar for r in results]), np.array(seconds)


def times_of(scan: Scan, sequence: Sequence) -> Floats:
    """Seconds from the scan's stamp; evenly over a sweep that begins there where points have none."""
    if scan.times is None:
        return np.linspace(0.0, 1.0 / sequence.rate_hz, len(scan))
    return scan.times.astype(np.float64)


def shares_of(scan: Scan, sequence: Sequence) -> Floats:
    """The same as 0 to 1 of the sweep, which peers want."""
    times = times_of(scan, sequence) - scan.span.begin_s
    return np.asarray(times / max(float(times.max()), 1e-9))


def genz_icp(sequence: Sequence, scans: int) -> Outcome:
    """genz-icp with its deskew switched on where there is something to deskew."""
    from genz_icp.config import GenZConfig
    from genz_icp.genz_icp import GenZICP

    config = GenZConfig()
    config.data.deskew = not sequence.motion_compensated
    genz = GenZICP(config)
    poses, seconds = [], []
    for i in range(scans):
        scan = sequence.scan(i)
        points, shares = scan.points.astype(np.float64), shares_of(scan, sequence)
        began = time.perf_counter()
        genz.register_frame(points, shares)
        seconds.append(time.perf_counter() - began)
        poses.append(np.array(genz.last_pose))
    return np.stack(poses), np.array(seconds)


def rko_lio(sequence: Sequence, scans: int) -> Outcome:
    """rko-lio with the IMU; its first scan only begins the map."""
    from rko_lio.config import LIOConfig
    from rko_lio.lio import LIO

    imu, T_lidar_imu = sequence.imu, sequence.calibration.T_lidar_imu
    assert imu is not None
    assert T_lidar_imu is not None
    lio, told = LIO(LIOConfig(deskew=not sequence.motion_compensated)), 0
    poses, seconds = [], []
    for i in range(scans):
        scan = sequence.scan(i)
        stamps = scan.stamp_ns + np.round(1e9 * times_of(scan, sequence)).astype(np.int64)
        points = scan.points.astype(np.float64)
        began = time.perf_counter()
        while told < len(imu) and imu.stamps_ns[told] <= stamps.max():
            lio.add_imu_measurement(imu.accel[told], imu.gyro[told], int(imu.stamps_ns[told]), T_lidar_imu)
            told += 1
        lio.register_scan(points, stamps, np.eye(4))
        seconds.append(time.perf_counter() - began)
        poses.append(lio.pose().copy())
    return np.stack(poses), np.array(seconds)


METHODS: dict[str, tuple[bool, Callable[[Sequence, int], Outcome]]] = {
    # Whether the instant of the poses is known to be the start, and the method.
    "icp": (True, lambda s, n: ours(s, n, "icp", False)),
    "icp --imu": (True, lambda s, n: ours(s, n, "icp", True)),
    "kiss-icp": (False, lambda s, n: ours(s, n, "kiss-icp", False)),
    "genz-icp": (False, genz_icp),
    "rko-lio": (False, rko_lio),
}


def score(sequence: Sequence, truth: Trajectory, poses: Floats, is_at_start: bool) -> tuple[float, float]:
    """ATE rmse, m, under se3 and origin."""
    found = []
    for part in (0.0,) if is_at_start else (0.0, 0.5, 1.0):
        stamps = sequence.stamps_ns[: len(poses)] + round(1e9 * part / sequence.rate_hz)
        within = stamps <= truth.stamps_ns[-1]
        ate = evaluate(Trajectory(stamps[within], poses[within]), truth).ate
        found.append([t.rmse if (t := ate[name].translation) else float("nan") for name in ("se3", "origin")])
    best = np.nanmin(np.array(found), axis=0)
    return float(best[0]), float(best[1])


def truth_of(sequence: Sequence) -> Trajectory:
    """A simulation's own at 100 Hz, else the sequence's."""
    dense = sequence.path / "truth" / "trajectory_100hz.tum"
    truth = read_trajectory(dense) if dense.is_file() else sequence.ground_truth
    if truth is None:
        raise SystemExit(f"{sequence.path} has no ground truth")
    return truth


def scored(path: Path, scans: int, name: str) -> tuple[float, float]:
    """ATE se3, m, and ms per scan of one method; inf where it failed."""
    is_at_start, method = METHODS[name]
    sequence = open_sequence(path)
    count = min(scans, len(sequence))
    head = f"{sequence.name:20} {name:10} {count:4d}"
    try:
        poses, seconds = method(sequence, count)
    except (LslamError, ImportError, ValueError, RuntimeError) as error:
        print(f"{head} failed: {error}"[:120], flush=True)
        return float("inf"), float("nan")
    se3, origin = score(sequence, truth_of(sequence), poses, is_at_start)
    print(f"{head} {se3:9.4f} {origin:9.4f} {1e3 * np.median(seconds):8.1f}", flush=True)
    return se3, 1e3 * float(np.median(seconds))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequences", nargs="*", type=Path, help="in place of --scenarios")
    parser.add_argument("--scenarios", default="walk,urban,residential,open")
    parser.add_argument("--scans", type=int, default=100)
    parser.add_argument("--methods", default=",".join(METHODS))
    tables.offer(parser)
    given = parser.parse_args()
    logging.getLogger("lslam").setLevel(logging.ERROR)
    methods, seeds = given.methods.split(","), tables.numbers(given.seeds)
    print(f"{'sequence':20} {'method':10} {'n':>4} {'ATE se3':>9} {'origin':>9} {'ms':>8}")
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        groups: dict[str, list[Path]] = {path.stem: [path] for path in given.sequences}
        for scenario in [] if groups else given.scenarios.split(","):
            scene = Scene(scenario, given.scans, compensated=False)
            groups[scenario] = [simulate_once(scene, seed, Path(scratch)) for seed in seeds]
        for name, paths in groups.items():
            found = {method: [scored(path, given.scans, method)[0] for path in paths] for method in methods}
            rows.append([name, *(tables.spread(found[method], 4) for method in methods)])
    caption = (
        f"Scans that hold their motion, {given.scans} of each drive, {tables.seeds_named(seeds)}: ATE se3, m, median / worst. "
        "Peers in their defaults, by the instant of the sweep that suits them best; only rko-lio among them takes the IMU."
    )
    tables.table("inertial", caption, ["scenario", *methods], rows, given.write)


if __name__ == "__main__":
    main()
