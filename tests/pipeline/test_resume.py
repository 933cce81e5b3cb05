"""A run that is interrupted goes on and ends with the bytes of one that was not; what is another run is refused."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stops import die_at, interrupted
from stub_sequences import Stub, noise, sample, with_points

import lslam
from lslam.core.config import Config, load_config
from lslam.core.errors import (
    GateError,
    InterruptedRunError,
    OutputExistsError,
    RunFailedError,
    RunFinishedError,
    UsageError,
)
from lslam.core.types.scan import Scan
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.maps import clean
from lslam.odometry.frontend import checkpoints
from lslam.odometry.frontend.checkpoints import CheckpointSchedule
from lslam.simulation.lidar_models import LIDARS
from lslam.simulation.scenarios import simulate

COUNT = 16


# The first scans are registered again when twenty are known: until then none is decided.
LOOKING_BACK = "registration.start_scans=5"


def config_of(*settings: str) -> Config:
    return load_config(None, ["report.html=false", "registration.start_scans=1", *settings], {})


def drive() -> Stub:
    """A scan of noise, and one that cannot be read, on the way."""
    stub = with_points(sample(COUNT), 5, noise(0))
    stub.scans[10] = "000010.bin: 1001 bytes are not whole points"
    return stub


def rings() -> Stub:
    """The last scan but one is of somewhere else."""
    astray = sample(1, start=60).scans[0]
    assert isinstance(astray, Scan)
    return with_points(sample(COUNT), COUNT - 2, astray.points)


@cache
def walk() -> Stub:
    lidar = replace(LIDARS["vlp16"], columns=900)
    scans = simulate("walk", lidar=lidar, count=COUNT, imu="icm20948", motion_compensated=False)
    return Stub([scans.scan(i) for i in range(COUNT)], None, scans.calibration, motion_compensated=False, imu=scans.imu)


def result_of(folder: Path) -> dict[str, bytes]:
    """Every byte a run promises to repeat."""
    changing = ("manifest.json", "log.txt", "timing.csv", "config.toml", "odometry.npz")
    files = [file for file in folder.rglob("*") if file.is_file() and file.name not in changing]
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


def manifest(folder: Path) -> dict[str, Any]:
    document: dict[str, Any] = json.loads((folder / "manifest.json").read_text())
    return document


Whole = Callable[..., dict[str, bytes]]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Whole:
    """`whole(made, *settings)`: what a run leaves that nothing interrupts, made once of each kind."""

    @cache
    def made_once(made: Callable[[], Stub], *settings: str) -> dict[str, bytes]:
        out = tmp_path_factory.mktemp("whole") / "out"
        lslam.run(made(), config_of(*settings), out=out)
        return result_of(out)

    return made_once


@pytest.fixture
def at_every_scan(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CheckpointSchedule, "is_due", True)


VARIANTS: list[tuple[Callable[[], Stub], tuple[str, ...]]] = [
    (drive, ()),
    (drive, (LOOKING_BACK,)),
    (drive, ("input.threads=1", "preprocess.skip_standing=true")),
    (drive, ("odometry.method=kiss-icp", "map.clean=true", "map.occupancy=true")),
    (rings, ("odometry.method=floam", "input.rings=elevation:16", "map.write_features=true")),
    (walk, ("imu.use=true", "imu.start_s=1")),
]


@pytest.mark.parametrize(("made", "settings"), VARIANTS)
def test_interrupted_twice_it_ends_with_the_same_bytes(
    made: Callable[[], Stub], settings: tuple[str, ...], tmp_path: Path
) -> None:
    config, out = config_of(*settings), tmp_path / "out"
    lslam.run(made(), config, out=tmp_path / "whole")
    for watch in (interrupted("odometry", 7), interrupted("map", 4)):
        with pytest.raises(InterruptedRunError, match="and --resume goes on"):
            lslam.run(made(), config, out=out, resume=True, watch=watch)
        assert manifest(out)["status"] == "interrupted"
    second = replace(made(), reads=[])
    lslam.run(second, config, out=out, resume=True)
    whole, parts = result_of(tmp_path / "whole"), result_of(out)
    assert set(parts) == set(whole)
    if "odometry.method=kiss-icp" in settings:  # its threads sum in any order: the last bit differs from run to run
        poses = (read_trajectory(folder / "trajectory.tum").poses for folder in (out, tmp_path / "whole"))
        np.testing.assert_allclose(*poses, atol=1e-8)
        whole = {}
    for name, data in whole.items():
        assert parts[name] == data, name
    said = (out / "log.txt").read_text()
    assert said.count("kiss-icp begins again at the first scan: its state is its own") == ("kiss-icp" in said)
    facts, once = manifest(out), manifest(tmp_path / "whole")
    assert facts["problems"] == once["problems"]
    assert facts["counts"] == once["counts"]
    assert facts.get("imu") == once.get("imu")
    is_at_end = "odometry.method=kiss-icp" in settings or LOOKING_BACK in settings
    assert facts["resumed_after_scans"] == ([COUNT] if is_at_end else [7, COUNT])


POSES = ("input.threads=1", "map.write=false")


def room() -> Stub:
    scans = simulate("room", seed=1, count=6, lidar="os1-16", motion_compensated=True)
    return Stub([scans.scan(i) for i in range(len(scans))])


@pytest.mark.usefixtures("at_every_scan")
def test_what_the_scene_decided_is_kept_and_another_wish_is_refused(whole: Whole, tmp_path: Path) -> None:
    config, out = config_of(*POSES), tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        lslam.run(replace(room(), on_read=die_at(2)), config, out=out)
    begun = load_config(out / "config.toml", environ={})
    assert begun.registration.voxel_size < 0.8
    with pytest.raises(OutputExistsError, match=r"registration\.voxel_size was .* and is 0\.8"):
        lslam.run(room(), config_of(*POSES, "registration.voxel_size=0.8"), out=out, resume=True)
    again = replace(room(), reads=[])
    lslam.run(again, config, out=out, resume=True)
    assert result_of(out) == whole(room, *POSES)
    assert load_config(out / "config.toml", environ={}) == begun
    assert 1 not in again.reads, "what was registered is not read again"


@pytest.mark.quick
@pytest.mark.usefixtures("at_every_scan")
@pytest.mark.parametrize(("settings", "scan"), [((), 1), ((), 2), ((), 9), ((), 15), ((LOOKING_BACK,), 15)])
def test_it_goes_on_where_it_was_killed(settings: tuple[str, ...], scan: int, whole: Whole, tmp_path: Path) -> None:
    config, out = config_of(*POSES, *settings), tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        lslam.run(replace(drive(), on_read=die_at(scan)), config, out=out)
    again = drive()
    again.reads.clear()
    lslam.run(again, config, out=out, resume=True)
    assert result_of(out) == whole(drive, *POSES, *settings)
    # The first is read twice more: to see whether it has times, and to load the reader's kernels.
    assert again.reads == [0, 0, *range(0 if settings else scan, COUNT)]


FEATURES = ("odometry.method=floam", "input.rings=elevation:16", "map.write=false", "map.write_features=true")


@pytest.mark.usefixtures("at_every_scan")
@pytest.mark.parametrize(
    ("made", "settings", "lost", "again_from"),
    [
        (drive, (), "", 8),
        (drive, (), "map/run-3", 0),
        (drive, ("map.attributes=time,scan,range",), "", 8),
        (drive, ("map.attributes=time,scan,range", "map.voxel=0"), "", 8),
        (drive, ("map.attributes=time,scan,range", "map.voxel=0"), "map/points", 0),
        # Of scans 0 to 7 the sixth was not registered: four are decided, and the cleaner looks three back.
        (drive, ("map.clean=true", "map.occupancy=true"), "", 1),
        (drive, ("map.clean=true", "map.occupancy=true"), "occupancy/run-3", 0),
        (rings, FEATURES, "", 8),
        (rings, FEATURES, "planes/run-3", 0),
    ],
)
def test_the_map_goes_on_where_it_was_killed(
    made: Callable[[], Stub], settings: tuple[str, ...], lost: str, again_from: int, whole: Whole, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(clean, "OFFSETS", (1, 3))
    words = ("input.threads=1", "map.voxel=0.1", *settings)
    config, out = config_of(*words), tmp_path / "out"
    first = made()
    first.reads.clear()

    def die(index: int) -> None:
        if index == 9 and first.reads.count(9) == 2:
            raise KeyboardInterrupt

    first.on_read = die
    with pytest.raises(KeyboardInterrupt):
        lslam.run(first, config, out=out)
    if lost:
        (out / "checkpoint" / lost).unlink()
    again = made()
    again.reads.clear()
    lslam.run(again, config, out=out, resume=True)
    left = COUNT - again_from
    assert again.reads[-left:] == [*range(again_from, COUNT)]
    assert max(again.reads[:-left]) < 5, "only to see what the scans are like"
    assert result_of(out) == whole(made, *words)


@pytest.mark.usefixtures("at_every_scan")
@pytest.mark.parametrize("damage", ["newest", "both", "cloud"])
def test_damaged_checkpoints_cost_time_only(
    damage: str, whole: Whole, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    config, out = config_of(*POSES), tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        lslam.run(replace(drive(), on_read=die_at(12)), config, out=out)
    kept = sorted((out / "checkpoint").glob("odometry-*.npz"))
    assert [file.name for file in kept] == ["odometry-0000011.npz", "odometry-0000012.npz"]
    for file in {"newest": kept[1:], "both": kept, "cloud": []}[damage]:
        file.write_bytes(file.read_bytes()[:1000])
    if damage == "cloud":
        (out / "keyframes" / "000001.npz").unlink()
    again = drive()
    again.reads.clear()
    lslam.run(again, config, out=out, resume=True)
    assert result_of(out) == whole(drive, *POSES)
    assert again.reads[2] == (11 if damage == "newest" else 0)
    said = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert any(("keyframe 1 is missing" if damage == "cloud" else "is damaged") in sentence for sentence in said)


Begun = Callable[..., Config]


@pytest.fixture(scope="module")
def begun(tmp_path_factory: pytest.TempPathFactory) -> Begun:
    """`begun(out, *settings)`: the configuration of a run whose first six scans are in `out`, made once of each kind."""

    @cache
    def made_once(*settings: str) -> tuple[Config, Path]:
        config, out = config_of("map.write=false", *settings), tmp_path_factory.mktemp("begun") / "out"
        with pytest.raises(InterruptedRunError):
            lslam.run(drive(), config, out=out, watch=interrupted("odometry", 6))
        return config, out

    def copied(out: Path, *settings: str) -> Config:
        config, kept = made_once(*settings)
        shutil.copytree(kept, out)
        return config

    return copied


def test_another_configuration_is_refused_and_what_changes_nothing_is_not(begun: Begun, tmp_path: Path) -> None:
    out = tmp_path / "out"
    begun(out, "odometry.checkpoint_s=5")
    before = result_of(out)
    with pytest.raises(OutputExistsError, match=r"registration\.sigma was 0\.03 and is 0\.05.*--overwrite") as refused:
        lslam.run(drive(), config_of("map.write=false", "registration.sigma=0.05"), out=out, resume=True)
    assert refused.value.exit_code == 2
    assert result_of(out) == before, "what was refused is left alone"
    lslam.run(drive(), config_of("map.write=false", "input.threads=1"), out=out, resume=True)
    assert manifest(out)["status"] == "degraded"


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda s: replace(s, ground_truth=None), "the recording or its ground truth"),
        (lambda s: replace(s, scans=s.scans[:-1]), "the recording or its ground truth"),
        (lambda s: replace(s, motion_compensated=None), "read in another way"),
        (lambda s: replace(s, calibration=replace(s.calibration, T_lidar_imu=np.eye(4))), "read in another way"),
    ],
)
def test_another_input_is_refused(change: Callable[[Stub], Stub], why: str, begun: Begun, tmp_path: Path) -> None:
    config = begun(tmp_path / "out")
    with pytest.raises(OutputExistsError, match=why):
        lslam.run(change(drive()), config, out=tmp_path / "out", resume=True)


def test_another_version_or_a_run_that_says_nothing_is_refused(begun: Begun, tmp_path: Path) -> None:
    out = tmp_path / "out"
    config = begun(out)
    facts = manifest(out)
    (out / "manifest.json").write_text(json.dumps(facts | {"lslam": "0.0.1"}))
    with pytest.raises(OutputExistsError, match=r"begun by lslam 0\.0\.1"):
        lslam.run(drive(), config, out=out, resume=True)
    for spoilt in ("{", "[]", json.dumps({"status": "running"})):
        (out / "manifest.json").write_text(spoilt)
        with pytest.raises(OutputExistsError, match=r"does not say what it was.*--overwrite"):
            lslam.run(drive(), config, out=out, resume=True)


def test_a_finished_run_is_left_alone(tmp_path: Path) -> None:
    out = tmp_path / "out"
    config = config_of("map.write=false")
    lslam.run(sample(COUNT), config, out=out)
    assert not (out / "checkpoint").exists()
    before = result_of(out)
    with pytest.raises(RunFinishedError, match=r"is finished \(done\)") as finished:
        lslam.run(sample(COUNT), config, out=out, resume=True)
    assert finished.value.exit_code == 0
    assert result_of(out) == before


def test_a_run_that_diverged_or_missed_its_gate_stays_so(tmp_path: Path) -> None:
    lost = sample(30)
    for i in range(5, 30):
        lost = with_points(lost, i, noise(i, 2000))
    config = config_of("map.write=false")
    for resume, way_out in ((False, "the run diverged"), (True, r"is finished, it diverged.*--overwrite")):
        with pytest.raises(RunFailedError, match=way_out):
            lslam.run(lost, config, out=tmp_path / "lost", resume=resume)
    strict = config_of("input.strict=true", "map.write=false")
    for resume in (False, True):
        with pytest.raises(GateError, match="--strict"):
            lslam.run(drive(), strict, out=tmp_path / "strict", resume=resume)


def test_without_flags_an_interrupted_run_is_refused_and_both_ways_are_named(begun: Begun, tmp_path: Path) -> None:
    config = begun(tmp_path / "out")
    with pytest.raises(OutputExistsError, match=r"--resume goes on.*--overwrite replaces"):
        lslam.run(drive(), config, out=tmp_path / "out")
    lslam.run(drive(), config, out=tmp_path / "out", overwrite=True)
    assert "resumed_after_scans" not in manifest(tmp_path / "out")
    lslam.run(drive(), config, out=tmp_path / "new", resume=True)
    assert manifest(tmp_path / "new")["status"] == "degraded", "where nothing was begun, the run begins"


def test_resume_of_a_folder_that_is_no_run_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(UsageError, match="not a run of lslam"):
        lslam.run(drive(), config_of(), out=tmp_path, resume=True)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_the_pace_of_checkpoints_is_cheap_and_loses_little() -> None:
    """Over an hour: none costs more than a fiftieth, and what a kill loses is a twentieth or half a minute."""
    now = [0.0]
    schedule, written, took = CheckpointSchedule(30.0, clock=lambda: now[0]), [0.0], 0.01
    while now[0] < 3600:
        now[0] += 0.1
        if schedule.is_due:
            now[0] += took
            schedule.wrote(took)
            written.append(now[0])
            lost = written[-1] - written[-2]
            assert lost <= max(1.2, 0.06 * now[0])
            assert lost <= 30.3
    assert took * len(written) < 0.02 * 3600
    assert len(written) < 250
    never = CheckpointSchedule(0.0, clock=lambda: 1e9)
    assert not never.is_due
    slow = CheckpointSchedule(1.0, clock=lambda: now[0])
    slow.wrote(5.0)
    now[0] += 200
    assert not slow.is_due
    now[0] += 60
    assert slow.is_due


def test_checkpoints_can_be_switched_off(tmp_path: Path) -> None:
    config = config_of("odometry.checkpoint_s=0", "map.write=false")
    with pytest.raises(InterruptedRunError):
        lslam.run(drive(), config, out=tmp_path / "out", watch=interrupted("odometry", 6))
    assert not (tmp_path / "out" / "checkpoint").exists()
    assert checkpoints.CHECKPOINT_COPIES == 2
