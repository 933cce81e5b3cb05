"""`lslam simulate` as a user calls it."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest


def lslam(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "lslam", "simulate", *arguments], capture_output=True, text=True, timeout=120
    )


def test_a_drive_is_written_and_summed_up_in_one_line(tmp_path: Path) -> None:
    out = tmp_path / "town"
    done = lslam("block", "--out", str(out), "--count", "3", "--seed", "5", "--lidar", "vlp16", "--distorted")
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("\n") == 1
    assert f"{out / 'sequences' / '00'}: 3 scans" in done.stdout
    assert len(list((out / "sequences" / "00" / "velodyne").glob("*.bin"))) == 3
    assert "motion_compensated = false" in (out / "sequences" / "00" / "sequence.toml").read_text()
    again = lslam("block", "--out", str(out), "--count", "3")
    assert again.returncode == 2
    assert again.stdout == ""
    assert "--overwrite" in again.stderr


def test_list_names_scenarios_and_sensors() -> None:
    listed = lslam("--list")
    assert listed.returncode == 0
    assert [line.split()[1] for line in listed.stdout.splitlines()] == [
        "block", "climbing", "closed", "corridor", "identical", "large-eight", "motorway", "open", "residential",
        "small-eight", "street", "urban", "walk", "sample", "vlp16", "hdl64", "hdl64-kitti", "os1-16", "os1-32", "os1-64",
        "livox", "icm20948", "icm20948-calibrated", "ideal",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["blok", "--out", "OUT"], "did you mean 'block'"),
        (["block"], "--out DIR is missing"),
        ([], "SCENARIO is missing"),
        (["street", "--out", "OUT", "--count", "5000"], "--speed"),
        (["block", "--out", "OUT", "--speed", "90"], "at most 40 m/s"),
        (["block", "--out", "OUT", "--lidar", "lidex"], "no LiDAR 'lidex'"),
        (["block", "--out", "OUT", "--set", "layout.storys=[1, 2]"], "did you mean 'storeys'"),
        (["block", "--out", "OUT", "--set", "speed"], "expected key=value"),
        (["small-eight", "--out", "OUT", "--speed", "20"], "use a lower --speed"),
        (["block", "--out", "OUT", "--overwrite", "--resume"], "give one of them"),
    ],
)
def test_wrong_use_is_one_sentence_and_exit_code_2(arguments: list[str], sentence: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = lslam(*[str(out) if a == "OUT" else a for a in arguments])
    assert done.returncode == 2
    assert done.stdout == ""
    assert sentence in done.stderr
    assert "Traceback" not in done.stderr
    assert not out.exists()


def test_an_output_that_cannot_be_written_is_exit_code_3(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    done = lslam("block", "--out", str(tmp_path / "file" / "below"), "--count", "1")
    assert done.returncode == 3
    assert "cannot be" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_path_file_that_is_absent_is_exit_code_3(tmp_path: Path) -> None:
    done = lslam("--path", str(tmp_path / "poses" / "07.txt"), "--out", str(tmp_path / "out"))
    assert done.returncode == 3
    assert "07.txt does not exist" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "out").exists()


def test_a_plan_is_a_png_and_nothing_else(tmp_path: Path) -> None:
    done = lslam("block", "--plan", str(tmp_path / "plan.svg"))
    assert done.returncode == 2
    assert "name a file FILE.png" in done.stderr
    assert not list(tmp_path.iterdir())


def test_a_plan_of_own_way_points_needs_no_out(tmp_path: Path) -> None:
    (tmp_path / "way.toml").write_text("points = [[0, 0], [60, 0], [60, 50]]\n")
    plan = tmp_path / "plan.png"
    done = lslam(
        "--path",
        str(tmp_path / "way.toml"),
        "--plan",
        str(plan),
        "--set",
        "path.smoothing=6",
        "--set",
        "world.levels=0",
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"{plan}: ")
    assert plan.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert [p.name for p in tmp_path.iterdir() if p.suffix != ".toml"] == ["plan.png"]


def test_a_scenario_says_itself_whether_scans_are_compensated(tmp_path: Path) -> None:
    for scenario, flags, expected in (
        ("small-eight", [], "true"),
        ("corridor", [], "false"),
        ("corridor", ["--compensated"], "true"),
    ):
        out = tmp_path / (scenario + "".join(flags))
        done = lslam(scenario, "--out", str(out), "--scans", "2", "--set", "world.levels=0", *flags)
        assert done.returncode == 0, done.stderr
        assert f"motion_compensated = {expected}" in (out / "sequences" / "00" / "sequence.toml").read_text()


def test_a_simulation_that_is_ended_goes_on_with_resume(tmp_path: Path) -> None:
    """SIGTERM keeps what is whole; --resume ends with the bytes of an uninterrupted one."""
    out, whole = tmp_path / "out", tmp_path / "whole"
    arguments = ["block", "--scans", "60", "--lidar", "vlp16", "--distorted"]
    running = subprocess.Popen(
        [sys.executable, "-m", "lslam", "simulate", *arguments, "--out", str(out)], stderr=subprocess.PIPE, text=True
    )
    third = out / "sequences" / "00.part" / "per_point" / "000002.npz"
    deadline = time.monotonic() + 60
    while not third.exists() and time.monotonic() < deadline and running.poll() is None:
        time.sleep(0.01)
    running.send_signal(signal.SIGTERM)
    _, said = running.communicate(timeout=60)
    assert running.returncode == 130, said
    assert "--resume goes on" in said
    assert "Traceback" not in said
    assert not (out / "sequences" / "00").exists()
    resumed = lslam(*arguments, "--out", str(out), "--resume")
    assert resumed.returncode == 0, resumed.stderr
    assert "are there already" in resumed.stderr
    assert lslam(*arguments, "--out", str(whole)).returncode == 0
    files = {p.relative_to(whole): p.read_bytes() for p in whole.rglob("*") if p.is_file()}
    others = {p.relative_to(out): p.read_bytes() for p in out.rglob("*") if p.is_file()}
    # The manifests quote two commands.
    said = [json.loads(f.pop(Path("sequences/00/manifest.json"))) for f in (files, others)]
    assert [m.pop("command").endswith("--resume") for m in said] == [False, True]
    assert said[0] == said[1]
    assert files == others
