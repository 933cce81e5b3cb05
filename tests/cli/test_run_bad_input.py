"""`lslam run` on what users really have: one clear sentence, the documented exit code, nothing half-written."""

from __future__ import annotations

import contextlib
import html
import json
import os
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from calling import SAMPLE, Done, assert_one_sentence, lslam, manifest, sample_copy, strict_json
from point_writers import write_points

from lslam.core.geometry import se3, so3
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats.trajectory_lines import write_tum
from lslam.io.readers import open_sequence


@pytest.fixture
def sequence(tmp_path: Path) -> Path:
    return sample_copy(tmp_path / "data", 12)


def run(sequence: object, tmp_path: Path, *words: object) -> tuple[Done, Path]:
    return lslam("run", sequence, "--out", tmp_path / "out", *words), tmp_path / "out"


def refuse(sequence: object, tmp_path: Path, code: int, sentence: str, *words: object) -> None:
    """Exit `code`, one sentence, nothing on stdout, no folder."""
    done, out = run(sequence, tmp_path, *words)
    assert (done.returncode, done.stdout) == (code, ""), done.stderr
    assert_one_sentence(done.stderr)
    assert sentence in done.stderr
    assert not out.exists()


def test_no_sequence_there(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters" / "a.txt").write_text("dear")
    refuse(tmp_path / "none", tmp_path, 3, "does not exist")
    refuse(tmp_path / "empty", tmp_path, 3, "is empty")
    refuse(tmp_path / "letters", tmp_path, 3, "holds no scans")
    refuse(tmp_path / "letters" / "a.txt", tmp_path, 3, "is a file")


def test_wrong_words(sequence: Path, tmp_path: Path) -> None:
    refuse(sequence, tmp_path, 2, "did you mean 'kiss-icp'", "--method", "kissicp")
    refuse(sequence, tmp_path, 2, "did you mean 'voxel'", "--set", "map.voxle=1")
    refuse(sequence, tmp_path, 2, "beyond the last scan", "--start", "12")
    refuse(sequence, tmp_path, 2, "input.threads = -1", "--threads", "-1")
    refuse(sequence, tmp_path, 3, "none.toml cannot be read", "--config", tmp_path / "none.toml")
    refuse(sequence, tmp_path, 3, "gt.tum does not exist", "--gt", tmp_path / "gt.tum")


def truncate(folder: Path, number: int = 5) -> None:
    scan = folder / "velodyne" / f"{number:06d}.bin"
    scan.write_bytes(scan.read_bytes()[:-5])


def test_a_truncated_scan_is_skipped_bridged_and_counted(sequence: Path, tmp_path: Path) -> None:
    truncate(sequence)
    done, out = run(sequence, tmp_path)
    assert done.returncode == 0
    assert "Traceback" not in done.stderr
    assert "000005.bin" in done.stderr
    assert "status       degraded" in done.stdout
    assert "11 of 12 registered, 1 skipped" in done.stdout
    facts = manifest(out)
    assert (facts["status"], facts["counts"]["skipped"]) == ("degraded", 1)
    assert "000005.bin" in facts["problems"][0]
    assert "000005.bin" in (out / "report.html").read_text()


def test_strict_makes_it_exit_4_with_everything_written(sequence: Path, tmp_path: Path) -> None:
    truncate(sequence)
    done, out = run(sequence, tmp_path, "--strict")
    assert done.returncode == 4
    assert_one_sentence(done.stderr)
    assert "status       degraded" in done.stdout
    assert (out / "map.ply").exists()


def empty_all(folder: Path) -> None:
    for scan in (folder / "velodyne").iterdir():
        scan.write_bytes(b"")


def cut_all(folder: Path) -> None:
    for scan in (folder / "velodyne").iterdir():
        scan.write_bytes(b"abc")


def unrelated_places(folder: Path) -> None:
    rng = np.random.default_rng(0)
    for k in range(12):
        if k > 2:
            centre = rng.uniform(-20, 20, 3)
            write_points(folder / "velodyne" / f"{k:06d}.bin", centre + rng.normal(0, 9, (4000, 3)), np.zeros(4000))


@pytest.mark.parametrize(("spoil", "words"), [(empty_all, "no points"), (cut_all, "no multiple of 16")])
def test_no_scan_that_can_be_used_is_exit_3_without_a_result(
    sequence: Path, tmp_path: Path, spoil: Callable[[Path], None], words: str
) -> None:
    spoil(sequence)
    done, out = run(sequence, tmp_path)
    assert (done.returncode, done.stdout) == (3, "")
    assert_one_sentence(done.stderr)
    assert words in done.stderr.splitlines()[-1]
    assert manifest(out)["status"] == "failed"
    assert not {"trajectory.tum", "map.ply", "report.html"} & {p.name for p in out.iterdir()}


def test_scans_of_unrelated_places_are_exit_1_with_a_summary(sequence: Path, tmp_path: Path) -> None:
    unrelated_places(sequence)
    done, out = run(sequence, tmp_path)
    assert done.returncode == 1
    assert_one_sentence(done.stderr)
    assert "the first is scan 3" in done.stderr.splitlines()[-1]
    assert "status       diverged" in done.stdout
    assert manifest(out)["status"] == "diverged"
    assert {"trajectory.tum", "report.html", "log.txt"} <= {p.name for p in out.iterdir()}


@pytest.mark.parametrize("method", ["icp", "ndt", "icp-svd", "kiss-icp", "small-gicp"])
def test_points_farther_than_any_lidar_sees_are_no_result_of_any_method(
    method: str, sequence: Path, tmp_path: Path
) -> None:
    if method in ("kiss-icp", "small-gicp"):
        pytest.importorskip(method.replace("-", "_"))
    for path in (sequence / "velodyne").glob("*.bin"):
        scan = np.fromfile(path, np.float32).reshape(-1, 4)
        scan[:, :3] *= 1e30
        scan.tofile(path)
    done, out = run(sequence, tmp_path, "--method", method)
    assert done.returncode == 1, done.stderr
    assert "the run diverged: 12 of 12 scans were not registered" in done.stderr
    assert "points: none of" in done.stderr
    assert "is finite and within 10 km" in done.stderr
    assert manifest(out)["status"] == "diverged"


def shorten(name: str) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        file = (folder / name).resolve()
        file.write_text("".join(file.read_text().splitlines(keepends=True)[:-3]))

    return spoil


def swap_times(folder: Path) -> None:
    lines = (folder / "times.txt").read_text().splitlines()
    lines[4], lines[5] = lines[5], lines[4]
    (folder / "times.txt").write_text("\n".join(lines) + "\n")


def drop_tr(folder: Path) -> None:
    (folder / "calib.txt").write_text("P0: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    toml = folder / "sequence.toml"
    toml.write_text(toml.read_text().split("[extrinsics]")[0])


@pytest.mark.parametrize(
    ("spoil", "scans", "words"),
    [
        (shorten("times.txt"), 9, "9 times for 12 scans"),
        (shorten("../../poses/00.txt"), 12, "9 poses for 12 scans"),
        (lambda folder: (folder / "velodyne" / "000005.bin").unlink(), 11, "12 times for 11 scans"),
        (swap_times, 12, "time goes back at line 6"),
        (drop_tr, 12, "has no Tr"),
    ],
)
def test_contradictions_are_resolved_and_reported(
    sequence: Path, tmp_path: Path, spoil: Callable[[Path], None], scans: int, words: str
) -> None:
    spoil(sequence)
    done, out = run(sequence, tmp_path)
    assert done.returncode == 0, done.stderr
    assert words in done.stderr
    assert words in done.stdout, "the summary says it too"
    facts = manifest(out)
    assert any(words in problem for problem in facts["problems"])
    assert (facts["status"], facts["counts"]["ok"]) == ("degraded", scans)
    done, _ = run(sequence, tmp_path, "--overwrite", "--strict")
    assert done.returncode == 4, "--strict turns every degradation into a failed gate"
    assert words in done.stderr.splitlines()[-1]
    if spoil is drop_tr:
        assert facts["frames"]["trajectory_kitti.txt"].startswith("LiDAR")
        assert "errors       not stated" in done.stdout


def test_truth_in_the_wrong_frame_is_detected(sequence: Path, tmp_path: Path) -> None:
    # KITTI's camera poses in a format that does not say so.
    rows = np.loadtxt(SAMPLE / "poses" / "00.txt")[:12].reshape(-1, 3, 4)
    poses = np.tile(np.eye(4), (12, 1, 1))
    poses[:, :3] = rows
    stamps = np.arange(12, dtype=np.int64) * 100_000_000
    write_tum(tmp_path / "wrong.tum", Trajectory(stamps, poses), comment="poses")
    done, out = run(sequence, tmp_path, "--gt", tmp_path / "wrong.tum")
    assert done.returncode == 0
    assert "WRONG FRAMES" in done.stdout
    assert manifest(out)["status"] == "degraded"
    assert "WRONG FRAMES" in manifest(out)["problems"][0]


@pytest.mark.parametrize(
    ("slower", "said"), [(1e3, "1,000 times too slow, as ms taken for s are"), (1e-6, "as ms taken for ns are")]
)
def test_stamps_in_the_wrong_unit_are_said_by_the_run_and_the_doctor(
    slower: float, said: str, sequence: Path, tmp_path: Path
) -> None:
    times = np.loadtxt(sequence / "times.txt")
    np.savetxt(sequence / "times.txt", times * slower, fmt="%.9f")
    done, out = run(sequence, tmp_path)
    assert done.returncode == 0, done.stderr
    assert said in done.stderr
    [problem] = manifest(out)["problems"]
    assert said in problem
    assert manifest(out)["status"] == "degraded"
    assert said in (out / "report.html").read_text()
    assert said in lslam("info", sequence, "--quick").stdout


@pytest.mark.parametrize(("times", "unit"), [(1e3, "mm"), (1e-3, "km"), (1 / 0.3048, "feet")])
def test_truth_in_another_unit_than_metres_is_said(times: float, unit: str, tmp_path: Path) -> None:
    sequence = sample_copy(tmp_path / "data", 60)
    rows = np.loadtxt(sequence / "../../poses/00.txt").reshape(-1, 3, 4)
    rows[:, :, 3] *= times
    np.savetxt(sequence / "../../poses/00.txt", rows.reshape(-1, 12))
    done, out = run(sequence, tmp_path, "--set", "map.write=false")
    assert done.returncode == 0, done.stderr
    [problem] = manifest(out)["problems"]
    assert problem.startswith("WRONG UNIT")
    assert f"they seem to be in {unit}" in problem


def turn_calibration(folder: Path) -> None:
    toml = folder / "sequence.toml"
    known = open_sequence(folder).calibration.T_cam0_lidar
    assert known is not None
    wrong = known @ se3.make(so3.exp(np.array([0.0, np.deg2rad(5.0), 0.0])), np.zeros(3))
    key = re.search(r"T_cam0_lidar = \[.*?\n\]", toml.read_text(), re.DOTALL)
    assert key is not None
    toml.write_text(toml.read_text().replace(key.group(0), f"T_cam0_lidar = {wrong.tolist()}"))


def drop_poses(folder: Path) -> None:
    poses = folder / "../../poses/00.txt"
    lines = poses.read_text().splitlines(keepends=True)
    poses.write_text("".join([*lines[:40], *lines[60:]]))


def move_fixes(numbers: range | tuple[int, ...]) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        header, *rows = (folder / "gnss.csv").read_text().splitlines()
        cells = [row.split(",") for row in rows]
        for k in numbers:
            cells[k][1] = repr(float(cells[k][1]) + 9e-4)
        (folder / "gnss.csv").write_text("\n".join([header, *(",".join(c) for c in cells)]) + "\n")

    return spoil


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (turn_calibration, "turned by 5.0 deg (sigma 0.6) against the estimate's"),
        (drop_poses, "ground truth: 1 jump, the largest by 25.6 m from pose 39 to the next"),
        (move_fixes((2, 5, 8)), "GNSS: odometry contradicts 3 of 10 fixes, the farthest by 100."),
        (
            move_fixes(range(5, 10)),
            "m together 5.0 s after the first, where odometry does not: the 5 of 10 from then on",
        ),
    ],
)
def test_what_odometry_contradicts_is_a_problem_of_the_run(
    spoil: Callable[[Path], None], said: str, tmp_path: Path
) -> None:
    sequence = sample_copy(tmp_path / "data", 95)
    spoil(sequence)
    done, out = run(sequence, tmp_path, "--gnss", "--imu", "--set", "map.write=false")
    assert done.returncode == 0, done.stderr
    assert "WARNING" in done.stderr
    assert said in done.stderr
    assert sum(said in problem for problem in manifest(out)["problems"]) == 1
    assert manifest(out)["status"] == "degraded"
    assert said in html.unescape((out / "report.html").read_text())


