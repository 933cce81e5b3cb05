"""Folders and files whose names are no UTF-8: every command ends well, and what it wrote can be read."""

from __future__ import annotations

import json
import os
import shutil
import sys
import tomllib
from pathlib import Path

import pytest
from calling import SAMPLE, lslam, manifest

from lslam.core.printable import printable
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.io.readers import open_sequence

pytestmark = pytest.mark.skipif(
    sys.platform != "linux",
    reason="file systems of macOS and Windows refuse such names, which are bytes on Linux alone",
)
SOURCE = SAMPLE / "sequences" / "00"


def odd(folder: Path, name: bytes) -> Path:
    return folder / os.fsdecode(name)


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of scans and nothing that says its name, so that the folder does."""
    folder = odd(tmp_path_factory.mktemp("odd"), b"na\xefve")
    (folder / "velodyne").mkdir(parents=True)
    for k in range(6):
        shutil.copy(SOURCE / "velodyne" / f"{k:06d}.bin", folder / "velodyne")
    return folder


@pytest.fixture(scope="module")
def ran(scans: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = odd(tmp_path_factory.mktemp("out"), b"r\xfcn")
    done = lslam("run", scans, "--out", out)
    assert done.returncode == 0, done.stderr
    return out


def test_a_run_writes_everything(scans: Path, ran: Path) -> None:
    assert {"map.ply", "map.json", "report.html", "evaluation.json"} <= {path.name for path in ran.iterdir()}
    assert manifest(ran)["sequence"]["path"] == str(scans), "JSON says it as it is"
    assert json.loads((ran / "map.json").read_text("utf-8"))["sequence"] == printable(scans.name)
    (ran / "report.html").read_text("utf-8")
    (ran / "log.txt").read_text("utf-8")
    again = lslam("map", ran, "--overwrite", "--format", "laz")
    assert again.returncode == 0, again.stderr
    plot = odd(ran.parent, b"pl\xf6t.png")
    drawn = lslam("eval", ran / "trajectory.tum", odd(ran.parent, b"r\xfcn") / "trajectory.tum", "--plot", plot)
    assert drawn.returncode == 0, drawn.stderr


@pytest.mark.parametrize("kind", ["bag", "mcap", "kitti"])
def test_a_conversion_can_be_opened(kind: str, scans: Path, tmp_path: Path) -> None:
    out = odd(tmp_path, b"c\xf6py" + (b"" if kind == "kitti" else b"." + kind.encode()))
    done = lslam("convert", scans, "--to", kind, "--out", out)
    assert done.returncode == 0, done.stderr
    assert len(open_sequence(out)) == 6


def test_poses_and_extracts_by_such_names_are_found_and_resumed(ran: Path, tmp_path: Path) -> None:
    poses, extract = odd(tmp_path, b"p\xf6ses.tum"), odd(tmp_path, b"m\xe4p.osm")
    shutil.copy(ran / "trajectory.tum", poses)
    assert len(read_trajectory(poses)) == 6
    shutil.copy(next(SOURCE.glob("map.osm")), extract)
    words = ["run", SOURCE, "--count", "6", "--poses", poses, "--osm", extract, "--georeference"]
    out = tmp_path / "out"
    assert lslam(*words, "--out", out).returncode in (0, 3)
    assert "p\\udcf6ses.tum" in tomllib.loads((out / "config.toml").read_text("utf-8"))["odometry"]["poses"]
    assert "differs" not in lslam(*words, "--out", out, "--resume").stderr


@pytest.mark.usefixtures("forked_runs")
def test_studies_and_simulations(scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = odd(tmp_path, b"c\xf6mpare")
    assert lslam("compare", scans, "--methods", "icp", "--set", "report.html=false", "--out", out).returncode == 0
    drive = odd(tmp_path, b"dr\xefve")
    assert lslam("simulate", "block", "--count", "2", "--out", drive).returncode == 0
    assert str(drive) in json.loads((drive / "sequences" / "00" / "manifest.json").read_text("utf-8"))["command"]
    monkeypatch.setattr("sys.stdin", open(os.devnull))  # noqa: SIM115
    lines = tmp_path / "lines"
    lines.write_bytes(b"lslam run " + os.fsencode(scans) + b" --set map.write=false\n")
    with lines.open(encoding="utf-8", errors="surrogateescape") as stream:
        monkeypatch.setattr("sys.stdin", stream)
        done = lslam("batch", "-", "--out", odd(tmp_path, b"b\xe4tch"))
    assert done.returncode == 0, done.stderr
