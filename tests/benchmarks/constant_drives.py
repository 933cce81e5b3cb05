"""Short drives on which numbers of a scan's path are told apart, and what a run on one of them says.

    python tests/benchmarks/constant_drives.py points FOLDER [KEY=VALUE ...]

prints, as JSON, the runs of a kind on the drives that `constants.py` left in the folder, by the package at hand.
"""

from __future__ import annotations

import hashlib
import json
import pickle
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from recorded import PLACES, TRUTH_AT_S
from scores import ate, origin

from lslam.core.config.config import load_config
from lslam.core.config.input import PreprocessConfig
from lslam.core.errors import LslamError
from lslam.core.geometry import se3, so3
from lslam.core.geometry.se3 import poses_at
from lslam.core.types.imu import ImuStream
from lslam.core.types.scan import Scan
from lslam.core.types.sequence import Calibration, Sequence
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.io.readers import open_sequence
from lslam.odometry.frontend.point_times import with_point_times
from lslam.pipeline.job import prepare
from lslam.pipeline.odometry_pass import estimate_poses
from lslam.pipeline.stages import in_folder
from lslam.pipeline.watch import Watch
from lslam.simulation.scenarios import simulate

Floats = NDArray[np.float64]

ROOT = Path(__file__).resolve().parents[2]


@dataclass
class Drive:
    """A `Sequence` in memory, whose truth is at the stamps of its scans."""

    name: str
    scans: list[Scan]
    rate_hz: float
    motion_compensated: bool | None
    ground_truth: Trajectory
    calibration: Calibration
    imu: ImuStream | None = None
    path: Path = Path("drive")
    kind: str = "memory"
    gnss: None = None
    notes: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    @property
    def is_aligned(self) -> bool:
        """Whether its truth is too noisy to begin from one pose."""
        return self.name in PLACES

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        return np.array([scan.stamp_ns for scan in self.scans])

    def __len__(self) -> int:
        return len(self.scans)

    def scan(self, index: int) -> Scan:
        return self.scans[index]

    __getitem__ = scan


def taken(name: str, sequence: Sequence, indices: Iterable[int], at_s: float = 0.0) -> Drive:
    """Some scans of a sequence, with the times of their points; true poses belong `at_s`, s, after their stamps."""
    sequence = with_point_times(sequence, PreprocessConfig())
    truth, step = sequence.ground_truth, list(indices)
    assert truth is not None
    scans = [replace(sequence.scan(i), index=k) for k, i in enumerate(step)]
    stamps = np.array([scan.stamp_ns for scan in scans])
    known = truth.stamps_ns + round(1e9 * at_s)
    inside = (stamps >= known[0]) & (stamps <= known[-1])
    scans = [replace(scan, index=k) for k, scan in enumerate(s for s, i in zip(scans, inside, strict=True) if i)]
    poses = poses_at(known, truth.poses, stamps[inside])
    # What was decided of the times is not asked again.
    is_compensated = scans[0].times is None
    return Drive(
        name, scans, sequence.rate_hz / (step[1] - step[0]), is_compensated,
        Trajectory(stamps[inside], poses, source="truth"), sequence.calibration, sequence.imu,
    )  # fmt: skip


def drives(folder: Path | None) -> Iterator[tuple[str, Callable[[], Drive]]]:
    """Names, and how each is made."""

    def simulated(scenario: str, lidar: str, seed: int, indices: Iterable[int], **words: Any) -> Callable[[], Drive]:
        def make() -> Drive:
            step = list(indices)
            line = simulate(scenario, seed=seed, lidar=lidar, count=max(step) + 1, **words)
            return taken(scenario, line, step)

        return make

    def real(place: str, count: int) -> Callable[[], Drive]:
        def make() -> Drive:
            assert folder is not None
            path = folder / PLACES[place]
            sequence = open_sequence(path)
            reference = path / "reference_lidar.tum"
            if reference.is_file():
                sequence.ground_truth = replace(read_trajectory(reference), stamps_ns=sequence.stamps_ns)
            return taken(place, sequence, range(count), TRUTH_AT_S.get(place, 0.0))

        return make

    yield "sample", lambda: taken("sample", open_sequence(ROOT / "sample_data"), range(8))
    if folder is not None:
        yield "real 0005", real("KITTI raw 0005", 15)
        yield "real KTH", real("MCD KTH day 06", 11)
    yield "carpark", simulated("carpark", "vlp16", 320, range(50), motion_compensated=False, static_start=1.0)
    yield "room", simulated("room", "vlp16", 321, range(30), motion_compensated=False)
    yield "walk", simulated("walk", "vlp16", 322, range(30), motion_compensated=False)
    yield "lights", simulated("lights", "vlp16", 323, range(60), motion_compensated=True)
    fast = {"motion_compensated": True, "speed": 30.0, "start_speed": 30.0}
    yield "motorway start", simulated("motorway", "os1-16", 324, range(12), **fast)
    yield "street thirds", simulated("street", "vlp16", 325, range(0, 45, 3), motion_compensated=True, speed=12.0)
    gap = [*range(15), *range(23, 38)]
    yield "urban gap", simulated("urban", "vlp16", 326, gap, motion_compensated=True)
    sensed = {"motion_compensated": False, "imu": "icm20948"}
    yield "walk imu", simulated("walk", "vlp16", 327, range(40), static_start=1.0, **sensed)
    yield "street imu", simulated("street", "vlp16", 328, range(40), **sensed)
    yield "quadrotor imu", simulated("quadrotor", "vlp16", 329, range(45), **sensed)


