"""A small study from its file to its rows: run, kept, resumed after a kill, failing in parts and as a whole."""

from __future__ import annotations

import shutil
import time
import tomllib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lslam.core.config.study import StudyConfig, parse_study
from lslam.core.errors import (
    ConfigError,
    InputError,
    InterruptedRunError,
    OutputExistsError,
    RunFailedError,
    UsageError,
)
from lslam.core.types.study import StudyRow
from lslam.studies.estimate import estimate, extrapolate
from lslam.studies.jobs import ExpandedStudy, Local
from lslam.studies.options import OutputOptions, find_study
from lslam.studies.results import is_comparable
from lslam.studies.results_csv import VERSION, State, read_state, read_study_csv
from lslam.studies.runner import StudyProgress
from lslam.studies.study_runs import Sweep, expand_study, run_sweep, write_study_report
from lslam.studies.subjects import scans_of_run

pytestmark = pytest.mark.usefixtures("forked_runs")

TREE: dict[str, Any] = {
    "sequences": [{"scenario": "block", "lidar": "sample", "columns": 256, "scans": 16}],
    "methods": ["icp"],
    "beside": ["kiss-icp"],
    "seeds": [3],
    "parameters": {"input": {"skip_frames": [1, 2]}, "preprocess.source_voxel": [0.8, 1.2]},
    "config": {"loops": {"use": False}, "preprocess": {"downsample": "grid"}},
}
NAMES = [
    "icp-skip_frames_1-source_voxel_0.8", "icp-skip_frames_1-source_voxel_1.2", "icp-skip_frames_2-source_voxel_0.8",
    "icp-skip_frames_2-source_voxel_1.2", "beside-kiss-icp",
]  # fmt: skip


def study(**changes: Any) -> StudyConfig:
    return parse_study(TREE | changes, "tiny.toml", "tiny")


def elsewhere(sweep: Sweep, out: Path, resume: bool = False, **changes: Any) -> Sweep:
    """The same simulations in another folder, of a study with changes."""
    return replace(sweep, study=study(**changes), output=replace(sweep.output, out=out, resume=resume))


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("scenes")


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory, scenes: Path) -> Sweep:
    return Sweep(study(), OutputOptions(tmp_path_factory.mktemp("study") / "out", scenes=scenes))


@pytest.fixture(scope="module")
def made(sweep: Sweep) -> list[StudyRow]:
    seen: list[int] = []
    rows = run_sweep(sweep, Local(1), on_rows=lambda rows: seen.append(len(rows)))
    assert seen == [0, 1, 2, 3, 4, 5], "rows come one by one"
    return rows


def test_every_point_is_a_row_with_its_values_and_numbers(made: list[StudyRow], sweep: Sweep) -> None:
    assert [row.run for row in made] == [f"block/{name}-s3" for name in NAMES]
    assert [(row.method, row.is_beside, row.seed) for row in made] == [("icp", False, 3)] * 4 + [("kiss-icp", True, 3)]
    assert made[2].parameters == {"input.skip_frames": 2, "preprocess.source_voxel": 0.8}
    assert made[4].parameters == {}
    assert [row.scans for row in made] == [16, 16, 8, 8, 16]
    for row in made:
        assert row.status in ("done", "degraded"), row.reason
        assert 0 < row.thesis_rmse < row.ate_origin < 1
        assert "read" not in row.stages_ms
        assert row.total_time_s == pytest.approx(row.time_per_scan_ms * row.scans / 1e3)
        assert row.total_time_s < row.run_s
        assert (sweep.output.out / row.folder / "manifest.json").is_file()
        assert not [*(sweep.output.out / row.folder).glob("map.*"), *(sweep.output.out / row.folder).glob("keyframes")]
        config = tomllib.loads((sweep.output.out / row.folder / "config.toml").read_text())
        assert config["input"]["threads"] == 1


