"""The grid, what names a run and what makes two runs one."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lslam.core.config import Config, load_config
from lslam.core.errors import InputError, UsageError
from lslam.core.printable import file_safe
from lslam.core.types.trajectory import Trajectory
from lslam.io.readers import open_sequence
from lslam.pipeline.resume import input_digest, job_digest
from lslam.simulation.record import record
from lslam.simulation.scenarios import simulate
from lslam.studies.grid import Cell, Job, expand
from lslam.studies.results_csv import State, is_reusable, read_state, write_state
from lslam.studies.runner import StudyProgress
from lslam.studies.subjects import Scene, count_scans, find_subjects, simulate_once
from lslam.studies.variants import Variant, find_variants


def variants(*names: str, settings: tuple[str, ...] = ()) -> list[Variant]:
    return find_variants(names or ("icp", "kiss-icp"), None, settings)


def jobs(variants: list[Variant], cells: list[Cell], seeds: tuple[int, ...] = (0, 1)) -> list[Job]:
    return expand(cells, variants, seeds, Path("out"), "")


def recording(name: str = "drive") -> Cell:
    return Cell(name, Path(name), None, "digest")


def test_a_recording_is_run_once_by_methods_that_do_not_draw() -> None:
    assert [(j.method, j.seed) for j in jobs(variants(), [recording()])] == [("icp", 0), ("kiss-icp", 0)]


def test_a_method_that_draws_runs_every_seed_of_a_recording() -> None:
    drawing = variants(settings=("preprocess.downsample=random",))
    made = jobs(drawing, [recording()], (4, 7))
    assert [(j.method, j.seed) for j in made] == [("icp", 4), ("kiss-icp", 4), ("icp", 7)]
    assert [j.config.preprocess.seed for j in made if j.method == "icp"] == [4, 7]
    assert len({j.digest for j in made}) == 3


def test_a_simulated_cell_is_run_once_per_method_and_folders_differ() -> None:
    made = jobs(variants(), [Cell("block", Path(f"block-{s}"), s, f"{s}") for s in (0, 1)])
    assert len({j.folder for j in made}) == len(made) == 4
    assert Path("out/runs/block/kiss-icp-s1") in {j.folder for j in made}
    assert {j.config.odometry.method for j in made} == {"icp", "kiss-icp"}


@pytest.mark.parametrize(
    ("methods", "sentence"),
    [(("icp", "kis-icp"), "did you mean 'kiss-icp'"), ((), "empty"), (("icp", "icp"), "twice")],
)
def test_methods_are_checked_before_anything_runs(methods: tuple[str, ...], sentence: str) -> None:
    with pytest.raises(UsageError, match=sentence):
        find_variants(methods)


def test_a_preset_or_a_file_is_a_variant_with_all_it_says(tmp_path: Path) -> None:
    (tmp_path / "coarse.toml").write_text("[map]\nvoxel = 0.9\n")
    plain, coarse = variants("icp", str(tmp_path / "coarse.toml"), settings=("input.count=5",))
    assert (plain.name, coarse.name) == ("icp", "coarse")
    assert (plain.config.map.voxel, coarse.config.map.voxel) == (0.2, 0.9)
    assert plain.config.input.count == coarse.config.input.count == 5
    with pytest.raises(UsageError, match="'coarse' twice"):
        variants(str(tmp_path / "coarse.toml"), str(tmp_path / "coarse.toml"))


def test_both_makes_two_of_each_method_and_one_of_what_ignores_the_imu() -> None:
    made = find_variants(("icp", "kiss-icp", "thesis-icp"), imu="both")
    assert [(v.name, v.config.imu.use, v.without) for v in made] == [
        ("icp", False, ""), ("icp+imu", True, "icp"), ("kiss-icp", False, ""), ("thesis-icp", False, ""),
        ("thesis-icp+imu", True, "thesis-icp"),
    ]  # fmt: skip
    assert [v.name for v in find_variants(("icp", "kiss-icp"), imu="on")] == ["icp+imu", "kiss-icp+imu"]
    for imu in ("both", "on", "off", None):
        (tight,) = find_variants(("fast-lio2",), imu=imu)
        assert (tight.name, tight.config.imu.use, tight.without) == ("fast-lio2", True, ""), "with the IMU, once"
    (without,) = find_variants(("icp",), None, ["imu.use=true"], imu="off")
    assert (without.name, without.config.imu.use) == ("icp", False)
    with pytest.raises(UsageError, match="twice"):
        find_variants(("icp", "icp"), imu="on")


def test_jobs_with_and_without_the_imu_are_others_and_only_one_depends_on_what_it_measured() -> None:
    both = find_variants(("icp",), imu="both")
    first, again = (
        expand([replace(recording(), imu=imu)], both, (0,), Path("out"), "") for imu in ("measured", "otherwise")
    )
    assert first[0].folder != first[1].folder
    assert first[0].digest != first[1].digest
    assert [a.digest == b.digest for a, b in zip(first, again, strict=True)] == [True, False]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("drive")
    return record(simulate("block", count=2, lidar="sample"), out).sequence


def test_the_input_is_another_when_a_file_a_truth_or_the_number_of_scans_changes(drive: Path) -> None:
    sequence = open_sequence(drive)
    first = input_digest(sequence, None)
    assert input_digest(open_sequence(drive), None) == first
    scan = drive / "velodyne" / "000001.bin"
    before = scan.stat()
    os.utime(scan, ns=(before.st_atime_ns, before.st_mtime_ns + 1_000_000))
    assert input_digest(sequence, None) != first
    os.utime(scan, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert input_digest(sequence, None) == first
    truth = sequence.ground_truth
    assert truth is not None
    moved = Trajectory(truth.stamps_ns, truth.poses + np.eye(4) * 1e-9)
    assert input_digest(sequence, moved) != first
    data = scan.read_bytes()
    scan.rename(drive / "kept")
    assert input_digest(open_sequence(drive), None) != first
    (drive / "kept").rename(scan)
    assert scan.read_bytes() == data
    for target in ("gone", "nowhere", "velodyne/000001.bin/inside"):
        (drive / "nowhere").symlink_to(target)
        assert input_digest(open_sequence(drive), None) == first, "a link that leads nowhere is no file"
        (drive / "nowhere").unlink()
    (drive / "more").mkdir()
    (drive / "more" / "notes").write_text("")
    assert input_digest(open_sequence(drive), None) != first


def test_the_job_is_another_when_any_key_changes() -> None:
    digests = {job_digest(load_config(None, [s], {}), "x") for s in ("map.voxel=0.2", "map.voxel=0.3", "input.start=1")}
    assert len(digests | {job_digest(Config(), "y")}) == 4
    assert job_digest(Config(), "x") in digests


def test_only_what_was_finished_with_the_same_digest_is_kept(tmp_path: Path) -> None:
    folder, file = tmp_path / "run", tmp_path / "run.json"
    assert not is_reusable(file, folder, "a")
    write_state(file, State("a", "done", load=1.5))
    assert not is_reusable(file, folder, "a")
    folder.mkdir()
    (folder / "manifest.json").write_text("{}")
    assert is_reusable(file, folder, "a")
    assert not is_reusable(file, folder, "b")
    write_state(file, State("a", "crashed", "killed"))
    assert not is_reusable(file, folder, "a")
    assert read_state(file) == State("a", "crashed", "killed")
    file.write_text("{")
    assert read_state(file) is None


def test_a_recording_has_precedence_over_a_scenario_of_its_name_with_a_note(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    assert find_subjects(["block"])[0].scenario == "block"
    (tmp_path / "block").symlink_to(drive.parent.parent)
    (subject,) = find_subjects(["block"])
    assert subject.path == tmp_path / "block"
    assert "also a scenario" in caplog.text


def test_recordings_of_one_name_get_labels_of_their_own(drive: Path, tmp_path: Path) -> None:
    for name in ("wide", "narrow"):
        (tmp_path / name / "sequences").mkdir(parents=True)
        (tmp_path / name / "sequences" / "00").symlink_to(drive)
    words = [str(tmp_path / name / "sequences" / "00") for name in ("wide", "narrow")]
    assert [s.label for s in find_subjects(words)] == ["block-0-wide", "block-0-narrow"]
    with pytest.raises(UsageError, match="named twice"):
        find_subjects([words[0], words[0]])


def test_a_name_that_is_nothing_is_answered_with_the_nearest_scenario() -> None:
    with pytest.raises(InputError, match=r"no sequence 'stret'.*did you mean 'street'"):
        find_subjects(["stret"])


def test_names_stay_inside_the_folder() -> None:
    assert "/" not in file_safe("../../etc/passwd")
    assert file_safe("...") == "sequence"


def test_a_simulation_has_the_scans_that_will_be_used() -> None:
    short = load_config(None, ["input.start=5", "input.count=3", "input.skip_frames=4"], {}).input
    assert count_scans([short, load_config(None, ["input.count=9"], {}).input]) == 14
    assert count_scans([short, Config().input]) is None


def test_a_scenario_is_simulated_once(tmp_path: Path) -> None:
    steps: list[str] = []
    progress = StudyProgress(lambda stage, *of: steps.append(stage), lambda note: steps.append("scan"))
    made = [simulate_once(Scene("block", 2), 3, tmp_path, progress) for _ in range(2)]
    assert made[0] == made[1]
    assert steps == ["simulating block, seed 3", "scan", "scan"]
    assert len(open_sequence(made[0])) == 2
