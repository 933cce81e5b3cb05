"""`lslam run` as a user calls it: the files, stdout and stderr, what a repetition gives, and the baseline method."""

from __future__ import annotations

import hashlib
import json
import os
import pty
import subprocess
import tomllib
from pathlib import Path

import numpy as np
import pytest
from calling import (
    COMMAND,
    SAMPLE,
    Done,
    assert_one_sentence,
    environment,
    lslam,
    lslam_process,
    manifest,
    sample_copy,
    strict_json,
)

from lslam.io.formats.point_files import read_points
from lslam.io.formats.trajectory_files import read_trajectory

ALL = {
    "trajectory.tum", "trajectory_kitti.txt", "covariances.npz", "map.ply", "map.json", "timing.csv", "scans.csv",
    "trajectory_odometry.tum", "loops.csv", "graph.g2o",
    "manifest.json", "config.toml", "log.txt", "evaluation.json", "report.html", "keyframes",
}  # fmt: skip
SAME = ("trajectory.tum", "trajectory_kitti.txt", "covariances.npz", "map.ply", "evaluation.json")


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> tuple[Done, Path]:
    """The README's command, once for all tests that look at its result."""
    out = tmp_path_factory.mktemp("run") / "first"
    return lslam_process("run", SAMPLE, "--out", out), out


def digests(folder: Path) -> dict[str, str]:
    return {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in SAME}


@pytest.mark.quick
def test_writes_exactly_the_promised_files(first: tuple[Done, Path]) -> None:
    done, out = first
    assert done.returncode == 0, done.stderr
    assert {p.name for p in out.iterdir()} == ALL
    facts = manifest(out)
    assert (facts["status"], facts["problems"], facts["counts"]["ok"]) == ("done", [], 95)
    assert facts["integrity"]["conclusive"] > 10
    assert facts["peak_memory_mb"] < 1000
    assert facts["frames"]["pose_time"] == "scan_start"
    assert str(out) in facts["command"]


def test_stdout_is_the_summary_and_stderr_the_log(first: tuple[Done, Path]) -> None:
    done, out = first
    assert done.stdout.startswith("block-0, icp\n  status       done\n")
    for word in ("ATE se3", "ATE origin", "RPE", "KITTI drift", "real time", str(out)):
        assert word in done.stdout
    lines = done.stderr.splitlines()
    assert all(line.startswith(("INFO: ", "WARNING: ")) for line in lines), "no bar, no colour, no traceback"
    assert len(lines) < 20, "sparse"
    assert sum("odometry 95/95" in line for line in lines) == 1
    assert "\x1b" not in done.stderr + done.stdout


def test_the_log_keeps_what_was_decided_and_seen(first: tuple[Done, Path]) -> None:
    done, out = first
    log = (out / "log.txt").read_text()
    for decision in manifest(out)["sequence"]["decisions"]:
        assert log.count(decision) == 1
    for line in done.stderr.splitlines():
        assert line.partition(": ")[2] in log


def test_the_map_and_the_tables_are_readable(first: tuple[Done, Path]) -> None:
    _, out = first
    cloud = read_points(out / "map.ply")
    assert len(cloud) == manifest(out)["map_points"] > 50_000
    assert np.isfinite(cloud.points).all()
    for name in ("timing.csv", "scans.csv"):
        rows = (out / name).read_text().splitlines()
        assert len(rows) == 96
        assert len({row.count(",") for row in rows}) == 1
    with np.load(out / "covariances.npz") as file:
        covariances = file["covariances"]
    assert covariances.shape == (95, 6, 6)
    assert (np.linalg.eigvalsh(covariances) >= 0).all()


def test_kitti_poses_are_of_camera_0(first: tuple[Done, Path]) -> None:
    _, out = first
    truth, own = SAMPLE / "poses" / "00.txt", out / "trajectory_kitti.txt"
    done = lslam("eval", own, truth, "--json", "--align", "origin")
    score = strict_json(done.stdout)
    assert done.returncode == 0
    assert "WRONG" not in done.stderr
    assert '"rmse"' in json.dumps(score)
    ours, true = (np.loadtxt(file).reshape(-1, 3, 4) for file in (own, truth))
    assert np.linalg.norm(ours[:, :, 3] - true[:, :, 3], axis=1).max() < 0.1, "the same frame, not aligned"
    lidar = read_trajectory(out / "trajectory.tum")
    assert lidar.positions[5, 0] > 3, "the LiDAR drives along x"
    assert ours[5, 2, 3] > 3, "the camera looks along z"


def test_evaluation_json_and_report(first: tuple[Done, Path]) -> None:
    _, out = first
    score = strict_json((out / "evaluation.json").read_text())
    assert score["ate"]["se3"]["rmse"] < 0.1
    html = (out / "report.html").read_text()
    assert html.rstrip().endswith("</html>")
    assert 'src="http' not in html


@pytest.mark.usefixtures("starts_sought_anew")
def test_repetition_threads_and_the_written_config_give_the_same_bytes(
    first: tuple[Done, Path], tmp_path: Path
) -> None:
    _, out = first
    assert tomllib.loads((out / "config.toml").read_text())["input"]["threads"] == 0
    for number, words in enumerate((("--threads", 1), ("--config", out / "config.toml"))):
        again = tmp_path / str(number)
        assert lslam("run", SAMPLE, "--out", again, *words).returncode == 0
        assert digests(again) == digests(out), words
    assert (tmp_path / "1" / "config.toml").read_bytes() == (out / "config.toml").read_bytes()


