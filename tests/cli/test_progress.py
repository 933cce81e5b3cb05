"""`--progress json`: one event a line on stderr, of every command that takes long."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import click
import pytest
from calling import COMMAND, SAMPLE, environment, lslam

from lslam.cli.main import COMMANDS, cli

Event = dict[str, Any]
# Of the stages of a run with loops, in their order.
STAGES = ["opening", "preparing", "kernels", "odometry", "loops", "pose graph", "results", "map", "report"]
LONG = [
    "demo",
    "run",
    "deliver",
    "localize",
    "graph",
    "merge",
    "compare",
    "batch",
    "sweep",
    "simulate",
    "convert",
    "map",
    "info",
    "eval",
    "plot",
    "view",
]


def events(stderr: str) -> list[Event]:
    """The lines, each of which is one object with a name and a time."""
    found = [json.loads(line) for line in stderr.splitlines()]
    for event in found:
        assert isinstance(event["event"], str)
    assert all(a["elapsed_s"] <= b["elapsed_s"] for a, b in pairwise(found))
    return found


def check_stages(found: list[Event]) -> list[str]:
    """One stage after the other, each begun and ended, with shares that only grow; their names in order."""
    names, now, share = [], None, 0.0
    for event in found:
        if event["event"] == "begin":
            assert now is None, "the stage before has ended"
            names.append(event["stage"])
            now, share = event["stage"], 0.0
        if event["event"] in ("begin", "progress", "end"):
            assert event["stage"] == now
            assert share <= event.get("share", share) <= 1.0
            share = event.get("share", share)
        if event["event"] == "progress":
            assert event["left_s"] is None or event["left_s"] >= 0
        if event["event"] == "end":
            now = None
    assert now is None
    return names


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Event]]:
    folder = tmp_path_factory.mktemp("told") / "run"
    began = time.monotonic()
    done = lslam("run", SAMPLE, "--count", "60", "--progress", "json", "--out", folder, "--json")
    assert done.returncode == 0
    json.loads(done.stdout)
    return folder, [*events(done.stderr), {"event": "over", "elapsed_s": time.monotonic() - began}]


@pytest.mark.quick
def test_the_stages_of_a_run_cover_it(told: tuple[Path, list[Event]]) -> None:
    *found, over = told[1]
    assert check_stages(found) == STAGES
    (counted,) = [event for event in found if event["event"] == "end" and event["stage"] == "odometry"]
    assert (counted["done"], counted["steps"], counted["share"], counted["unit"]) == (60, 60, 1.0, "scans")
    within = sum(event["seconds"] for event in found if event["event"] == "end")
    assert within > 0.9 * over["elapsed_s"]


def test_what_is_logged_is_an_event_of_its_level(told: tuple[Path, list[Event]], tmp_path: Path) -> None:
    assert any(event["event"] == "info" and "deskew" in event["text"] for event in told[1])
    quiet = lslam("run", SAMPLE, "--count", "3", "--progress", "json", "-q", "--out", tmp_path / "q")
    names = {event["event"] for event in events(quiet.stderr)}
    assert {"begin", "end"} <= names
    assert "info" not in names


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (("run", "no-such-folder"), 3),
        (("run", SAMPLE, "--method", "no-such"), 2),
        (("run", SAMPLE, "--no-such-option"), 2),
        (("map", "no-such-run"), 3),
    ],
    ids=lambda words: " ".join(map(str, words))[-16:] if isinstance(words, tuple) else str(words),
)
def test_an_error_is_an_event_with_its_exit_code(words: tuple[object, ...], code: int) -> None:
    done = lslam(words[0], "--progress", "json", *words[1:])
    assert done.returncode == code
    last = events(done.stderr)[-1]
    assert (last["event"], last["exit_code"]) == ("error", code)
    assert last["text"]


@pytest.mark.parametrize("name", LONG)
def test_every_long_command_has_the_option(name: str) -> None:
    command = cli.get_command(click.Context(cli), name)
    assert command is not None
    assert {"progress", "quiet"} <= {option.name for option in command.params}
    assert set(LONG) <= set(COMMANDS)


def test_other_commands_tell_of_their_stages(told: tuple[Path, list[Event]], tmp_path: Path) -> None:
    """Those that have loops of their own, and a study, whose steps are runs."""
    folder, _ = told
    for words, stages in (
        (("simulate", "block", "--scans", "3", "--out", tmp_path / "town"), {"simulating"}),
        (("map", folder, "--voxel", "0.5", "--out", tmp_path / "map.ply"), {"map"}),
        (("convert", SAMPLE, "--count", "3", "--to", "kitti", "--out", tmp_path / "kitti"), {"convert"}),
        (("graph", folder, "--no-map", "--out", tmp_path / "graph"), {"odometry", "loops", "pose graph"}),
        (("info", SAMPLE, "--quick", "--all"), {"point times", "points", "sensors"}),
    ):
        done = lslam(*words, "--progress", "json")
        assert done.returncode == 0, done.stderr
        assert stages <= set(check_stages(events(done.stderr)))


def test_a_study_and_a_merge_tell_of_runs_and_stages(told: tuple[Path, list[Event]], tmp_path: Path) -> None:
    folder, _ = told
    out = tmp_path / "two"
    done = lslam(
        "compare", SAMPLE, "--methods", "icp,icp-svd", "--count", "4", "--out", out, "--progress", "json", "--json"
    )
    assert done.returncode == 0, done.stderr
    json.loads(done.stdout)
    found = events(done.stderr)
    assert check_stages(found) == ["comparing"]
    (end,) = [event for event in found if event["event"] == "end"]
    assert (end["done"], end["steps"], end["unit"], end["share"]) == (2, 2, "runs", 1.0)
    again = tmp_path / "again"
    assert lslam("run", SAMPLE, "--count", "60", "-q", "--out", again, "--set", "map.write=false").returncode == 0
    done = lslam("merge", folder, again, "--out", tmp_path / "merged", "--progress", "json")
    assert done.returncode == 0, done.stderr
    assert check_stages(events(done.stderr)) == ["tie", "loops", "graph", "map", "report"]


def test_the_page_has_every_event_with_its_fields(told: tuple[Path, list[Event]]) -> None:
    text = (SAMPLE.parent / "docs/tasks/running.md").read_text()
    rows = re.findall(
        r"^\| ((?:`\w+`(?:, )?)+) \| (.+) \|$", text.partition("| event |")[2].partition("\n\n")[0], re.MULTILINE
    )
    known = {name: set(re.findall(r"`(\w+)`", said)) for names, said in rows for name in re.findall(r"`(\w+)`", names)}
    assert set(known) == {"begin", "progress", "end", "compile", "info", "warning", "error"}
    known["progress"] |= known["begin"]
    known["end"] |= known["begin"]
    lines = text.partition("```json\n")[2].partition("```")[0]
    shown = events(lines)
    assert {"compile", "begin", "progress", "end", "info"} == {event["event"] for event in shown}
    for event in [*shown, *told[1][:-1]]:
        assert set(event) - {"event", "elapsed_s"} <= known[event["event"]]
    in_text = re.search(r"Those of a run are ([^;]*?), as far", text.replace("\n", " "))
    assert in_text
    listed = re.split(r", | and ", in_text.group(1))
    assert [stage for stage in listed if stage in STAGES] == STAGES
    assert set(listed) - set(STAGES) == {"refinement", "feature map"}


@pytest.mark.quick
def test_who_is_killed_leaves_whole_lines(tmp_path: Path) -> None:
    words = ("run", SAMPLE, "--progress", "json", "--out", tmp_path / "run")
    with subprocess.Popen(
        [*COMMAND, *map(str, words)], stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, env=environment()
    ) as process:
        assert process.stderr is not None
        lines = []
        for line in process.stderr:
            lines.append(line)
            if json.loads(line).get("stage") == "odometry":
                os.kill(process.pid, signal.SIGKILL)
                break
        lines += process.stderr.readlines()
    assert process.returncode == -signal.SIGKILL
    assert all(line.endswith("\n") for line in lines)
    assert events("".join(lines))[-1]["event"] in ("begin", "progress", "end", "info")


def test_a_pipe_that_is_closed_does_not_end_the_run(tmp_path: Path) -> None:
    words = [*COMMAND, "run", str(SAMPLE), "--count", "5", "--progress", "json", "--out", str(tmp_path / "run")]
    with subprocess.Popen(words, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, env=environment()) as process:
        assert process.stderr is not None
        process.stderr.readline()
        process.stderr.close()
        assert process.wait(120) == 0
    assert json.loads((tmp_path / "run/manifest.json").read_text())["counts"]["ok"] == 5
