"""`lslam run --resume`: killed with SIGKILL here and there, it ends with the bytes of a run that was left alone."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from calling import COMMAND, SAMPLE, assert_one_sentence, environment, lslam, manifest, strict_json

WORDS = ("--set", "odometry.checkpoint_s=0.2", "--set", "report.html=false")


def files_of(folder: Path) -> dict[str, bytes]:
    changing = ("manifest.json", "log.txt", "timing.csv", "config.toml", "odometry.npz")
    files = [file for file in folder.rglob("*") if file.is_file() and file.name not in changing]
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


def killed_when(condition: Callable[[], bool], *words: object) -> None:
    """Run until something is on disk, then SIGKILL."""
    child = subprocess.Popen([*COMMAND, *map(str, words)], stderr=subprocess.DEVNULL, env=environment())
    try:
        end = time.monotonic() + 60
        while not condition():
            assert child.poll() is None, "the run ended before it could be killed"
            assert time.monotonic() < end
            time.sleep(0.002)
    finally:
        os.kill(child.pid, signal.SIGKILL)
        child.wait(30)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole") / "out"
    assert lslam("run", SAMPLE, "--out", out, *WORDS).returncode == 0
    return out


def test_killed_again_and_again_it_ends_with_the_same_bytes(whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ("run", SAMPLE, "--out", out, *WORDS, "--resume")
    begun = [
        lambda: (out / "manifest.json").exists(),  # nothing is done yet
        lambda: len(list(out.glob("checkpoint/odometry-*.npz"))) > 0,  # in the middle of odometry
        lambda: (out / "scans.csv").exists(),  # odometry is over
    ]
    for condition in begun:
        killed_when(condition, *words)
        assert manifest(out)["status"] == "running"
        assert not list(out.glob("checkpoint/*.part.part"))
    done = lslam(*words, "--json")
    assert done.returncode == 0, done.stderr
    facts = strict_json(done.stdout)["manifest"]
    assert (facts["status"], facts["counts"]["ok"]) == ("done", 95)
    assert facts["resumed_after_scans"][-1] == 95
    assert files_of(out) == files_of(whole)
    assert "going on after 95 scans" in (out / "log.txt").read_text()


def test_resuming_a_finished_run_reports_its_result(whole: Path) -> None:
    before = files_of(whole)
    again = lslam("run", SAMPLE, "--out", whole, *WORDS, "--resume")
    assert (again.returncode, again.stdout) == (0, "")
    assert again.stderr.splitlines() == [f"INFO: the run in {whole} is finished (done): nothing is left to do"]
    document = strict_json(lslam("run", SAMPLE, "--out", whole, *WORDS, "--resume", "--json").stdout)
    assert document["manifest"]["status"] == "done"
    assert document["evaluation"]["ate"]["se3"]["rmse"] < 0.1
    assert files_of(whole) == before


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--set", "registration.sigma=0.05", "--resume"), "registration.sigma was 0.03 and is 0.05"),
        (("--count", 50, "--resume"), "input.count was None and is 50"),
        (("--overwrite", "--resume"), "give one of them"),
        ((), "--resume goes on with a run that was interrupted, --overwrite replaces it"),
    ],
)
def test_what_cannot_go_on_is_refused(whole: Path, words: tuple[object, ...], said: str) -> None:
    before = files_of(whole)
    refused = lslam("run", SAMPLE, "--out", whole, *WORDS, *words)
    assert (refused.returncode, refused.stdout) == (2, "")
    assert_one_sentence(refused.stderr)
    assert said in refused.stderr
    assert files_of(whole) == before


def test_a_run_of_an_lslam_that_lacked_a_key_is_said_to_be_one(whole: Path, tmp_path: Path) -> None:
    shutil.copytree(whole, tmp_path / "out")
    file = tmp_path / "out" / "config.toml"
    lines = file.read_text().splitlines(keepends=True)
    file.write_text("".join(line for line in lines if not line.startswith(("descriptor =", "metrics ="))))
    refused = lslam("run", SAMPLE, "--out", tmp_path / "out", *WORDS, "--resume")
    assert refused.returncode == 2
    assert "it was begun by an earlier lslam, which had no loops.descriptor" in refused.stderr


def test_other_metrics_may_be_shown_of_a_run_that_is_there(whole: Path) -> None:
    again = lslam("run", SAMPLE, "--out", whole, *WORDS, "--resume", "--metrics", "thesis")
    assert again.returncode == 0, again.stderr


def test_resume_needs_out() -> None:
    refused = lslam("run", SAMPLE, "--resume")
    assert refused.returncode == 2
    assert_one_sentence(refused.stderr)
    assert "--resume needs --out" in refused.stderr