def test_files_hold_the_same_rows(made: list[StudyRow], sweep: Sweep) -> None:
    assert [repr(row) for row in read_study_csv(sweep.output.out / "results.csv")] == [repr(row) for row in made]
    assert (sweep.output.out / "results.parquet").stat().st_size > 0
    again = find_study(str(sweep.output.out / "study.toml"))
    assert again == sweep.study


def test_kept_data_and_processes_change_nothing(made: list[StudyRow], sweep: Sweep, tmp_path: Path) -> None:
    """The last of the runs, made anew in a process of its own."""
    one = elsewhere(sweep, tmp_path, parameters={"input.skip_frames": [2]}, beside=[])
    one = replace(one, settings=("preprocess.source_voxel=1.2",))
    (row,) = run_sweep(one, Local(1, is_persistent=False))
    assert row.digest == made[3].digest
    first, second = (
        out / r.folder / "trajectory.tum" for out, r in ((one.output.out, row), (sweep.output.out, made[3]))
    )
    assert first.read_bytes() == second.read_bytes()


def test_a_study_that_grew_runs_only_what_is_new(made: list[StudyRow], sweep: Sweep, tmp_path: Path) -> None:
    out = tmp_path / "copy"
    shutil.copytree(sweep.output.out, out)
    with pytest.raises(OutputExistsError, match="--resume keeps"):
        run_sweep(elsewhere(sweep, out), Local(1))
    grown = elsewhere(sweep, out, True, parameters={"input.skip_frames": [1, 2, 4], "preprocess.source_voxel": [0.8]})
    steps: list[str] = []
    rows = run_sweep(grown, Local(1), StudyProgress(on_step=steps.append))
    assert steps == ["block icp-skip_frames_4-source_voxel_0.8 seed 3"]
    assert [row.parameters.get("input.skip_frames") for row in rows] == [1, 2, 4, None]
    assert repr(rows[0]) == repr(made[0])


def test_another_study_does_not_go_on_in_the_folder_of_this_one(
    made: list[StudyRow], sweep: Sweep, tmp_path: Path
) -> None:
    out = tmp_path / "copy"
    shutil.copytree(sweep.output.out, out)
    before = (out / "results.csv").read_bytes(), (out / "study.toml").read_bytes()
    other = elsewhere(sweep, out, True, name="shares")
    for go_on in (expand_study, lambda sweep: run_sweep(sweep, Local(1))):
        with pytest.raises(OutputExistsError, match=r"holds study 'tiny' and .* with study 'shares': .*--out"):
            go_on(other)
    assert ((out / "results.csv").read_bytes(), (out / "study.toml").read_bytes()) == before


def test_another_study_may_replace_the_one_in_a_folder(sweep: Sweep, tmp_path: Path) -> None:
    (tmp_path / "study.toml").write_text('name = "tiny"\n')
    other = elsewhere(sweep, tmp_path, name="shares")
    assert expand_study(replace(other, output=replace(other.output, overwrite=True))).name == "shares"


def test_what_fails_is_a_row_with_its_reason(sweep: Sweep, tmp_path: Path) -> None:
    """The first scan of the second run lies beyond the recording."""
    partly = elsewhere(sweep, tmp_path / "out", parameters={"input.start": [0, 99]}, beside=[])
    rows = run_sweep(partly, Local(1))
    assert [(row.status, row.diverges) for row in rows] == [("done", False), ("failed", False)]
    assert "beyond the last scan" in rows[1].reason
    wholly = elsewhere(sweep, tmp_path / "none", parameters={"input.start": [98, 99]}, beside=[])
    with pytest.raises(RunFailedError, match=r"all 2 runs failed, the first one: .*--start 98 is beyond the last scan"):
        run_sweep(wholly, Local(1))
    assert len(read_study_csv(tmp_path / "none" / "results.csv")) == 2


def test_an_interruption_says_how_to_go_on(made: list[StudyRow], sweep: Sweep, tmp_path: Path) -> None:
    class Interrupted(Local):
        def run(self, jobs: object, progress: object, on_done: object) -> None:
            raise KeyboardInterrupt

    shutil.copytree(sweep.output.out, tmp_path / "out")
    grown = elsewhere(sweep, tmp_path / "out", True, seeds=[3, 4])
    with pytest.raises(InterruptedRunError, match=r"interrupted; 5 of 10 runs are finished in .*--resume goes on"):
        run_sweep(grown, Interrupted(1))


