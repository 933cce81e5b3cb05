"""A run that loses its map goes on in another: tied to the first where both show the same place, else in a frame of its own."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from stub_sequences import Stub, sample

import lslam
from lslam.backend.localization import locate
from lslam.core.config import Config, load_config
from lslam.core.errors import InterruptedRunError
from lslam.core.types.scan import Scan
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.odometry.frontend.checkpoints import CheckpointSchedule
from lslam.pipeline.watch import RunOutcome, Watch
from lslam.simulation.scenarios import SimulatedDrive, simulate

# 13 m/s in a bend: 1.5 s of scans are missing there.
COUNT, GAP, MISSING = 95, 30, 15


@dataclass
class Kept(Stub):
    """The scans at these positions of a drive at 10 Hz."""

    kept: tuple[int, ...] = field(default_factory=tuple)

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        return np.array(self.kept, np.int64) * 100_000_000

    @stamps_ns.setter
    def stamps_ns(self, value: NDArray[np.int64]) -> None:
        raise AttributeError(value)


def kept(stub: Stub, positions: list[int]) -> Kept:
    assert stub.ground_truth is not None
    scans: list[Scan | str] = []
    for index, position in enumerate(positions):
        scan = stub.scans[position]
        scans.append(replace(scan, index=index) if isinstance(scan, Scan) else scan)
    return Kept(scans, stub.ground_truth.select(positions), stub.calibration, kept=tuple(positions))


def gap() -> Kept:
    return kept(sample(COUNT), [i for i in range(COUNT) if not GAP <= i < GAP + MISSING])


def mirrored(begin: int, end: int, count: int) -> Stub:
    """From scan `begin` to `end` the world is another, which no motion leads to."""
    stub = sample(count)
    for i in range(begin, end):
        scan = stub.scans[i]
        assert isinstance(scan, Scan)
        stub.scans[i] = replace(scan, points=scan.points * np.float32([1, -1, 1]))
    return stub


def config(*settings: str) -> Config:
    return load_config(None, ["map.write=false", "loops.use=false", *settings], {})


def manifest(folder: Path) -> dict[str, Any]:
    document: dict[str, Any] = json.loads((folder / "manifest.json").read_text())
    return document


def columns(folder: Path) -> dict[str, list[str]]:
    head, *rows = [line.split(",") for line in (folder / "scans.csv").read_text().splitlines()]
    return {name: [row[i] for row in rows] for i, name in enumerate(head)}


def error(estimate: Trajectory, truth: Trajectory, part: slice) -> float:
    """m, largest error of the part when its first pose is the true one."""
    a, b = estimate.poses[part], truth.poses[part]
    off = np.linalg.inv(np.linalg.inv(a[0]) @ a) @ (np.linalg.inv(b[0]) @ b)
    return float(np.linalg.norm(off[:, :3, 3], axis=1).max())


@pytest.fixture(scope="module")
def gapped(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, RunOutcome]:
    out = tmp_path_factory.mktemp("gap") / "out"
    return out, lslam.run(gap(), config("report.html=true"), out=out)


def test_all_scans_after_a_gap_are_registered_and_tied_to_those_before(gapped: tuple[Path, RunOutcome]) -> None:
    out, outcome = gapped
    record = outcome.record
    assert columns(out)["status"] == ["ok"] * (COUNT - MISSING)
    assert columns(out)["segment"] == ["0"] * GAP + ["1"] * (COUNT - MISSING - GAP)
    assert set(columns(out)["frame"]) == {"0"}
    assert record.ground_truth is not None
    for part in (slice(GAP), slice(GAP, None), slice(None)):
        assert error(record.trajectory, record.ground_truth, part) < 0.1
    assert outcome.evaluation is not None
    assert outcome.evaluation.ate["se3"].translation.max < 0.03  # type: ignore[union-attr]
    # The tie is as sure as place search, and no scan behind it is surer.
    sigmas = np.sqrt([np.linalg.eigvalsh(r.covariance[:3, :3])[-1] for r in record.results if r.covariance is not None])
    assert sigmas[:GAP].max() < 0.05 < sigmas[GAP:].min()
    assert np.isfinite(sigmas).all()


@pytest.mark.parametrize("method", ["gicp", "vgicp", "loam"])
def test_a_second_of_missing_scans_in_a_bend_leads_no_method_to_a_place_that_looks_alike(method: str) -> None:
    drive = kept(sample(60), [i for i in range(60) if not GAP <= i < GAP + 10])
    evaluation = lslam.run(drive, config(f"odometry.method={method}")).evaluation
    assert evaluation is not None
    assert evaluation.ate["se3"].translation.max < 0.15  # type: ignore[union-attr]


def test_a_tie_is_named_wherever_a_run_speaks(gapped: tuple[Path, RunOutcome]) -> None:
    out, _ = gapped
    assert manifest(out)["status"] == "degraded"
    first, second = manifest(out)["segments"]
    assert (first["first"], first["last"], second["first"], second["last"]) == (0, GAP - 1, GAP, COUNT - MISSING - 1)
    assert (first["tied_by"], second["frame"]) == ("", 0)
    assert second["tied_by"].startswith("place search: ")
    (problem,) = manifest(out)["problems"]
    assert problem.startswith(
        f"tracking was lost before scan {GAP}; scans {GAP} to {COUNT - MISSING - 1}, segment 1: tied"
    )
    assert problem in (out / "report.html").read_text()


def test_a_run_killed_in_a_new_segment_ends_with_the_same_bytes(
    gapped: tuple[Path, RunOutcome], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(CheckpointSchedule, "is_due", True)
    left, out = [GAP + 8], tmp_path / "out"

    def step() -> None:
        left[0] -= 1

    watch = Watch(lambda name, total: None, step, lambda outcome: None, lambda: left[0] <= 0)
    with pytest.raises(InterruptedRunError):
        lslam.run(gap(), config("report.html=false"), out=out, watch=watch)
    lslam.run(gap(), config("report.html=false"), out=out, resume=True)
    assert manifest(out)["resumed_after_scans"][-1] > GAP
    for name in ("trajectory.tum", "covariances.npz", "scans.csv"):
        assert (out / name).read_bytes() == (gapped[0] / name).read_bytes()


def test_a_sliver_at_the_start_is_given_up_and_the_rest_stands_in_one_frame(tmp_path: Path) -> None:
    stub = sample(12)
    scan = stub.scans[0]
    assert isinstance(scan, Scan)
    stub.scans[0] = scan.select(np.flatnonzero(np.abs(np.arctan2(scan.points[:, 1], scan.points[:, 0])) < 0.02 * np.pi))
    outcome = lslam.run(stub, config(), out=tmp_path / "out")
    assert columns(tmp_path / "out")["frame"] == ["1"] + ["0"] * 11
    assert columns(tmp_path / "out")["status"][1:] == ["ok"] * 11
    assert outcome.evaluation is not None
    origin = outcome.evaluation.ate["origin"]
    assert origin.translation is not None
    assert (origin.translation.n, origin.translation.max < 0.05) == (11, True), "the sliver's pose has no error"
    covariances = outcome.record.trajectory.covariances
    assert covariances is not None
    assert np.isinf(np.diag(covariances[0])).all()
    assert np.isfinite(covariances[1:]).all()


def test_a_covered_sensor_at_the_start_leaves_the_rest_in_one_frame(tmp_path: Path) -> None:
    stub = sample(12)
    for i in range(4):
        stub.scans[i] = Scan(np.full((500, 3), 0.2, np.float32), i * 100_000_000, i)
    outcome = lslam.run(stub, config(), out=tmp_path / "out")
    assert columns(tmp_path / "out")["frame"] == ["1"] * 4 + ["0"] * 8
    assert outcome.evaluation is not None
    assert outcome.evaluation.ate["se3"].translation.max < 0.05  # type: ignore[union-attr]


def walk(*positions: int, seed: int = 41) -> Kept:
    """Scans of a walk through a town, by 16 beams."""
    drive = simulate("walk", seed=seed, lidar="vlp16", count=60)
    scans: list[Scan | str] = [replace(drive.scan(i), index=k) for k, i in enumerate(positions)]
    truth = drive.ground_truth.select(list(positions))
    return Kept(scans, truth, drive.calibration, motion_compensated=False, kept=positions)


def test_a_walk_too_short_for_two_keyframes_is_tied_by_most_of_what_one_sees(tmp_path: Path) -> None:
    outcome = lslam.run(walk(*range(13, 25), *range(45, 57)), config(), out=tmp_path / "out")
    assert columns(tmp_path / "out")["segment"] == ["0"] * 12 + ["1"] * 12
    assert set(columns(tmp_path / "out")["frame"]) == {"0"}
    record = outcome.record
    assert record.ground_truth is not None
    assert error(record.trajectory, record.ground_truth, slice(None)) < 0.15


def test_a_walk_of_another_town_is_not_tied(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The place that one side finds is not the one that the other finds, however little of it agrees."""
    monkeypatch.setattr(locate, "MAJORITY", 0.0)
    first, other = walk(*range(13, 25)), walk(*range(45, 57), seed=42)
    joined = replace(first, scans=[*first.scans, *other.scans], ground_truth=None, kept=(*first.kept, *other.kept))
    lslam.run(joined, config(), out=tmp_path / "out")
    assert columns(tmp_path / "out")["segment"] == ["0"] * 12 + ["1"] * 12
    assert len(set(columns(tmp_path / "out")["frame"])) == 2


