"""Del Tufo's comparison on a folder laid out as KITTI's, written from a simulated drive: what is missing is said, and it runs."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli.calling import lslam

from lslam.core.errors import InputError, UsageError
from lslam.core.geometry import geodesy, se3, so3
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.io.readers.kitti_raw import start_on_earth
from lslam.studies.compare import Plan, run_comparison
from lslam.studies.grid import Cell
from lslam.studies.options import OutputOptions
from lslam.studies.ready_comparison import _start_of, _world_of, find_comparison
from lslam.studies.subjects import find_subjects

SAMPLE = Path(__file__).parents[2] / "sample_data" / "sequences" / "00"
DRIVE = Path("raw", "2011_09_30", "2011_09_30_drive_0027_sync")
LEVER = np.array([-0.81, 0.32, -0.8])


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    """The sample as sequence 07, its raw drive with OXTS of the truth, and its buildings."""
    root, sequence = tmp_path / "kitti", tmp_path / "kitti" / "sequences" / "07"
    shutil.copytree(SAMPLE, sequence, ignore=shutil.ignore_patterns("truth", "*.osm", "imu.csv", "gnss.csv"))
    text = (SAMPLE / "sequence.toml").read_text().replace("poses/00", "poses/07")
    (sequence / "sequence.toml").write_text(text.replace('imu = "imu.csv"\ngnss = "gnss.csv"\n', ""))
    (root / "poses").mkdir()
    shutil.copy(SAMPLE.parents[1] / "poses" / "00.txt", root / "poses" / "07.txt")
    shutil.copy(SAMPLE / "map.osm", root / "town.osm")
    (root / DRIVE / "oxts" / "data").mkdir(parents=True)
    (root / DRIVE.parent / "calib_imu_to_velo.txt").write_text(
        f"R: 1 0 0 0 1 0 0 0 1\nT: {' '.join(map(str, LEVER))}\n"
    )
    truth = read_trajectory(SAMPLE / "truth" / "trajectory.tum")
    T_enu_world, origin = _world_of(Cell("", SAMPLE, 0, ""))
    T_enu_imu = T_enu_world @ truth.poses @ se3.make(np.eye(3), LEVER)
    rows = np.zeros((len(truth), 30))
    rows[:, :3], rows[:, 3:6] = geodesy.from_local(T_enu_imu[:, :3, 3], origin), so3.euler_rpy(T_enu_imu[:, :3, :3])
    for k, row in enumerate(rows):
        (root / DRIVE / "oxts" / "data" / f"{k:010d}.txt").write_text(" ".join(map(repr, row.tolist())))
    lines = "".join(f"2011-09-30 12:00:{k / 10:012.9f}\n" for k in range(len(truth)))
    (root / DRIVE / "oxts" / "timestamps.txt").write_text(lines)
    return root


def test_place_and_heading_at_the_start_are_those_of_the_first_scan(kitti: Path) -> None:
    place, heading = start_on_earth(kitti / "sequences" / "07", kitti)
    true_place, true_heading = _start_of(Cell("", SAMPLE, 0, ""))
    away = geodesy.to_local(place[None], true_place)[0]
    assert np.linalg.norm(away) < 0.01
    assert abs(heading - true_heading) < 1e-3


@pytest.mark.parametrize(
    ("removed", "sentence"),
    [
        ("sequences/07/velodyne", "no scans: "),
        (str(DRIVE), "no place and heading at the start: no OXTS: looked for the raw drive raw/2011_09_30/"),
        (str(DRIVE / "oxts" / "timestamps.txt"), "no place and heading at the start: .*timestamps"),
        (str(DRIVE.parent / "calib_imu_to_velo.txt"), "no place and heading at the start: .*calib_imu_to_velo"),
        ("town.osm", "no map: one \\*.osm is wanted in .*, not 0; `lslam osm fetch --along 07"),
    ],
)
def test_what_is_missing_is_said(kitti: Path, removed: str, sentence: str) -> None:
    path = kitti / removed
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    with pytest.raises(InputError, match=f"^{sentence}") as raised:
        find_comparison("del-tufo").on_recording(kitti)
    assert str(raised.value).count("\n") == 0


def test_an_empty_folder_lacks_all_of_it_and_nothing_is_begun(tmp_path: Path) -> None:
    done = lslam("compare", "del-tufo", "--data-root", tmp_path, cwd=tmp_path)
    assert done.returncode == 3
    for sentence in ("no scans: ", "no place and heading at the start: ", "no map: "):
        assert done.stderr.count(sentence) == 1
    assert not list(tmp_path.iterdir())
    with pytest.raises(UsageError, match="not public"):
        find_comparison("girolimetto").on_recording(tmp_path)


@pytest.mark.usefixtures("forked_runs")
def test_it_runs_on_the_recording_beside_the_numbers_of_the_thesis(kitti: Path, tmp_path: Path) -> None:
    ready = find_comparison("del-tufo").on_recording(kitti)
    few = ready.model_copy(update={"systems": {name: ready.systems[name] for name in ("prior", "thesis-improved")}})
    variants = few.variants(["input.count=20"])
    plan = Plan(
        tuple(find_subjects(few.sequences, kitti)),
        tuple(variants),
        (100,),
        OutputOptions(tmp_path / "out", data_root=kitti),
        ready=few,
    )
    found = run_comparison(plan)
    values = {run.method: run.values for run in found.runs}
    assert set(values) == {"hdl", "prior@osm", "thesis-improved@osm"}
    assert values["prior@osm"]["planar_ate"] < 0.3
    numbers = {(row[1], row[2]): row[3] for row in found.beside[0].rows}
    assert numbers["thesis-improved@osm", "planar ATE, m"] == "1.223"  # table 4.2
    assert not any(variant.config.debug.drift for variant in variants)
    cell = Cell("", kitti / "sequences" / "07", None, "", data_root=kitti)
    extracts = {Path(v.config.osm.extract).name for v in plan.variants_on(cell) if v.method != "hdl"}
    assert extracts == {"town.osm"}
    assert all(run.is_reused for run in run_comparison(replace(plan, output=replace(plan.output, resume=True))).runs)