def test_results_of_another_version_are_not_mixed(sweep: Sweep, made: list[StudyRow], tmp_path: Path) -> None:
    shutil.copytree(sweep.output.out, tmp_path / "out")
    file = tmp_path / "out" / "results.csv"
    file.write_text(file.read_text().replace(f"\n{VERSION},", "\n0,"))
    with pytest.raises(InputError, match="written by another version of lslam"):
        run_sweep(elsewhere(sweep, tmp_path / "out", True), Local(1))
    anew = elsewhere(sweep, tmp_path / "out", parameters={"input.skip_frames": [2]}, beside=[])
    rows = run_sweep(replace(anew, output=replace(anew.output, overwrite=True)), Local(1))
    assert [repr(row) for row in read_study_csv(file)] == [repr(row) for row in rows]


@pytest.mark.parametrize(
    ("changes", "error", "sentence"),
    [
        ({"parameters": {"input.skip_frame": [1]}}, ConfigError, "skip_frame = 1: unknown key.*mean 'skip_frames'"),
        ({"parameters": {"preprocess.random_share": [0.5, 2]}}, ConfigError, "random_share = 2: .*less than or equal to 1"),
        ({"config": {"eval": {"align": ["origin"]}}}, UsageError, "judges by ate_se3, and eval.align has origin only: add se3"),
        ({"methods": ["ipc"]}, UsageError, "no method or preset 'ipc'; did you mean 'icp'"),
        ({"beside": ["lom"]}, UsageError, "did you mean 'loam'"),
        ({"methods": ["loam"], "parameters": {"registration.inlier_ratio": [0.5]}}, UsageError, "does nothing with method loam"),
        ({"sequences": [{"scenario": "opn"}]}, UsageError, "did you mean 'open'"),
        ({"sequences": [{"path": "nowhere"}]}, InputError, "nowhere"),
    ],
)  # fmt: skip
def test_what_cannot_be_studied_is_said_before_anything_runs(
    changes: dict[str, Any], error: type[Exception], sentence: str, tmp_path: Path
) -> None:
    with pytest.raises(error, match=sentence):
        run_sweep(Sweep(study(**changes), OutputOptions(tmp_path / "out")), Local(1))
    assert not (tmp_path / "out").exists()


def test_the_same_scenario_seen_otherwise_is_another_sequence(tmp_path: Path) -> None:
    two = study(sequences=[{"scenario": "block", "columns": n} for n in (256, 512)], imu="both", beside=[])
    expanded: ExpandedStudy = expand_study(Sweep(two, OutputOptions(tmp_path / "out")))
    assert {job.sequence for job in expanded.jobs} == {"block", "block-2"}
    assert (
        len({job.folder for job in expanded.jobs})
        == len({job.digest for job in expanded.jobs})
        == len(expanded.jobs)
        == 16
    )
    assert {(c.method, c.uses_imu) for c in expanded.variants.values()} == {("icp", False), ("icp", True)}


def test_scans_of_single_sequences_are_used_as_they_say(sweep: Sweep, tmp_path: Path) -> None:
    """Both from one simulation: 16 scans, of which one run uses 5 from the 8th on, the other the first 7."""
    block = TREE["sequences"][0]
    two = elsewhere(
        sweep, tmp_path / "out", sequences=[block | {"start": 8, "count": 5}, block], beside=[],
        parameters={"preprocess.source_voxel": [0.8]}, config={"loops": {"use": False}, "input": {"count": 7}},
    )  # fmt: skip
    rows = run_sweep(two, Local(1))
    assert [(row.sequence, row.scans) for row in rows] == [("block", 5), ("block-2", 7)]
    inputs = [tomllib.loads((two.output.out / row.folder / "config.toml").read_text())["input"] for row in rows]
    assert [(i["start"], i["count"]) for i in inputs] == [(8, 5), (0, 7)]
    assert find_study(str(two.output.out / "study.toml")) == two.study
    assert len({row.digest for row in rows}) == 2
    beaten = expand_study(replace(two, settings=("input.count=3",)))
    assert [(j.config.input.start, j.config.input.count) for j in beaten.jobs] == [(8, 3), (0, 3)], (
        "--set beats the file"
    )


