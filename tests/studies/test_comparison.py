"""A whole comparison: with ground truth, without, and on a recording nothing can be made of."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import lslam
from lslam.core.errors import InputError, InterruptedRunError, OutputExistsError, UsageError
from lslam.core.geometry import se3, so3
from lslam.core.types.comparison import Comparison, RunScore
from lslam.core.types.trajectory import Trajectory
from lslam.evaluation.evaluate import evaluate
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.io.readers import open_sequence
from lslam.pipeline.watch import Watch
from lslam.simulation.record import record
from lslam.simulation.scenarios import simulate
from lslam.studies.compare import Plan, _in_own_world, _in_world_of_truth, check_plan, run_comparison
from lslam.studies.grid import Job
from lslam.studies.jobs import Local, folders_of_finished
from lslam.studies.options import OutputOptions
from lslam.studies.results_csv import read_state
from lslam.studies.runner import StudyProgress
from lslam.studies.subjects import Subject
from lslam.studies.variants import find_variants
from lslam.studies.worker import WorkerContext

pytestmark = pytest.mark.usefixtures("forked_runs")
SCANS = 14
METHODS = ("icp", "kiss-icp")


@pytest.fixture(scope="module")
def subjects(tmp_path_factory: pytest.TempPathFactory) -> tuple[Subject, ...]:
    """`good`, the same recording without ground truth as `silent`, and `broken`, whose scans are all torn."""
    folder = tmp_path_factory.mktemp("recordings")
    good = record(simulate("block", count=SCANS, lidar="sample"), folder / "good").sequence
    silent, broken = folder / "silent", folder / "broken"
    for copy in (silent, broken):
        shutil.copytree(good, copy)
    toml = silent / "sequence.toml"
    toml.write_text("".join(line for line in toml.read_text().splitlines(True) if "ground_truth" not in line))
    for scan in (broken / "velodyne").iterdir():
        scan.write_bytes(b"torn")
    return tuple(Subject(path.name if path != good else "good", path) for path in (good, silent, broken))


@pytest.fixture(scope="module")
def plan(subjects: tuple[Subject, ...], tmp_path_factory: pytest.TempPathFactory) -> Plan:
    out = tmp_path_factory.mktemp("comparison") / "out"
    output = OutputOptions(out, command="lslam compare good silent broken")
    return Plan(subjects, tuple(find_variants(METHODS)), (0,), output)


@pytest.fixture(scope="module")
def made(plan: Plan) -> Comparison:
    return run_comparison(plan)


def one(comparison: Comparison, sequence: str, method: str) -> RunScore:
    (run,) = [r for r in comparison.runs if (r.sequence, r.method) == (sequence, method)]
    return run


def test_every_cell_is_a_run_folder_with_the_numbers_of_its_own_files(made: Comparison, plan: Plan) -> None:
    for method in METHODS:
        run = one(made, "good", method)
        assert run.folder == plan.output.out / "runs" / "good" / f"{method}-s0"
        sequence = open_sequence(plan.subjects[0].path or "")
        assert sequence.ground_truth is not None
        score = evaluate(read_trajectory(run.folder), sequence.ground_truth, calibration=sequence.calibration)
        for name, error in score.ate.items():
            assert error.translation is not None
            assert run.values[f"ate.{name}"] == pytest.approx(error.translation.rmse, rel=1e-5)
        with (run.folder / "timing.csv").open() as stream:
            rows = list(csv.DictReader(stream))
        totals = [1e3 * float(row["total"]) for row in rows]
        assert len(totals) == SCANS
        assert run.values["time.total"] == pytest.approx(np.median(totals))
        assert run.values["time.mean"] == pytest.approx(np.mean(totals), rel=1e-3)
        assert run.values["factor"] == pytest.approx(100.0 * SCANS / sum(totals), rel=1e-6)
        assert sum(run.stages.values()) * 1e3 == pytest.approx(np.mean(totals), rel=1e-3)
        assert run.values["bridged"] == run.values["skipped"] == 0


def test_without_ground_truth_there_are_times_maps_and_the_distance_between_methods(made: Comparison) -> None:
    run = one(made, "silent", "kiss-icp")
    assert run.note == "no ground truth"
    assert run.is_usable
    assert not [key for key in run.values if key.startswith(("ate", "rpe", "drift"))]
    assert run.values["time.total"] > 0
    (difference,) = made.differences
    assert (difference.sequence, difference.method, difference.reference) == ("silent", "kiss-icp", "icp")
    a, b = (read_trajectory(one(made, "silent", m).folder).positions for m in ("icp", "kiss-icp"))
    assert difference.origin == pytest.approx(np.sqrt(np.mean(np.sum((a - b) ** 2, axis=1))), abs=1e-3)
    assert 0 < difference.se3 <= difference.origin + 1e-9


def test_what_fails_is_a_row_with_its_reason_and_no_pair(made: Comparison) -> None:
    assert [(r.sequence, r.method, r.status) for r in made.failed] == [
        ("broken", "icp", "failed"), ("broken", "kiss-icp", "failed"),
    ]  # fmt: skip
    assert all("none of 14 scans can be used" in r.reason and not r.values for r in made.failed)
    assert made.pairs[0].n == 1


def test_files_are_there_and_agree(made: Comparison, plan: Plan) -> None:
    document: dict[str, Any] = json.loads((plan.output.out / "compare.json").read_text())
    assert (document["schema"], document["status"]) == ("lslam-compare", "done")
    assert [r["values"].get("ate.se3") for r in document["runs"]] == [r.values.get("ate.se3") for r in made.runs]
    with (plan.output.out / "compare.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 6
    assert float(rows[0]["ate.se3 (m)"]) == pytest.approx(made.runs[0].values["ate.se3"])
    assert rows[2]["ate.se3 (m)"] == ""
    assert "silent & kiss-icp & no ground truth" in (plan.output.out / "compare.tex").read_text()
    page = (plan.output.out / "compare.html").read_text()
    assert page.count("data:image/png") >= 4
    assert "runs/good/icp-s0/report.html" in page


def test_resume_runs_only_what_is_missing_or_changed(made: Comparison, plan: Plan, tmp_path: Path) -> None:
    out = tmp_path / "copy"
    shutil.copytree(plan.output.out, out)
    with pytest.raises(OutputExistsError, match="--resume"):
        run_comparison(replace(plan, output=OutputOptions(out)))
    two = replace(plan, output=OutputOptions(out, resume=True), subjects=plan.subjects[:2])
    (out / "runs" / "good" / "icp-s0.json").unlink()
    seen: list[str] = []
    again = run_comparison(two, StudyProgress(on_step=seen.append))
    assert seen == ["good icp seed 0"]
    assert [r.is_reused for r in again.runs] == [False, True, True, True]
    assert one(again, "good", "icp").values["ate.se3"] == one(made, "good", "icp").values["ate.se3"]
    output = OutputOptions(out, overwrite=True)
    anew = replace(two, variants=plan.variants[:1], subjects=plan.subjects[:1], output=output)
    assert not run_comparison(anew).runs[0].is_reused


def test_resume_goes_on_with_a_run_that_was_begun(made: Comparison, plan: Plan, tmp_path: Path) -> None:
    out, path = tmp_path / "copy", plan.subjects[0].path
    shutil.copytree(plan.output.out, out)
    folder = out / "runs" / "good" / "icp-s0"
    shutil.rmtree(folder)
    (out / "runs" / "good" / "icp-s0.json").unlink()
    assert path is not None
    done: list[None] = []
    stop_at_7 = Watch(on_step=lambda: done.append(None), should_stop=lambda: len(done) >= 7)
    with pytest.raises(InterruptedRunError):
        lslam.run(open_sequence(path), plan.variants[0].config, out=folder, watch=stop_at_7)
    one_subject = replace(plan, subjects=plan.subjects[:1])
    again = one(run_comparison(replace(one_subject, output=OutputOptions(out, resume=True))), "good", "icp")
    # The first twenty scans of a run are decided together, and this one has fourteen.
    assert json.loads((folder / "manifest.json").read_text())["resumed_after_scans"] == [14]
    assert again.values["ate.se3"] == one(made, "good", "icp").values["ate.se3"]
    assert "run_s" in one(made, "good", "icp").values
    assert "run_s" not in again.values, "the seconds of its second half are not those of a run"
    run_comparison(replace(one_subject, output=OutputOptions(out, overwrite=True)))
    assert "resumed_after_scans" not in json.loads((folder / "manifest.json").read_text())


def test_with_and_without_the_imu_are_runs_and_pairs_of_their_own(
    subjects: tuple[Subject, ...], tmp_path: Path
) -> None:
    variants = tuple(find_variants(("icp",), None, ["map.write=false", "report.html=false"], imu="both"))
    with pytest.raises(InputError, match=r"silent has no IMU.*imu\.csv.*run without --imu"):
        run_comparison(Plan(subjects[1:2], variants, (0,), OutputOptions(tmp_path / "none")))
    assert not (tmp_path / "none").exists()
    folder = record(simulate("block", count=30, lidar="sample", imu="icm20948"), tmp_path / "good").sequence
    plan = Plan((Subject("good", folder),), variants, (0,), OutputOptions(tmp_path / "out"))
    made = run_comparison(plan)
    assert [(r.method, r.status, r.values.get("imu_used")) for r in made.runs] == [
        ("icp", "done", None), ("icp+imu", "done", 1.0),
    ]  # fmt: skip
    assert [(p.method, p.reference, p.n) for p in made.pairs] == [("icp+imu", "icp", 1)]
    measured = (folder / "imu.csv").read_text().splitlines()
    still = [line.split(",")[0] + ",0" * 6 for line in measured[1:]]
    (folder / "imu.csv").write_text("\n".join([measured[0], *still]) + "\n")
    again = run_comparison(replace(plan, output=OutputOptions(tmp_path / "out", resume=True)))
    assert one(again, "good", "icp+imu").values["imu_used"] == 0.0
    assert [note for note in again.notes if "refused: good icp+imu;" in note]


def test_a_folder_that_is_something_else_is_left_alone(plan: Plan, tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years")
    with pytest.raises(OutputExistsError, match="not a comparison"):
        run_comparison(replace(plan, output=OutputOptions(tmp_path, overwrite=True)))
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]
    with pytest.raises(UsageError, match="give one of them"):
        run_comparison(replace(plan, output=OutputOptions(tmp_path, overwrite=True, resume=True)))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"seeds": (0, 0)}, "--seeds"),
        ({"seeds": ()}, "--seeds"),
        ({"jobs": 0}, "--jobs 0"),
        ({"crop": (0.0, 0.0, -1.0)}, "--crop"),
        (
            {"crop": (0.0, 0.0, 9.0), "variants": tuple(find_variants(METHODS, None, ["map.write=false"]))},
            "map.write is off",
        ),
        ({"variants": ()}, "no method"),
    ],
)
def test_what_cannot_be_compared_is_said_before_anything_runs(
    plan: Plan, change: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(UsageError, match=sentence):
        check_plan(replace(plan, **change))


def die(job: Job, context: WorkerContext) -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


def test_a_process_that_dies_is_a_crashed_job_that_is_tried_again(plan: Plan, tmp_path: Path) -> None:
    path = plan.subjects[0].path
    assert path is not None
    job = Job("good", "icp", 0, path, plan.variants[0].config, tmp_path / "runs" / "icp-s0", "digest", "")
    Local(1, is_persistent=False, tries=1).run([job], StudyProgress(), work=die)
    state = read_state(job.state_file)
    assert state is not None
    assert state.status == "crashed"
    assert state.reason.startswith("the process was killed by SIGSEGV")
    assert folders_of_finished([job]) == set()


@pytest.mark.parametrize(("sideways", "alignment"), [(0.02, "origin"), (20.0, "se3")])
def test_maps_beside_a_nearly_straight_path_are_not_turned_about_it(
    sideways: float, alignment: str, tmp_path: Path
) -> None:
    """A roll of 20 deg about the path fits noisy positions as well as none, and moves a wall 30 m beside it by metres."""
    rng, along = np.random.default_rng(0), np.linspace(0.0, 1.0, 60)
    poses = np.tile(np.eye(4), (60, 1, 1))
    poses[:, :3, 3] = np.stack([60 * along, sideways * np.sin(6 * along), 0 * along], 1)
    truth = Trajectory(np.arange(60) * 10**8, poses)
    noisy = poses.copy()
    noisy[1:, :3, 3] += rng.normal(0, 0.05, (59, 3))
    job = SimpleNamespace(method="icp", folder=tmp_path)
    finished_run: Any = SimpleNamespace(trajectory=Trajectory(truth.stamps_ns, noisy), job=job)
    recording: Any = SimpleNamespace(calibration=None)
    drawn = _in_world_of_truth("drive", 0, [finished_run], recording, truth)
    assert alignment in drawn.recipe
    wall = np.array([30.0, 30.0, 0.0])
    assert np.linalg.norm(se3.apply(drawn.runs[0].T_drawing_world, wall[None])[0] - wall) < 0.5


def test_without_ground_truth_every_run_is_as_far_from_the_first_as_it_is_from_the_same_start(tmp_path: Path) -> None:
    """The second turns by a degree, and lacks scans at the start, which both must share to be compared."""
    along = np.linspace(0.0, 60.0, 61)
    first = np.tile(np.eye(4), (61, 1, 1))
    first[:, 0, 3] = along
    turned = se3.make(so3.exp(np.array([0.0, 0.0, np.deg2rad(1.0)])), np.array([3.0, 2.0, 0.0])) @ first
    bent = turned.copy()
    bent[31:, 1, 3] += 0.5
    stamps = np.arange(61) * 10**8

    def run(method: str, poses: np.ndarray[Any, Any], some: slice) -> Any:
        job = SimpleNamespace(method=method, folder=tmp_path)
        return SimpleNamespace(trajectory=Trajectory(stamps[some], poses[some]), job=job)

    shown = _in_own_world("drive", 0, [run("icp", first, slice(None)), run("gicp", bent, slice(5, None))])
    assert shown.reference == "icp"
    assert shown.gt_positions is None
    reference, other = shown.runs
    assert reference.errors is None
    assert other.distance is not None
    assert other.errors is not None
    np.testing.assert_allclose(other.distance, along[5:] - along[5], atol=1e-6)
    np.testing.assert_allclose(other.errors[:26], 0.0, atol=1e-6)
    np.testing.assert_allclose(other.errors[26:], 0.5, atol=1e-6)
    apart = run("late", first, slice(None))
    apart = SimpleNamespace(trajectory=Trajectory(stamps + 10**12, first), job=apart.job)
    assert _in_own_world("drive", 0, [run("icp", first, slice(None)), apart]).runs[1].errors is None
