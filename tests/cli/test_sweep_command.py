"""`lslam sweep`: what it prints, what it refuses, and a study that is killed on the way."""

from __future__ import annotations

import shutil
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path

import click
import pytest
from calling import COMMAND, assert_one_sentence, environment, lslam

from lslam.cli.sweep import command
from lslam.core.errors import LslamError
from lslam.core.types.study import StudyRow
from lslam.studies.results_csv import read_study_csv

pytestmark = pytest.mark.usefixtures("forked_runs")

STUDY = """
methods = ["icp"]
sequences = [{ scenario = "block", lidar = "sample", columns = 256, scans = 30 }]
[parameters]
input.skip_frames = [1, 2, 3, 4]
[config]
loops.use = false
"""


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("study") / "skips.toml"
    path.write_text(STUDY)
    return path


def rows_of(out: Path) -> Sequence[StudyRow]:
    return read_study_csv(out / "results.csv") if (out / "results.csv").is_file() else []


def test_a_study_killed_on_the_way_goes_on_and_every_run_is_there_once(tmp_path: Path) -> None:
    steps = list(range(1, 5))
    file, out = tmp_path / "steps.toml", tmp_path / "out"
    file.write_text(STUDY.replace("[1, 2, 3, 4]", str(steps)))
    words = ["sweep", str(file), "--out", str(out), "--jobs", "1"]
    with subprocess.Popen(
        [*COMMAND, *words], env=environment(), stderr=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        end = time.monotonic() + 150
        while len(rows_of(out)) < 2 and time.monotonic() < end and process.poll() is None:
            time.sleep(0.01)
        process.kill()
    before = rows_of(out)
    assert 2 <= len(before) < len(steps), "killed in the middle"
    states = {path: path.stat().st_mtime_ns for path in (out / "runs" / "block").glob("*.json")}
    done = lslam(*words, "--resume")
    assert done.returncode == 0, done.stderr
    after = rows_of(out)
    assert [row.parameters["input.skip_frames"] for row in after] == steps
    for row in before:
        assert repr(row) in [repr(r) for r in after]
        state = (out / row.folder).with_name(f"{Path(row.folder).name}.json")
        assert state.stat().st_mtime_ns == states[state], "a finished run is not made again"
    header, line = done.stdout.splitlines()
    assert header.split()[:4] == ["sequence", "method", "runs", "failed"]
    assert line.split()[:4] == ["block", "icp", "4", "0"]
    again = lslam("sweep", file, "--out", out, "--dry-run", "--resume")
    assert again.stdout.splitlines()[-1] == "4 runs, 0 left to do"


def test_a_dry_run_lists_and_counts_and_writes_nothing(file: Path, tmp_path: Path) -> None:
    words = ("sweep", file, "--out", tmp_path / "out", "--dry-run", "--seeds", "1,2", "--jobs", "1")
    done = lslam(*words)
    assert done.returncode == 0, done.stderr
    *runs, last = done.stdout.splitlines()
    assert runs[0] == "block icp-skip_frames_1 seed 1"
    assert len(runs) == 8
    assert last == "8 runs, 8 left to do; --pilot estimates their time by a few short runs"
    assert done.stderr == "", "nothing is simulated or run"
    piloted = lslam(*words, "--pilot")
    assert piloted.stdout.splitlines()[-1].startswith("8 runs, 8 left to do: about ")
    assert "pilot runs)" in piloted.stdout
    assert not list(tmp_path.iterdir())


def test_strict_makes_a_failed_run_exit_4(file: Path, tmp_path: Path) -> None:
    shutil.copy(file, tmp_path / "far.toml")
    (tmp_path / "far.toml").write_text(STUDY.replace("input.skip_frames = [1, 2, 3, 4]", "input.start = [27, 31]"))
    done = lslam("sweep", tmp_path / "far.toml", "--out", tmp_path / "out", "--strict", "-q")
    assert done.returncode == 4
    assert_one_sentence(done.stderr)
    assert "1 of 2 runs failed" in done.stderr
    assert "--start 31 is beyond the last scan" in done.stderr


def test_a_run_too_short_for_a_score_is_said(file: Path, tmp_path: Path) -> None:
    (tmp_path / "late.toml").write_text(STUDY.replace("input.skip_frames = [1, 2, 3, 4]", "input.start = [29]"))
    done = lslam("sweep", tmp_path / "late.toml", "--out", tmp_path / "out", "-q")
    assert done.returncode == 0
    assert "1 of 1 runs have no score, the first one: not scored: estimate icp has 1 poses, 3 are needed" in done.stderr


@pytest.mark.parametrize(
    ("words", "code", "sentence"),
    [
        ((), 2, "STUDY is missing"),
        (("FILE", "--pilot"), 2, "--pilot estimates the time of a --dry-run: give both"),
        (("nonsense",), 2, "no study 'nonsense' and no TOML file"),
        (("none.toml",), 3, "study none.toml cannot be read: No such file or directory"),
        (("--report", "none"), 3, "none/results.csv does not exist"),
        (("FILE", "--jobs", "0"), 2, "--jobs 0: at least one run"),
        (("FILE", "--jobs", "1", "--cluster", "local:2"), 2, "give one of them"),
        (("FILE", "--cluster", "two"), 2, "local:N with N workers"),
        (("FILE", "--seeds", "a"), 2, "--seeds a: whole numbers with commas"),
        (("FILE", "--seeds", "1,1"), 2, "different whole numbers from 0"),
        (("FILE", "--overwrite", "--resume"), 2, "give one of them"),
        (("FILE", "--set", "input.skip=3"), 2, "unknown key input.skip"),
    ],
)
def test_wrong_calls_are_answered_in_one_sentence(
    words: tuple[str, ...], code: int, sentence: str, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("lslam.cli.sweep.setup_logging", lambda *_: None)
    with pytest.raises((LslamError, click.UsageError)) as caught:
        command.main([str(file) if word == "FILE" else word for word in words], standalone_mode=False)
    assert caught.value.exit_code == code
    assert sentence in str(caught.value)
    assert "Errno" not in str(caught.value)
    assert not list(tmp_path.iterdir())