def test_a_scenario_has_the_scans_that_its_own_range_needs(tmp_path: Path) -> None:
    def scans(**own: int) -> int | None:
        one = study(sequences=[{"scenario": "street", "columns": 256} | own], beside=[])
        job = expand_study(Sweep(one, OutputOptions(tmp_path / "out"))).jobs[0]
        assert job.scene is not None
        return job.scene.scans

    # skip_frames is studied, up to 2; the street has 266 scans.
    assert scans(start=10, count=50) == 10 + 49 * 2 + 1
    assert scans(count=200) is None, "all there are"
    assert scans(start=10) is None
    assert scans() is None


def test_scans_beyond_the_end_of_a_sequence_are_refused(sweep: Sweep, made: list[StudyRow], tmp_path: Path) -> None:
    recorded = str(min((sweep.output.scenes or tmp_path).rglob("sequences/00")))
    street, drive = {"scenario": "street", "columns": 256}, {"path": recorded}
    for sequence, name in (
        (TREE["sequences"][0] | {"start": 16}, "block has 16 scans: start = 16 goes"),
        (TREE["sequences"][0] | {"start": 12, "count": 5}, "block has 16 scans: start = 12, count = 5 goes"),
        (drive | {"count": 17}, r"block-3 has 16 scans: count = 17 goes"),
        (street | {"count": 267}, "street has 266 scans: count = 267 goes"),
        (street | {"start": 266}, "street has 266 scans: start = 266 goes"),
    ):  # fmt: skip
        with pytest.raises(UsageError, match=f"sequence {name} beyond its end"):
            expand_study(elsewhere(sweep, tmp_path / "out", sequences=[sequence]))
    fits = elsewhere(sweep, tmp_path / "out", sequences=[drive | {"start": 12, "count": 4}])
    assert {job.config.input.start for job in expand_study(fits).jobs} == {12}


def test_keys_of_one_name_in_two_sections_are_runs_of_their_own(tmp_path: Path) -> None:
    keys = ("registration.inlier_distance", "imu.inlier_distance")
    two = study(grid="one-way", parameters={key: [0.5, 1.0] for key in keys}, imu="on", beside=[])
    expanded = expand_study(Sweep(two, OutputOptions(tmp_path / "out")))
    said = [expanded.variants[job.method].parameters for job in expanded.jobs]
    assert said == [{key: value} for key in keys for value in (0.5, 1.0)]
    assert len({job.folder for job in expanded.jobs}) == 4