def test_json_is_one_object(tmp_path: Path) -> None:
    done = lslam("run", SAMPLE, "--out", tmp_path / "out", "--count", "12", "--json", "-q")
    assert (done.returncode, done.stderr) == (0, "")
    document = strict_json(done.stdout)
    assert document.keys() == {"folder", "manifest", "evaluation"}
    assert document["manifest"]["status"] == "done"
    assert document["evaluation"] == strict_json((tmp_path / "out" / "evaluation.json").read_text())
    assert (tmp_path / "out" / "log.txt").read_text(), "quiet is for the screen"


@pytest.mark.parametrize("more", [[], ["--json"]])
def test_dry_run_writes_nothing(tmp_path: Path, more: list[str]) -> None:
    done = lslam("run", SAMPLE, "--dry-run", "--set", "map.voxel=0.3", *more, cwd=tmp_path)
    assert (done.returncode, list(tmp_path.iterdir())) == (0, [])
    if more:
        plan = strict_json(done.stdout)
        assert (plan["sequence"]["scans"], plan["config"]["map"]["voxel"]) == (95, 0.3)
    else:
        assert "95 scans" in done.stdout
        assert "voxel = 0.3" in done.stdout
    assert lslam("run", SAMPLE, "--dry-run", "--method", "ipc", cwd=tmp_path).returncode == 2


def test_the_default_folder_is_below_runs(tmp_path: Path) -> None:
    done = lslam("run", SAMPLE, "--count", "4", cwd=tmp_path)
    assert done.returncode == 0
    (folder,) = (tmp_path / "runs").iterdir()
    assert folder.name.startswith("block-0-icp-")
    assert str(folder.relative_to(tmp_path)) in done.stdout


def test_kiss_icp_runs_with_bounded_error(tmp_path: Path) -> None:
    done = lslam("run", SAMPLE, "--out", tmp_path / "out", "--method", "kiss-icp", "--json")
    assert done.returncode == 0
    document = strict_json(done.stdout)
    assert document["evaluation"]["ate"]["se3"]["rmse"] < 1.0
    assert document["manifest"]["method"] == "kiss-icp"
    assert not any("may be lost" in problem for problem in document["manifest"]["problems"])
    assert document["manifest"]["integrity"]["conclusive"] > 10
    assert {p.name for p in (tmp_path / "out").iterdir()} == ALL, "it has no covariances, but the graph does"


def test_every_third_scan_and_a_part(tmp_path: Path) -> None:
    words = ("--start", 10, "--count", 20, "--skip-frames", 3)
    done = lslam("run", SAMPLE, "--out", tmp_path / "out", *words, "--json")
    assert done.returncode == 0
    document = strict_json(done.stdout)
    assert document["manifest"]["counts"]["ok"] == 20
    assert document["evaluation"]["ate"]["se3"]["rmse"] < 0.1
    scans = (tmp_path / "out" / "scans.csv").read_text().splitlines()
    assert [int(row.split(",")[0]) for row in scans[1:4]] == [10, 13, 16], "scans keep their number in the recording"


def test_overwrite_replaces_a_run_and_only_a_run(tmp_path: Path) -> None:
    sequence = sample_copy(tmp_path / "data", 6)
    out = tmp_path / "out"
    assert lslam("run", sequence, "--out", out).returncode == 0
    refused = lslam("run", sequence, "--out", out)
    assert (refused.returncode, refused.stdout) == (2, "")
    assert_one_sentence(refused.stderr)
    assert "--overwrite" in refused.stderr
    assert lslam("run", sequence, "--out", out, "--overwrite", "--count", "3").returncode == 0
    assert manifest(out)["counts"]["scans"] == 3
    foreign = lslam("run", sequence, "--out", sequence, "--overwrite")
    assert foreign.returncode == 2
    assert len(list((sequence / "velodyne").iterdir())) == 6


def on_terminal(*words: object, **env: str) -> tuple[int, str, str]:
    """Exit code, stdout, and what a terminal on stderr received."""
    master, slave = pty.openpty()
    child = subprocess.Popen(
        [*COMMAND, *map(str, words)], stdout=subprocess.PIPE, stderr=slave, text=True,
        env=environment(TERM="xterm-256color", COLUMNS="120", **env),
    )  # fmt: skip
    os.close(slave)
    received = b""
    try:
        while chunk := os.read(master, 65536):
            received += chunk
    except OSError:  # the other side is closed
        pass
    os.close(master)
    assert child.stdout is not None
    return child.wait(60), child.stdout.read(), received.decode()


def test_a_terminal_has_a_progress_bar_and_colours(tmp_path: Path) -> None:
    code, stdout, screen = on_terminal("run", SAMPLE, "--out", tmp_path / "colour", "--count", 40)
    assert code == 0
    assert "odometry" in screen
    assert "scans/s" in screen
    assert "\x1b[3" in screen
    assert "\x1b" not in stdout
    code, _, screen = on_terminal("run", SAMPLE, "--out", tmp_path / "plain", "--count", 8, NO_COLOR="1")
    assert code == 0
    assert "\x1b[3" not in screen
    code, _, screen = on_terminal("run", SAMPLE, "--out", tmp_path / "quiet", "--count", 8, "-q")
    assert (code, screen) == (0, "")


def test_a_reader_that_leaves_does_not_harm_the_run(tmp_path: Path) -> None:
    out = tmp_path / "out"
    child = subprocess.Popen(
        [*COMMAND, "run", str(SAMPLE), "--out", str(out), "--count", "4", "-q"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert child.stdout is not None
    child.stdout.close()
    assert child.stderr is not None
    assert child.stderr.read() == ""
    assert child.wait(60) == 0
    assert manifest(out)["status"] == "done"
