"""`lslam run --again` of runs with wheels, with a method of another package, and of those that lie in storage."""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from calling import SAMPLE, Done, lslam

from lslam.io.remote import RemotePath
from tests.storages import counted

pytestmark = pytest.mark.slow
MODULE = """
from lslam.odometry import create_odometry


def create(config):
    return create_odometry(config.model_copy(update={"odometry": config.odometry.model_copy(update={"method": "icp"})}))
"""
SHORT = ("--count", "6", "--set", "map.voxel=1", "--set", "report.html=false")


def same(done: Done) -> bool:
    assert done.returncode == 0, done.stderr
    again = json.loads(done.stdout)["again"]
    assert {"trajectory.tum", "map.ply", "covariances.npz"} <= {*again["same"], *again["differing"]}
    return bool(again["is_same"])


def test_wheels_are_read_again_and_said_where_they_are_others(tmp_path: Path) -> None:
    recording, run = tmp_path / "bore", tmp_path / "run"
    assert lslam("simulate", "tunnel", "--seed", 3, "--scans", 12, "--out", recording).returncode == 0
    done = lslam("run", recording, "--wheels", "wheels.csv", "--set", "map.voxel=1", "--out", run)
    assert done.returncode == 0, done.stderr
    done = lslam("run", "--again", run, "--json")
    assert same(done)
    assert "--wheels are others" not in done.stderr
    (file,) = recording.rglob("wheels.csv")
    with file.open(newline="") as stream:
        names, *rows = csv.reader(stream)
    faster = [[row[0], str(1.1 * float(row[1])), *row[2:]] for row in rows]
    file.write_text("\n".join(",".join(row) for row in [names, *faster]) + "\n")
    done = lslam("run", "--again", run, "--out", tmp_path / "faster", "--json")
    assert not same(done)
    assert "the readings of --wheels are others" in done.stderr


def test_a_method_of_another_package_and_another_version_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    info = tmp_path / "site" / "theirs-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: theirs\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[lslam.methods]\nmy-icp = theirs:create\n")
    (info.parent / "theirs.py").write_text(MODULE)
    with monkeypatch.context() as patch:
        patch.syspath_prepend(info.parent)
        patch.delitem(sys.modules, "theirs", raising=False)
        run = tmp_path / "run"
        done = lslam("run", SAMPLE, "--method", "my-icp", *SHORT, "--out", run)
        assert done.returncode == 0, done.stderr
        assert same(done := lslam("run", "--again", run, "--json"))
        assert "theirs was" not in done.stderr
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: theirs\nVersion: 1.1\n")
        assert same(done := lslam("run", "--again", run, "--out", tmp_path / "later", "--json"))
        assert "theirs was 1.0 at the run and is 1.1 now" in done.stderr
    done = lslam("run", "--again", run, "--out", tmp_path / "without")
    assert done.returncode == 2
    assert "no method 'my-icp'" in done.stderr.splitlines()[-1]


@pytest.fixture
def storage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[RemotePath]:
    monkeypatch.setattr("lslam.pipeline.run_folder.cache_folder", lambda name: tmp_path / name)
    with counted() as root:
        yield root / "results"


def test_a_run_in_storage_is_made_again_there_or_here(storage: RemotePath, tmp_path: Path) -> None:
    first = storage / "drive7"
    done = lslam("run", SAMPLE, *SHORT, "--out", first)
    assert done.returncode == 0, done.stderr
    done = lslam("run", "--again", first, "--json")
    assert same(done)
    assert json.loads(done.stdout)["folder"] == str(storage / "drive7-again")
    assert (storage / "drive7-again/trajectory.tum").read_bytes() == (first / "trajectory.tum").read_bytes()
    assert same(lslam("run", "--again", first, "--out", tmp_path / "here", "--json"))
    assert same(lslam("run", "--again", tmp_path / "here", "--out", storage / "there", "--json"))
    (first / "map.ply").write_bytes(b"other")
    done = lslam("run", "--again", first, "--out", storage / "third", "--json", "--strict")
    assert done.returncode == 4
    assert json.loads(done.stdout)["again"]["differing"] == ["map.ply"]
    assert lslam("run", "--again", first, "--out", first).returncode == 2
    done = lslam("run", "--again", storage / "nowhere")
    assert done.returncode == 3
    assert "results/nowhere is no folder of a run" in done.stderr
