"""A few kills, always drawn alike, and the harness itself: what it must not let through.

More by hand: `python -m tests.kills --count 100`.
"""

from __future__ import annotations

import json
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from random import Random

import pytest
from kills.campaign import Tally, Whole, drawn, kill_one, undisturbed
from kills.child import END, ODOMETRY, STAGES, START
from kills.compare import TIMED_FILES, differences
from kills.trial import OUT, Kill, Run, faults_after_kill, run
from kills.whole import torn

COUNT = 4


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Whole:
    tally = Tally()
    found = undisturbed("sparse", tmp_path_factory.mktemp("kills"), tally)
    assert not tally.faults
    return found


@pytest.fixture
def copy(whole: Whole, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole.place / OUT, tmp_path / OUT))


def test_killed_runs_go_on_to_the_same_bytes(whole: Whole, tmp_path: Path) -> None:
    tally = Tally()

    def is_enough() -> bool:
        return tally.kills >= COUNT and sum(tally.by_stage(stage) > 0 for stage in STAGES) >= 3

    # A run quicker than the one that was measured ends before it is killed, or is killed in another stage: then another is.
    for number in range(3 * COUNT):
        if not is_enough():
            most = max(COUNT - tally.kills, 1)
            _, found = kill_one("sparse", whole, tmp_path / f"{number}", Random(number), tally, most)
            assert not found
    assert is_enough()


def test_a_run_says_in_which_stage_it_is(whole: Whole) -> None:
    assert tuple(whole.lengths) == STAGES
    assert all(seconds > 0 for seconds in whole.lengths.values())


def test_each_stage_is_drawn(whole: Whole) -> None:
    """Those that were hit least, as long as nothing else was, whatever their length."""
    rng, tally = Random(0), Tally()
    for _ in range(100):
        kill = drawn(rng, whole, tally)
        assert 0 <= kill.seconds <= (whole.life if kill.stage == START else whole.lengths[kill.stage])
        tally.note("loops", Run(stage=kill.stage), kill)  # the name of a stage, too
    assert all(tally.by_stage(stage) >= 3 for stage in STAGES)
    assert sum(map(tally.by_stage, STAGES)) == tally.kills == 100


def test_half_a_file_of_any_kind_is_detected(copy: Path) -> None:
    """Every other one at a time, so that those between are found whole."""
    assert torn(copy) == []
    paths = sorted(path for path in copy.rglob("*") if path.is_file() and path.name != "log.txt")
    assert len(paths) > 40
    for halves in (paths[::2], paths[1::2]):
        whole = {path: path.read_bytes() for path in halves}
        for path, data in whole.items():
            path.write_bytes(data[: len(data) // 2])
        said = [said.split(" is no whole file")[0] for said in torn(copy)]
        assert said == [path.relative_to(copy).as_posix() for path in halves]
        for path, data in whole.items():
            path.write_bytes(data)


def test_an_unknown_file_is_detected(copy: Path) -> None:
    (copy / "more.xyz").write_text("1 2 3\n")
    assert len(torn(copy)) == 1


def test_one_changed_byte_is_detected_anywhere(whole: Whole, copy: Path) -> None:
    for path in [path for path in copy.iterdir() if path.is_file() and path.name not in TIMED_FILES]:
        data = path.read_bytes()
        path.write_bytes(data.replace(b"0.1", b"0.2", 1) if path.suffix in (".json", ".html") else data[:-1] + b"?")
        assert differences(copy, whole.place / OUT) == [f"{path.name} differs"]
        path.write_bytes(data)
    (copy / "map.ply.part").write_bytes(b"")
    (copy / "map.ply").unlink()
    assert differences(copy, whole.place / OUT) == ["map.ply is missing", "map.ply.part should not be there"]


def test_times_are_no_difference(whole: Whole, copy: Path) -> None:
    tree = json.loads((copy / "manifest.json").read_text())
    tree["timings"]["map_s"], tree["imu"]["saved_ms_per_scan"], tree["resumed_after_scans"] = 7.0, 7.0, [3]
    (copy / "manifest.json").write_text(json.dumps(tree))
    (copy / "timing.csv").write_text("other\n")
    assert differences(copy, whole.place / OUT) == []
    tree["counts"]["ok"] = 7
    (copy / "manifest.json").write_text(json.dumps(tree))
    assert differences(copy, whole.place / OUT) == ["manifest.json differs"]


def _status(place: Path, status: str) -> None:
    (place / OUT / "manifest.json").write_text(json.dumps({"status": status}))


@pytest.mark.parametrize(
    ("number", "ended", "spoil", "said"),
    [
        (signal.SIGTERM, Run(stage=ODOMETRY, code=130), lambda place: None, ""),
        (signal.SIGKILL, Run(stage=ODOMETRY, code=-9), lambda place: _status(place, "running"), ""),
        (signal.SIGTERM, Run(stage=START, code=-15), lambda place: None, ""),
        (signal.SIGINT, Run(stage=END, code=0), lambda place: _status(place, "done"), ""),
        (signal.SIGTERM, Run(stage=ODOMETRY, code=-15), lambda place: None, "ends with -15, not 130"),
        (signal.SIGTERM, Run(stage=ODOMETRY, code=1), lambda place: _status(place, "failed"), "ends with 1, not 130"),
        (signal.SIGINT, Run(stage=ODOMETRY, code=130), lambda place: _status(place, "running"), "status is running"),
        (signal.SIGINT, Run(stage=ODOMETRY, code=130, answer=60.0), lambda place: None, "took 60.0 s"),
        (signal.SIGINT, Run(stage=ODOMETRY, code=130, said="Traceback\nx"), lambda place: None, "says x"),
        (signal.SIGINT, Run(stage=ODOMETRY, code=130), lambda place: (place / "out/a.part").touch(), "leaves out/a.part"),
        (signal.SIGKILL, Run(stage=ODOMETRY, code=-9), lambda place: (place / "out/map.ply").touch(), "no whole file"),
    ],
)  # fmt: skip
def test_forbidden_states_after_a_signal_are_detected(
    tmp_path: Path, number: signal.Signals, ended: Run, spoil: Callable[[Path], object], said: str
) -> None:
    (tmp_path / OUT).mkdir()
    _status(tmp_path, "interrupted")
    spoil(tmp_path)
    found = faults_after_kill(tmp_path, ended, Kill(number, 0.0))
    assert bool(found) == bool(said)
    assert not said or any(said in fault for fault in found)


@pytest.mark.quick
def test_a_kill_hits_in_the_stage_requested(tmp_path: Path) -> None:
    done = run("plain", tmp_path, Kill(signal.SIGKILL, 0.0, ODOMETRY))
    assert (done.is_hit, done.stage, done.code) == (True, ODOMETRY, -signal.SIGKILL)