def test_truth_of_another_time_leaves_the_run_without_a_score(sequence: Path, tmp_path: Path) -> None:
    stamps = 10**15 + np.arange(12, dtype=np.int64) * 100_000_000
    write_tum(tmp_path / "late.tum", Trajectory(stamps, np.tile(np.eye(4), (12, 1, 1))), comment="poses")
    done, out = run(sequence, tmp_path, "--gt", tmp_path / "late.tum")
    assert done.returncode == 0
    assert "they share no time" in done.stdout
    assert "lslam eval" in done.stderr
    assert "ate" not in json.loads((out / "evaluation.json").read_text())
    assert "they share no time" in (out / "report.html").read_text()


def test_truth_of_the_whole_sequence_fits_a_part(sequence: Path, tmp_path: Path) -> None:
    done, out = run(sequence, tmp_path, "--gt", tmp_path / "data" / "poses" / "00.txt", "--start", 4)
    assert done.returncode == 0
    assert "8 of 8 poses" in done.stdout
    assert manifest(out)["status"] == "done"


@pytest.mark.parametrize("count", [1, 2])
def test_too_few_scans_for_a_score(sequence: Path, tmp_path: Path, count: int) -> None:
    done, out = run(sequence, tmp_path, "--count", count)
    assert done.returncode == 0
    assert f"has {count} poses, 3 are needed" in done.stdout
    assert len((out / "trajectory_kitti.txt").read_text().splitlines()) == count