def test_the_time_is_estimated_from_short_runs_and_their_report(
    sweep: Sweep, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reported: list[Sequence[StudyRow]] = []

    def report(folder: Path, rows: Sequence[StudyRow]) -> None:
        write_study_report(folder, rows)
        reported.append(rows)
        time.sleep(2)

    monkeypatch.setattr("lslam.studies.estimate.write_study_report", report)
    jobs = expand_study(replace(sweep, study=study(beside=[], parameters={"input.skip_frames": [1, 2]})))
    guess = estimate(jobs.jobs, jobs.variants, 1, own_s=300.0)
    assert guess.pilots == 5
    assert 302 < guess.around_s + 0.1 < guess.seconds < 420
    assert [row.parameters["input.skip_frames"] for row in reported[0]] == [1, 1, 1, 2, 2]
    assert all(row.is_usable for row in reported[0])


@pytest.mark.parametrize(("at_once", "times", "expected"), [(1, 1, 11.4), (2, 1, 9.7), (2, 40, 76.0)])
def test_an_estimate_adds_up_what_is_told_apart(
    at_once: int, times: int, expected: float, made: list[StudyRow], sweep: Sweep, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pilots of 0.5 s and 0.1 s a scan, 5 s more for the first, 60 s to compile; a report of 3 s; runs of 16 and 8 scans."""
    asked: list[tuple[str, int]] = []

    def fake(pilots: Sequence[Any], folder: Path, progress: StudyProgress) -> tuple[list[Any], list[float]]:
        asked.append((folder.name, len(pilots)))
        first = 60 if len(asked) == 1 else 5
        return [], [0.5 + 0.1 * pilot.scans + first * (k == 0) for k, pilot in enumerate(pilots)]

    monkeypatch.setattr("lslam.studies.estimate._run", fake)
    monkeypatch.setattr("lslam.studies.estimate._report_s", lambda *given: 3.0)
    jobs = expand_study(replace(sweep, study=study(beside=[], parameters={"input.skip_frames": [1, 2]})))
    assert estimate(jobs.jobs * times, jobs.variants, at_once).seconds == pytest.approx(expected, abs=0.01)
    assert asked == [("compile", 1), ("0", 5)]


def test_the_time_is_that_of_finished_runs_of_the_same_kind(sweep: Sweep, made: list[StudyRow], tmp_path: Path) -> None:
    shutil.copytree(sweep.output.out, tmp_path / "out")
    jobs = expand_study(elsewhere(sweep, tmp_path / "out", True)).jobs
    variants = expand_study(elsewhere(sweep, tmp_path / "out", True)).variants
    seconds = {job.folder: read_state(job.state_file).seconds for job in jobs}  # type: ignore[union-attr]
    same = [job for job in jobs if variants[job.method].method == variants[jobs[0].method].method]
    same = [job for job in same if variants[job.method].is_beside == variants[jobs[0].method].is_beside]
    every = extrapolate(jobs, jobs, variants, 1)
    assert every is not None
    assert every.seconds == pytest.approx(sum(seconds.values())), "all anew"
    jobs[0].state_file.unlink()
    guess = extrapolate(jobs, jobs[:1], variants, 1)
    assert guess is not None
    assert guess.seconds == pytest.approx(np.mean([seconds[job.folder] for job in same[1:]]))
    assert extrapolate(jobs, [*jobs[:1], *jobs[:1]], variants, 2).seconds == guess.seconds  # type: ignore[union-attr]
    other = expand_study(elsewhere(sweep, tmp_path / "out", True, config={"input": {"count": 9}}))
    assert extrapolate(other.jobs, other.jobs, other.variants, 1) is None, "runs of another configuration"


def test_pilots_of_scans_far_along_the_way_have_them(
    sweep: Sweep, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lslam.studies.estimate._MOST_SCANS", 6)
    late = TREE["sequences"][0] | {"start": 9, "count": 4}
    jobs = expand_study(Sweep(study(sequences=[late], beside=[]), OutputOptions(tmp_path / "out")))
    assert estimate(jobs.jobs, jobs.variants, 1).pilots > 1


def test_an_estimate_names_the_pilot_that_failed(sweep: Sweep) -> None:
    jobs = expand_study(replace(sweep, study=study(beside=[], parameters={"input.start": [0, 99]})))
    with pytest.raises(RunFailedError, match=r"a pilot run of block icp-start_99 seed 3 failed, .*: .*beyond the last"):
        estimate(jobs.jobs, jobs.variants, 1)


@pytest.mark.parametrize(
    ("is_alone", "waited", "expected"), [(True, 0.0, True), (True, 0.2, False), (False, 0.0, False)]
)
def test_times_are_comparable_of_runs_that_had_a_core(is_alone: bool, waited: float, expected: bool) -> None:
    assert is_comparable(State("", "done", is_alone=is_alone, waited=waited)) is expected


def test_scans_used_are_those_a_run_counts(made: list[StudyRow], sweep: Sweep) -> None:
    for job, row in zip(expand_study(sweep).jobs, made, strict=True):
        assert scans_of_run(16, job.config.input) == row.scans
