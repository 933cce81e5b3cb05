"""`lslam compare` as a user calls it."""

from __future__ import annotations

import contextlib
import json
import os
import pty
import re
import signal
import subprocess
import time
import tomllib
from pathlib import Path
from typing import Any

import click
import pytest
from calling import COMMAND, SAMPLE, assert_one_sentence, environment, lslam, sample_copy, strict_json

from lslam.cli.compare import command
from lslam.core.errors import InputError, UsageError

pytestmark = pytest.mark.usefixtures("forked_runs")


def test_one_object_on_stdout_progress_on_stderr_and_a_crop_of_ones_own(tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = lslam(
        "compare", "block", "--methods", "icp", "--seeds", "5", "--count", "12", "--crop", "10,0,30", "--json", "--out", out
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    document = strict_json(done.stdout)
    (run,) = document["runs"]
    assert (run["sequence"], run["method"], run["seed"], run["status"]) == ("block", "icp", 5, "done")
    assert run["values"]["scans"] == 12
    assert document["command"].startswith("lslam compare block --methods icp --seeds 5")
    assert document == strict_json((out / "compare.json").read_text())
    assert (out / "simulated" / "block-5-12" / "sequences" / "00").is_dir()
    page = (out / "compare.html").read_text()
    assert "map of icp on block at 10, 0" in page
    assert "comparing 1/1" in done.stderr


def test_flags_of_one_sequence_override_those_of_all(tmp_path: Path) -> None:
    flags = ["--count", "9", "--count", "block=6", "--skip-frames", "block=2", "--start", f"{SAMPLE}=80"]
    done = lslam("compare", SAMPLE, "block", "--methods", "kiss-icp", *flags, "--json", "--out", tmp_path / "out", "-q")
    assert done.returncode == 0, done.stderr
    runs = strict_json(done.stdout)["runs"]
    assert [(run["sequence"], run["values"]["scans"]) for run in runs] == [("block-0", 9), ("block", 6)]
    inputs = [tomllib.loads((Path(run["folder"]) / "config.toml").read_text())["input"] for run in runs]
    assert [(i["start"], i["count"], i["skip_frames"]) for i in inputs] == [(80, 9, 1), (0, 6, 2)]
    assert (tmp_path / "out" / "simulated" / "block-0-11").is_dir(), "every other scan of 11"


def on_a_terminal(words: list[str], columns: int) -> list[str]:
    """What the command shows on a terminal of that width, without colours."""
    ours, theirs = pty.openpty()
    child = subprocess.Popen(
        [*COMMAND, *words],
        stdout=theirs,
        stderr=subprocess.DEVNULL,
        env=environment(COLUMNS=str(columns), TERM="xterm"),
    )
    os.close(theirs)
    shown = b""
    with contextlib.suppress(OSError):  # the end of a terminal is an error on Linux
        while part := os.read(ours, 4096):
            shown += part
    os.close(ours)
    assert child.wait(timeout=60) == 0
    return re.sub(r"\x1b\[[0-9;]*m", "", shown.decode()).splitlines()


@pytest.fixture(scope="module")
def torn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording whose scans cannot be read."""
    sequence = sample_copy(tmp_path_factory.mktemp("torn"), 4)
    for scan in (sequence / "velodyne").iterdir():
        scan.write_bytes(b"no")
    return sequence


def test_all_runs_failed_is_exit_code_1_with_a_table_all_the_same(torn: Path, tmp_path: Path) -> None:
    done = lslam("compare", torn, "--methods", "icp", "--out", tmp_path / "out", "-q")
    assert done.returncode == 1
    assert_one_sentence(done.stderr)
    assert "the run failed: " in done.stderr
    assert "none of 4 scans can be used" in done.stdout
    assert (tmp_path / "out" / "compare.html").is_file()


def test_one_failed_run_is_exit_code_0_and_4_with_strict(torn: Path, tmp_path: Path) -> None:
    call = ["compare", torn, "block", "--methods", "icp", "--count", "4", "--out", tmp_path / "out", "--table", "md"]
    done = lslam(*call)
    assert done.returncode == 0, done.stderr
    assert "### 1 run failed" in done.stdout
    strict = lslam(*call, "--strict", "--resume")
    assert strict.returncode == 4
    assert "--strict: 1 of 2 runs failed" in strict.stderr
    screen = on_a_terminal([*map(str, call[:-2]), "--resume"], columns=70)
    assert max(len(line) for line in screen) <= 70
    assert any(line.split()[:2] == ["block", "icp"] for line in screen)
    document = json.loads((tmp_path / "out" / "compare.json").read_text())
    assert [run["reused"] for run in document["runs"]] == [False, True]


@pytest.mark.parametrize(
    ("words", "error", "sentence"),
    [
        ([], click.UsageError, "Missing argument"),
        (["block"], click.UsageError, "Missing option '--methods'"),
        (["block", "--methods", "icp", "--quick"], click.UsageError, "--quick is of the comparisons of --list"),
        (["girolimetto", "--seeds", "4-2"], UsageError, "different whole numbers"),
        (["block", "--methods", "icp,kis-icp"], UsageError, "did you mean 'kiss-icp'"),
        (["block", "--methods", ","], UsageError, "--methods is empty"),
        (["block", "--methods", "icp,icp"], UsageError, "twice"),
        (["block", "block", "--methods", "icp"], UsageError, "named twice"),
        (["blokk", "--methods", "icp"], InputError, "did you mean 'block'"),
        (["block", "--methods", "icp", "--seeds", "a"], UsageError, "--seeds a"),
        (["block", "--methods", "icp", "--crop", "1,2"], click.UsageError, "x, y and size"),
        (["block", "street", "--methods", "icp", "--gt", "truth.tum"], UsageError, "--gt belongs to one"),
        (["block", "--methods", "icp", "--gt", "truth.tum"], UsageError, "--gt belongs to one"),
        (["block", "--methods", "icp", "--jobs", "0"], UsageError, "--jobs 0"),
        (["block", "--methods", "icp", "--set", "map.voxl=1"], UsageError, "did you mean .voxel"),
        (["street", "--methods", "icp", "--count", "5000"], UsageError, "--speed"),
        (["block", "--methods", "icp", "--count", "x"], UsageError, "--count x: a whole number, or SEQUENCE=N"),
        (
            ["block", "--methods", "icp", "--count", "blok=3"],
            UsageError,
            "no sequence 'blok' is named; did you mean 'block'",
        ),
        (
            ["block", "--methods", "icp", "--start", "block=-1"],
            UsageError,
            "--start block=-1: start = -1: .*or equal to 0",
        ),
        (
            ["street", "--methods", "icp", "--count", "street=5000"],
            UsageError,
            "street has 265 scans: count = 5000 goes",
        ),
        (
            [str(SAMPLE), "--methods", "icp", "--start", f"{SAMPLE}=95"],
            UsageError,
            "block-0 has 95 scans: start = 95 goes",
        ),
        (
            ["girolimetto", "--data-root", "kitti"],
            UsageError,
            "--data-root: what this comparison compares is not public",
        ),
        (["girolimetto", "--preset", "hdl"], click.UsageError, "--preset is not of girolimetto"),
    ],
)
def test_usage_errors_come_before_any_run(
    words: list[str], error: type[Exception], sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("LSLAM_DATA", raising=False)
    with pytest.raises(error, match=sentence):
        command.main([*words, "--out", "out"], standalone_mode=False)
    assert not (tmp_path / "out").exists()


def test_an_interruption_keeps_what_is_finished_for_resume(tmp_path: Path) -> None:
    out = tmp_path / "out"
    call = ["compare", "block", "--methods", "icp", "--seeds", "0,1", "--count", "40", "--out", str(out)]
    child = subprocess.Popen(
        [*COMMAND, *call], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment(),
        start_new_session=True,
        # A shell that runs the tests in the background has switched the signal off, for all its children.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    try:
        end = time.monotonic() + 120
        while not (out / "runs" / "block" / "icp-s1" / "config.toml").exists():
            assert child.poll() is None, child.communicate()
            assert time.monotonic() < end
            time.sleep(0.01)
        os.killpg(child.pid, signal.SIGINT)  # as a terminal does: the whole group
        printed, said = child.communicate(timeout=60)
    finally:
        child.kill()
        child.wait()
    assert (child.returncode, printed) == (130, ""), said
    assert "Traceback" not in said
    assert "1 of 2 runs are finished" in said
    states: dict[str, Any] = {p.name: json.loads(p.read_text())["status"] for p in out.glob("runs/block/*.json")}
    assert states["icp-s0.json"] == "done"
    assert states.get("icp-s1.json") != "done"
    again = lslam(*call, "--resume", "--json")
    assert again.returncode == 0, again.stderr
    assert [run["reused"] for run in strict_json(again.stdout)["runs"]] == [True, False]