SHARED = ("sample", "real 0005", "real KTH", "carpark", "room", "walk", "lights")
RUNS: dict[str, tuple[tuple[str, str], ...]] = {
    "points": (
        *((name, "icp") for name in (*SHARED, "motorway start", "street thirds", "urban gap")),
        *((name, "loam") for name in ("carpark", "walk", "street thirds")),
    ),
    "features": tuple((name, "loam") for name in (*SHARED, "street thirds", "urban gap")),
    "imu": tuple((name, "icp") for name in ("walk imu", "street imu", "quadrotor imu")),
    "checks": tuple(
        (name, "icp") for name in ("real 0005", "carpark", "room", "walk", "lights", "motorway start", "urban gap")
    ),
}


def load(work: Path, recordings: Path | None, wanted: set[str]) -> dict[str, Path]:
    """The drives in the work folder, those made that are not there."""
    kept = {}
    for name, make in drives(recordings):
        path = work / f"{name}.pickle"
        if name in wanted and not path.is_file():
            print(f"making {name}", flush=True)
            drive = make()
            path.write_bytes(pickle.dumps(drive))
        if path.is_file():
            kept[name] = path
    return kept


def outcome(drive: Drive, method: str, settings: list[str]) -> dict[str, Any]:
    """Digests of poses, covariances and checks, errors, and what the run says of itself."""
    if drive.imu is not None:
        settings = [*settings, "imu.use=true"]
    config = load_config(settings=[f"odometry.method={method}", "loops.use=false", *settings], environ={})
    began = time.process_time()
    try:
        job = prepare(drive, config, None, "", Watch())
        with in_folder(job, None, False, False, None) as job:
            record = estimate_poses(job)
    except LslamError as error:
        return {"failed": str(error)[:80]}
    seconds = time.process_time() - began
    found, truth = record.trajectory.poses, drive.ground_truth.poses
    C = record.trajectory.covariances
    checks = [c for c in record.checks if c.is_conclusive]
    facts = {
        "poses": digest(found),
        "covariances": "" if C is None else digest(C),
        "checks": digest(np.array([[c.agreement, c.claimed_agreement, *c.sigma, *c.apart] for c in record.checks])),
        "error": (ate if drive.is_aligned else origin)(found, truth),
        "seconds": seconds,
        "ok": sum(r.status == "ok" for r in record.results),
        "checked": len(record.checks),
        "conclusive": len(checks),
        "state": job.manifest.outcome,
        "problems": len(job.manifest.problems),
    }
    if C is not None:
        T = truth[0] @ se3.inverse(found[0])
        placed, R = T @ found, np.kron(np.eye(2), T[:3, :3])
        e = np.concatenate(
            [placed[:, :3, 3] - truth[:, :3, 3], so3.log(placed[:, :3, :3] @ np.swapaxes(truth[:, :3, :3], 1, 2))], 1
        )[1:]
        held = np.isfinite(C[1:]).all(axis=(1, 2))
        if held.any():
            at = R @ C[1:][held] @ R.T
            facts["nees"] = (
                float(np.mean(np.einsum("ni,ni->n", e[held], np.linalg.solve(at, e[held][..., None])[..., 0]))) / 6
            )
    return facts


def digest(values: NDArray[Any]) -> str:
    return hashlib.sha256(np.ascontiguousarray(values).tobytes()).hexdigest()[:12]


def runs_of(work: Path, runs: str, settings: list[str]) -> None:
    """Print all runs of a kind, as the package at hand does them."""
    found: dict[str, Any] = {}
    for name, method in RUNS[runs]:
        path = work / f"{name}.pickle"
        if path.is_file():
            found[f"{name} {method}"] = outcome(pickle.loads(path.read_bytes()), method, settings)
    print(json.dumps(found))


if __name__ == "__main__":
    runs_of(Path(sys.argv[2]), sys.argv[1], sys.argv[3:])
