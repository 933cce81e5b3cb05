"""SIGINT, SIGTERM and SIGKILL during `lslam run`: a readable folder, its status, and nothing half-written."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from calling import COMMAND, SAMPLE, assert_one_sentence, environment, lslam, manifest

from lslam.io.formats.trajectory_files import read_trajectory

LAPS = 12
Child = subprocess.Popen[str]


@pytest.fixture(scope="module")
def laps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample's round driven many times, by links: long enough to be interrupted anywhere."""
    source, target = SAMPLE / "sequences" / "00", tmp_path_factory.mktemp("laps") / "sequences" / "00"
    (target / "velodyne").mkdir(parents=True)
    for k in range(94 * LAPS):
        (target / "velodyne" / f"{k:06d}.bin").symlink_to(source / "velodyne" / f"{k % 94:06d}.bin")
    for name in ("calib.txt", "sequence.toml"):
        text = (source / name).read_text().replace('per_point = "per_point"\n', "")
        (target / name).write_text("".join(line for line in text.splitlines(True) if "ground_truth" not in line))
    return target


@contextmanager
def started(sequence: Path, out: Path, *words: str) -> Iterator[Child]:
    child = subprocess.Popen(
        [*COMMAND, "run", str(sequence), "--out", str(out), *words],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment(),
    )  # fmt: skip
    try:
        yield child
    finally:
        child.kill()
        child.communicate()


def wait_for(condition: Callable[[], bool], child: Child, seconds: float = 180) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert child.poll() is None, "the run ended before it could be interrupted"
        assert time.monotonic() < end
        time.sleep(0.005)


def in_odometry(out: Path, child: Child) -> None:
    # Kernels are loaded, scans are being registered.
    wait_for(lambda: any(out.glob("checkpoint/odometry-*.npz")), child)
    assert not (out / "trajectory.tum").exists()


def in_map(out: Path, child: Child) -> None:
    wait_for(lambda: (out / "scans.csv").exists(), child)


def assert_whole(out: Path) -> None:
    """No file under a final name is half a file."""
    for file in out.iterdir():
        if file.name in ("trajectory.tum", "trajectory_kitti.txt"):
            assert len(read_trajectory(file)) > 0
        elif file.name == "covariances.npz":
            with np.load(file) as archive:
                assert np.isfinite(archive["covariances"]).all()
        elif file.suffix == ".csv":
            assert file.read_text().endswith("\n")
        elif file.name == "report.html":
            assert file.read_text().rstrip().endswith("</html>")
    manifest(out)


@pytest.mark.parametrize(
    ("number", "place", "words"),
    [
        (signal.SIGINT, in_odometry, []),
        (signal.SIGTERM, in_odometry, ["--threads", "1"]),
        (signal.SIGTERM, in_map, ["--count", "150"]),
    ],
)
def test_a_signal_ends_the_run_with_what_was_done(
    laps: Path, tmp_path: Path, number: signal.Signals, place: Callable[[Path, Child], None], words: list[str]
) -> None:
    out = tmp_path / "out"
    with started(laps, out, *words) as child:
        place(out, child)
        child.send_signal(number)
        asked = time.monotonic()
        stdout, stderr = child.communicate(timeout=30)
        assert time.monotonic() - asked < 10
    assert child.returncode == 130
    assert "Traceback" not in stderr
    assert stderr.splitlines()[-1].startswith("interrupted ")
    assert "status       interrupted" in stdout
    facts = manifest(out)
    assert facts["status"] == "interrupted"
    names = {p.name for p in out.iterdir()}
    assert {"trajectory.tum", "trajectory_kitti.txt", "covariances.npz", "timing.csv", "report.html"} <= names
    assert not {n for n in names if n.endswith(".part") or n in (".lock", "map.ply")}
    assert len(read_trajectory(out / "trajectory.tum")) == facts["counts"]["scans"]
    assert_whole(out)


def test_a_signal_while_kernels_are_loaded_ends_at_once(laps: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    env = environment(NUMBA_CACHE_DIR=str(tmp_path / "cache"))  # empty: compiling takes its time
    child = subprocess.Popen(
        [*COMMAND, "run", str(laps), "--out", str(out)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=env,
    )  # fmt: skip
    try:
        wait_for(lambda: (out / "manifest.json").exists(), child)
        time.sleep(0.5)
        child.send_signal(signal.SIGINT)
        _, stderr = child.communicate(timeout=30)
    finally:
        child.kill()
    assert child.returncode == 130
    assert "Traceback" not in stderr
    assert manifest(out)["status"] == "interrupted"
    assert {p.name for p in out.iterdir()} == {"manifest.json", "config.toml", "log.txt"}


@pytest.mark.parametrize("place", [in_odometry, in_map])
def test_a_kill_leaves_nothing_half_written_and_the_folder_can_be_used_again(
    laps: Path, tmp_path: Path, place: Callable[[Path, Child], None]
) -> None:
    out = tmp_path / "out"
    with started(laps, out, *(["--count", "150"] if place is in_map else [])) as child:
        place(out, child)
        os.kill(child.pid, signal.SIGKILL)
        child.wait(30)
    assert manifest(out)["status"] == "running", "nobody could write another status"
    assert_whole(out)
    again = lslam("run", laps, "--out", out, "--count", 5)
    assert again.returncode == 2
    assert_one_sentence(again.stderr)
    assert lslam("run", laps, "--out", out, "--count", 5, "--overwrite").returncode == 0
    assert manifest(out)["counts"]["scans"] == 5


def test_a_folder_in_use_is_left_alone(laps: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with started(laps, out) as child:
        wait_for(lambda: (out / "manifest.json").exists(), child)
        for words in ([], ["--overwrite"]):
            second = lslam("run", laps, "--out", out, "--count", 5, *words)
            assert (second.returncode, second.stdout) == (2, "")
            assert_one_sentence(second.stderr)
            assert "in use by another run" in second.stderr
        assert child.poll() is None
        assert manifest(out)["status"] == "running"
