"""What moves is left out of a run by its class: vehicles about a sensor that stands at lights, and drive off."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from calling import lslam as lslam_command
from scipy.spatial import cKDTree

import lslam
from lslam.core.config import load_config
from lslam.core.labels import CLASSES
from lslam.io.formats.point_files import read_cloud
from lslam.pipeline.watch import RunOutcome
from lslam.simulation.record import record
from lslam.simulation.scenarios import SimulatedDrive, simulate

SCANS, SEED = 60, 2
NEAR = 0.2  # m from a point that moved


@pytest.fixture(scope="module")
def drive() -> SimulatedDrive:
    return simulate("lights", seed=SEED, lidar="vlp16", count=SCANS)


@pytest.fixture(scope="module")
def recorded(drive: SimulatedDrive, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(drive, tmp_path_factory.mktemp("lights"), overwrite=True, has_labels=True).sequence


@pytest.fixture(scope="module")
def runs(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, RunOutcome]:
    out = tmp_path_factory.mktemp("runs")
    return {
        name: lslam.run(
            recorded, load_config(settings=[f"preprocess.drop_labels={drop}", "map.voxel=0.1"]), out=out / name
        )
        for name, drop in {"all": [], "standing": ["moving"]}.items()
    }


def share_moved(points: np.ndarray, drive: SimulatedDrive) -> float:
    """Share of the points (N, 3), m, that lie where a vehicle was at the beginning."""
    scan = drive.scan(0)
    assert scan.labels is not None
    moved = cKDTree(scan.points[scan.labels == CLASSES["moving-car"]])
    near = points[(np.abs(points) < 40).all(1)]
    return float(np.mean(moved.query(near, distance_upper_bound=NEAR)[0] < NEAR))


def test_what_is_left_out_is_not_in_the_map(drive: SimulatedDrive, runs: dict[str, RunOutcome]) -> None:
    maps = {name: run.map for name, run in runs.items()}
    assert maps["all"] is not None
    assert maps["standing"] is not None
    assert share_moved(maps["all"].points, drive) > 0.1
    assert share_moved(maps["standing"].points, drive) < 0.005
    assert len(maps["standing"].points) > 1000


def test_the_pose_gains_by_it(drive: SimulatedDrive, runs: dict[str, RunOutcome]) -> None:
    truth = drive.ground_truth
    assert truth is not None
    worst = {
        name: np.linalg.norm(run.trajectory.positions - truth.poses[:SCANS, :3, 3], axis=1).max()
        for name, run in runs.items()
    }
    assert worst["standing"] < 0.5 * worst["all"]


def test_a_map_can_be_rebuilt_without_them(drive: SimulatedDrive, runs: dict[str, RunOutcome], tmp_path: Path) -> None:
    folder, path = runs["all"].record.folder, tmp_path / "map.ply"
    done = lslam_command("map", folder, "--set", "preprocess.drop_labels=moving", "--out", path)
    assert done.returncode == 0, done.stderr
    assert share_moved(read_cloud(path).points, drive) < 0.005
    assert "without points of moving" in (tmp_path / "map.json").read_text()


def test_recorded_classes_are_those_of_the_scans(drive: SimulatedDrive, recorded: Path) -> None:
    for k in (0, SCANS - 1):
        labels = np.fromfile(recorded / "labels" / f"{k:06d}.label", "<u4")
        expected = drive.scan(k).labels
        assert expected is not None
        assert np.array_equal(labels, expected)
        assert {CLASSES["road"], CLASSES["building"], CLASSES["moving-car"]} <= set(labels.tolist())