@cache
def street() -> SimulatedDrive:
    return simulate("street", seed=7, lidar="vlp16", count=45, motion_compensated=False, imu="icm20948")


@pytest.mark.parametrize("method", ["icp", "fast-lio2"])
def test_a_run_with_an_imu_begins_a_segment_where_its_map_is_lost(
    method: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    traced = SimulatedDrive.scan

    def scan(self: SimulatedDrive, index: int) -> Scan:
        scan = traced(self, index)
        return scan if index < 30 else replace(scan, points=scan.points * np.float32([1, -1, 1]))

    monkeypatch.setattr(SimulatedDrive, "scan", scan)
    lslam.run(street(), config("imu.use=true", f"odometry.method={method}"), out=tmp_path / "out")
    segments = columns(tmp_path / "out")["segment"]
    assert segments[:30] == ["0"] * 30
    assert segments[-1] == "1"
    assert manifest(tmp_path / "out")["status"] == "degraded"


def test_a_segment_of_another_world_has_a_frame_of_its_own(tmp_path: Path) -> None:
    out = tmp_path / "out"
    stub = mirrored(0, 9, 26)
    outcome = lslam.run(stub, config("map.write=true"), out=out)
    assert manifest(out)["status"] == "degraded"
    assert columns(out)["frame"] == ["1"] * 9 + ["0"] * 17, "that of most scans is the trajectory's"
    assert len(read_trajectory(out / "trajectory_frame_1.tum", "tum")) == 9
    assert "frame 1, of their own" in (out / "trajectory.tum").read_text()
    (said,) = [problem for problem in manifest(out)["problems"] if "scans 0 to 8" in problem]
    assert "not tied" in said
    alone = lslam.run(kept(stub, list(range(9, 26))), config("map.write=true"), out=tmp_path / "alone")
    points = [manifest(folder)["map_points"] for folder in (out, tmp_path / "alone")]
    assert points[0] == pytest.approx(points[1], rel=0.03), (
        "no point of the other frame, which would be half as many more"
    )
    assert outcome.record.keyframe_scans.min() >= 9
    assert alone.record.manifest["status"] == "done"


def test_without_a_frame_of_most_scans_the_run_is_lost(tmp_path: Path) -> None:
    stub = mirrored(8, 16, 24)
    scale = np.float32([0.5, 0.5, 0.5])
    for i in range(16, 24):
        scan = stub.scans[i]
        assert isinstance(scan, Scan)
        stub.scans[i] = replace(scan, points=scan.points * scale)
    with pytest.raises(lslam.core.errors.RunFailedError, match="not tied"):
        lslam.run(stub, config(), out=tmp_path / "out")
    assert len(columns(tmp_path / "out")["status"]) == 24
    assert manifest(tmp_path / "out")["status"] == "diverged"
