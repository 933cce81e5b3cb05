"""`lslam simulate` as a user calls it."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from pathlib import Path

import pytest
from calling import COMMAND, Done, environment, lslam


def simulated(*words: object) -> Done:
    return lslam("simulate", *words)


def test_a_drive_is_written_and_summed_up_in_one_line(tmp_path: Path) -> None:
    out = tmp_path / "town"
    done = simulated("block", "--out", str(out), "--count", "3", "--seed", "5", "--lidar", "vlp16", "--distorted")
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("\n") == 1
    assert f"{out / 'sequences' / '00'}: 3 scans" in done.stdout
    assert len(list((out / "sequences" / "00" / "velodyne").glob("*.bin"))) == 3
    assert "motion_compensated = false" in (out / "sequences" / "00" / "sequence.toml").read_text()
    again = simulated("block", "--out", str(out), "--count", "3")
    assert again.returncode == 2
    assert again.stdout == ""
    assert "--overwrite" in again.stderr


def test_list_names_scenarios_and_sensors() -> None:
    listed = simulated("--list")
    assert listed.returncode == 0
    assert [line.split()[1] for line in listed.stdout.splitlines()] == [
        "block", "carpark", "climbing", "climbing-hard", "closed", "closed-hard", "corridor", "forest-road", "identical",
        "large-eight", "large-eight-hard", "lights", "motorway", "open", "open-hard", "park", "quadrotor", "residential",
        "residential-hard", "room",
        "small-eight", "small-eight-hard", "stairs", "street", "tunnel", "two-lidars", "urban", "urban-hard", "walk",
        "sample", "vlp16", "hdl64", "hdl64-kitti",
        "os1-16", "os1-32", "os1-64", "livox", "icm20948", "icm20948-calibrated", "phone", "phone-calibrated", "ideal",
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
    done = simulated(*[str(out) if a == "OUT" else a for a in arguments])
    assert done.returncode == 2
    assert done.stdout == ""
    assert sentence in done.stderr
    assert "Traceback" not in done.stderr
    assert not out.exists()


def test_an_output_that_cannot_be_written_is_exit_code_3(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    done = simulated("block", "--out", str(tmp_path / "file" / "below"), "--count", "1")
    assert done.returncode == 3
    assert "cannot be" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_path_file_that_is_absent_is_exit_code_3(tmp_path: Path) -> None:
    done = simulated("--path", str(tmp_path / "poses" / "07.txt"), "--out", str(tmp_path / "out"))
    assert done.returncode == 3
    assert "07.txt does not exist" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "out").exists()


def test_a_plan_is_a_png_and_nothing_else(tmp_path: Path) -> None:
    done = simulated("block", "--plan", str(tmp_path / "plan.svg"))
    assert done.returncode == 2
    assert "name a file FILE.png" in done.stderr
    assert not list(tmp_path.iterdir())


def test_a_plan_of_own_way_points_needs_no_out(tmp_path: Path) -> None:
    (tmp_path / "way.toml").write_text("points = [[0, 0], [60, 0], [60, 50]]\n")
    plan = tmp_path / "plan.png"
    done = simulated(
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
        done = simulated(scenario, "--out", str(out), "--scans", "2", "--set", "world.levels=0", *flags)
        assert done.returncode == 0, done.stderr
        assert f"motion_compensated = {expected}" in (out / "sequences" / "00" / "sequence.toml").read_text()


def test_a_simulation_that_is_ended_goes_on_with_resume(tmp_path: Path) -> None:
    """SIGTERM keeps what is whole; --resume ends with the bytes of an uninterrupted one."""
    out, whole = tmp_path / "out", tmp_path / "whole"
    arguments = ["block", "--scans", "60", "--lidar", "vlp16", "--distorted"]
    running = subprocess.Popen(
        [*COMMAND, "simulate", *arguments, "--out", str(out)], stderr=subprocess.PIPE, text=True, env=environment()
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
    resumed = simulated(*arguments, "--out", str(out), "--resume")
    assert resumed.returncode == 0, resumed.stderr
    assert "are there already" in resumed.stderr
    assert simulated(*arguments, "--out", str(whole)).returncode == 0
    files = {p.relative_to(whole): p.read_bytes() for p in whole.rglob("*") if p.is_file()}
    others = {p.relative_to(out): p.read_bytes() for p in out.rglob("*") if p.is_file()}
    # The manifests quote two commands.
    said = [json.loads(f.pop(Path("sequences/00/manifest.json"))) for f in (files, others)]
    assert [m.pop("command").endswith("--resume") for m in said] == [False, True]
    assert said[0] == said[1]
    assert files == others


def test_info_finds_nothing_wrong_and_the_options_do_what_they_say(tmp_path: Path) -> None:
    def drive(name: str, *words: str) -> Path:
        done = simulated("block", "--out", tmp_path / name, "--count", "12", "--lidar", "vlp16", *words)
        assert done.returncode == 0, done.stderr
        return tmp_path / name

    out = drive("full", "--gnss-rate", "10", "--gnss-outage", "0.25", "0.55", "--static-start", "0.5", "--distorted")
    facts = json.loads(lslam("info", out, "--json").stdout)
    assert facts["problems"] == []
    assert (facts["imu"]["samples"], facts["imu"]["gravity_unit"], facts["imu"]["gaps"]) == (121, "m/s2", 0)
    assert facts["imu"]["rate_hz"] == pytest.approx(100.0)
    assert facts["gnss"]["fixes"] == 13 - 3
    assert all(T is not None for T in facts["extrinsics"].values())
    bare = drive("bare", "--no-imu", "--gnss-rate", "0")
    names = {p.name for p in (bare / "sequences" / "00").iterdir()}
    assert names.isdisjoint({"imu.csv", "gnss.csv"})
    facts = json.loads(lslam("info", bare, "--json").stdout)
    assert facts["problems"] == []
    assert (facts["imu"], facts["gnss"]) == (None, None)
    for words, sentence in (
        (["--gnss-rate", "40"], "--gnss-rate 40 is out of range"),
        (["--static-start", "-1"], "--static-start -1 is out of range"),
        (["--imu-model", "icm2094"], "did you mean 'icm20948'"),
    ):
        refused = simulated("block", "--out", tmp_path / "none", *words)
        assert (refused.returncode, refused.stdout) == (2, "")
        assert sentence in refused.stderr
        assert not (tmp_path / "none").exists()