@pytest.mark.parametrize("place", ["file/run", "/proc/none/run"])
def test_output_that_cannot_be_written(sequence: Path, tmp_path: Path, place: str) -> None:
    (tmp_path / "file").write_text("")
    done = lslam("run", sequence, "--out", tmp_path / place)
    assert (done.returncode, done.stdout) == (3, "")
    assert_one_sentence(done.stderr)
    assert "cannot be written" in done.stderr


def strangely_named(parent: Path) -> Path:
    """A new folder whose name is no UTF-8 or, where the file system takes no such name, no Latin-1."""
    for name in (b"caf\xe9 \xff", "cafe\u0301 \U0001f600".encode()):
        with contextlib.suppress(OSError):
            (parent / os.fsdecode(name)).mkdir()
            return parent / os.fsdecode(name)
    raise AssertionError(f"{parent} takes no folder")


def test_a_name_that_is_no_utf8(tmp_path: Path) -> None:
    folder = strangely_named(tmp_path)
    sequence = sample_copy(folder, 5)
    truncate(sequence, 3)
    done, out = run(sequence, folder, "--json")
    assert done.returncode == 0, done.stderr
    assert "000003.bin" in done.stderr
    assert "000003.bin" in (out / "log.txt").read_text()
    assert manifest(out)["sequence"]["path"] == str(sequence)
    assert strict_json(done.stdout)["manifest"]["counts"]["scans"] == 5


def test_labels_that_are_not_there(sequence: Path, tmp_path: Path) -> None:
    refuse(sequence, tmp_path, 3, "drop_labels needs labels", "--set", "preprocess.drop_labels=moving")
    refuse(sequence, tmp_path, 2, "is no class of points", "--set", "preprocess.drop_labels=tree")
