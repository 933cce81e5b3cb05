"""`lslam eval` as a user calls it: exit code, stdout, stderr."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calling import Done, lslam

from lslam.core.geometry import se3
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats.trajectory_csv import write_euroc
from lslam.io.formats.trajectory_lines import write_kitti, write_tum


def evaluated(*words: object) -> Done:
    return lslam("eval", *words)


def wander(noise: float, seed: int = 0) -> Trajectory:
    k = np.arange(200)
    zero = np.zeros(200)
    twist = np.stack(
        [1 + 0.5 * np.sin(0.1 * k), zero, zero, zero, 0.002 * np.sin(0.3 * k), 0.03 * np.sin(0.02 * k)], axis=1
    )
    twist += noise * np.random.default_rng(seed).normal(size=twist.shape) * [1, 1, 1, 0.1, 0.1, 0.1]
    poses = [np.eye(4)]
    for motion in se3.exp(twist[:-1]):
        poses.append(poses[-1] @ motion)
    return Trajectory(1_317_042_272_349_659_964 + k.astype(np.int64) * 10**8, np.array(poses))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Truth, two estimates, a run folder, and trajectories that do not fit."""
    root = tmp_path_factory.mktemp("eval")
    truth = wander(0)
    write_tum(root / "gt.tum", truth)
    write_tum(root / "good.tum", wander(0.002))
    write_euroc(root / "bad.csv", wander(0.05))
    identity = replace(truth, poses=np.tile(np.eye(4), (200, 1, 1)))
    write_tum(root / "identity.tum", identity)
    write_tum(root / "late.tum", replace(wander(0.002), stamps_ns=truth.stamps_ns + 10**12))
    write_tum(root / "two.tum", truth.select(slice(0, 2)))
    line = truth.poses.copy()
    line[:, :3, :3] = np.eye(3)
    line[:, :3, 3] = np.outer(np.arange(200), [1, 0, 0])
    write_tum(root / "line.tum", replace(truth, poses=line))
    run = root / "run"
    run.mkdir()
    write_tum(run / "trajectory.tum", wander(0.002))
    rows = "".join(f"{i},{s},0.01,0.02,0.03\n" for i, s in enumerate(truth.stamps_ns.tolist()))
    (run / "timing.csv").write_text("index,stamp_ns,read,register,total\n" + rows)
    return root


def test_table(folder: Path) -> None:
    done = evaluated(folder / "good.tum", folder / "gt.tum")
    assert done.returncode == 0, done.stderr
    for word in ("ATE se3 rmse", "ATE origin rmse", "RPE 10 m, all pairs", "KITTI drift", "how:"):
        assert word in done.stdout
    assert "thesis" not in done.stdout
    assert done.stderr == ""


def test_metrics_of_the_theses_are_asked_for(folder: Path) -> None:
    done = evaluated(folder / "good.tum", folder / "gt.tum", "--metrics", "thesis")
    assert "thesis1 thesis_rmse" in done.stdout
    assert "thesis2 planar ATE" in done.stdout
    wrong = evaluated(folder / "good.tum", folder / "gt.tum", "--metrics", "theses")
    assert wrong.returncode == 2
    assert "no metrics 'theses'; did you mean 'thesis'" in wrong.stderr


def test_json_is_one_object_and_the_numbers_are_right(folder: Path) -> None:
    done = evaluated(
        folder / "good.tum", folder / "gt.tum", "--json", "--align", "none,origin,se3,sim3,posyaw", "--delta", "2s"
    )
    document = json.loads(done.stdout)
    assert document["version"] == 1
    assert list(document["ate"]) == ["none", "origin", "se3", "sim3", "posyaw"]
    own, truth = wander(0.002).positions, wander(0).positions
    expected = np.sqrt(np.mean(np.sum((own - truth) ** 2, axis=1)))
    assert document["ate"]["none"]["rmse"] == pytest.approx(expected, abs=1e-7)
    assert [r["unit"] for r in document["rpe"]] == ["s"]
    assert document["association"]["matched"] == 200


def test_several_estimates_and_a_run_folder_with_its_timing(folder: Path) -> None:
    done = evaluated(folder / "run", folder / "bad.csv", folder / "gt.tum", "--json")
    first, second = json.loads(done.stdout)["evaluations"]
    assert first["timing"]["total"]["median"] == pytest.approx(0.03)
    assert second["timing"] is None
    assert second["ate"]["se3"]["rmse"] > 5 * first["ate"]["se3"]["rmse"]
    table = evaluated(folder / "run", folder / "bad.csv", folder / "gt.tum", "--table", "md")
    assert table.stdout.startswith("| metric | unit | run | bad.csv |")


@pytest.mark.parametrize(
    ("gate", "estimate", "code"),
    [
        (("--fail-ate", "1.0"), "good.tum", 0),
        (("--fail-ate", "0.001"), "good.tum", 4),
        (("--fail-rpe", "0.1"), "good.tum", 0),
        (("--fail-rpe", "0.01"), "bad.csv", 4),
        (("--fail-drift", "1"), "good.tum", 0),
        (("--fail-ate", "1.0"), "identity.tum", 4),
        (("--fail-rpe", "0.5"), "identity.tum", 4),
        (("--fail-drift", "50"), "identity.tum", 4),
    ],
)
def test_gates(gate: tuple[str, str], estimate: str, code: int, folder: Path) -> None:
    done = evaluated(folder / estimate, folder / "gt.tum", *gate)
    assert done.returncode == code, done.stderr
    assert "RPE" in done.stdout
    if code:
        assert f"{gate[0]} allows {float(gate[1]):g}" in done.stderr
        assert done.stderr.count("\n") == 1


def test_a_gate_without_a_value_fails(folder: Path, tmp_path: Path) -> None:
    write_tum(tmp_path / "short.tum", wander(0).select(slice(0, 50)))
    done = evaluated(tmp_path / "short.tum", tmp_path / "short.tum", "--fail-drift", "1")
    assert done.returncode == 4
    assert "KITTI drift" in done.stderr
    assert "n/a" in done.stderr


def test_clocks(folder: Path) -> None:
    done = evaluated(folder / "late.tum", folder / "gt.tum")
    assert done.returncode == 3
    assert "1317043272.350 .. 1317043292.250 s" in done.stderr
    assert "1317042272.350 .. 1317042292.250 s" in done.stderr
    assert "--time-offset auto" in done.stderr
    assert done.stdout == ""
    for offset in ("auto", "-1000"):
        again = evaluated(folder / "late.tum", folder / "gt.tum", "--time-offset", offset, "--json")
        assert json.loads(again.stdout)["association"]["time_offset_s"] == -1000


def test_a_straight_line(folder: Path) -> None:
    done = evaluated(folder / "line.tum", folder / "line.tum")
    assert done.returncode == 0
    assert "n/a (collinear)" in done.stdout
    asked = evaluated(folder / "line.tum", folder / "line.tum", "--align", "se3")
    assert asked.returncode == 3
    assert "n/a (collinear)" in asked.stderr
    assert asked.stdout == ""


@pytest.mark.parametrize(
    ("arguments", "code", "sentence"),
    [
        (("nothing.tum", "gt.tum"), 3, "does not exist"),
        (
            ("two.tum", "gt.tum"),
            3,
            "has 2 poses, 3 are needed (estimate: 1317042272.350 .. 1317042272.450 s; ground truth",
        ),
        (("good.tum", "gt.tum", "--align", "se33"), 2, "did you mean 'se3'"),
        (("good.tum", "gt.tum", "--delta", "10q"), 2, "RPE distance '10q'"),
        (("good.tum", "gt.tum", "--plot", "x.bmp"), 2, "ends with .png, .svg or .pdf"),
        (("good.tum", "gt.tum", "--T-est-gt", "1,2,3"), 2, "3 numbers"),
        (("good.tum", "gt.tum", "--time-offset", "soon"), 2, "seconds, or auto"),
        (("good.tum", "gt.tum", "--max-diff", "-1"), 2, "max_diff"),
        (("good.tum", "gt.tum", "--calib", "none.txt"), 3, "none.txt does not exist"),
        (("good.tum", "gt.tum", "--frame", "base_link"), 3, "nothing says where frame base_link sits (known: lidar)"),
        (("good.tum", "gt.tum", "--format", "kitti"), 3, "8 columns where KITTI poses has 12"),
        (("good.tum", "gt.tum", "--timing", "none.csv"), 3, "none.csv"),
        (("good.tum", "gt.tum", "--set", "eval.aling=se3"), 2, "did you mean 'align'"),
        (("good.tum",), 2, "Missing argument"),
    ],
)
def test_what_is_wrong_is_one_sentence(arguments: tuple[str, ...], code: int, sentence: str, folder: Path) -> None:
    paths = [folder / a if a.endswith((".tum", ".csv")) and i < 2 else a for i, a in enumerate(arguments)]
    done = evaluated(*paths)
    assert done.returncode == code, done.stderr
    assert sentence in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == ""


def test_kitti_layout_finds_times_and_calibration(folder: Path, tmp_path: Path) -> None:
    """A LiDAR run against `poses/07.txt`: stamps and `Tr` lie where KITTI puts them."""
    T = se3.make(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.array([0.0, -0.07, -0.33]))
    truth = wander(0)
    (tmp_path / "sequences/07").mkdir(parents=True)
    (tmp_path / "poses").mkdir()
    write_kitti(tmp_path / "poses/07.txt", replace(truth, poses=T @ truth.poses @ se3.inverse(T)))
    numbers = " ".join(f"{v:.9f}" for v in T[:3].ravel())
    (tmp_path / "sequences/07/calib.txt").write_text(f"Tr: {numbers}\n")
    (tmp_path / "sequences/07/times.txt").write_text("".join(f"{0.1 * k:.6f}\n" for k in range(200)))
    own = wander(0.002).select(slice(10, 150))
    write_tum(tmp_path / "own.tum", replace(own, stamps_ns=np.arange(10, 150, dtype=np.int64) * 10**8))
    done = evaluated(tmp_path / "own.tum", tmp_path / "poses/07.txt", "--json")
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document["association"]["matched"] == 140
    assert document["ate"]["origin"]["rmse"] < 0.5
    assert any("converted to the LiDAR" in note for note in document["notes"])
    (tmp_path / "sequences/07/calib.txt").unlink()
    loud = evaluated(tmp_path / "own.tum", tmp_path / "poses/07.txt", "--json", "-q")
    assert "WRONG FRAMES" in loud.stderr
    assert any("WRONG FRAMES" in note for note in json.loads(loud.stdout)["notes"])


def test_poses_of_another_frame_of_the_robot(folder: Path, tmp_path: Path) -> None:
    """Its place is stated in a file that is named, or lies beside the truth."""
    write_tum(tmp_path / "gt.tum", wander(0))
    toml = tmp_path / "sequence.toml"
    toml.write_text("[frames]\nbase_link = [1, 0, 0, -30, 0, 1, 0, 5, 0, 0, 1, -1.7]\n")
    words = ("--frame", "base_link", "--json")
    named = evaluated(folder / "good.tum", folder / "gt.tum", *words, "--calib", toml)
    beside = evaluated(folder / "good.tum", tmp_path / "gt.tum", *words)
    base, same, lidar = (
        json.loads(done.stdout) for done in (named, beside, evaluated(folder / "good.tum", folder / "gt.tum", "--json"))
    )
    assert "poses of base_link, 30.461 m from the sensor" in base["notes"]
    assert base["ate"] == same["ate"] != lidar["ate"]


def test_plot(folder: Path, tmp_path: Path) -> None:
    done = evaluated(folder / "good.tum", folder / "bad.csv", folder / "gt.tum", "--plot", tmp_path / "p.png")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")


def test_help_has_an_example_and_is_light() -> None:
    done = evaluated("--help")
    assert "lslam eval runs/seq07-icp poses/07.txt" in done.stdout
    code = "import sys, lslam.cli.eval; print([m for m in ('numpy', 'matplotlib', 'scipy', 'pydantic') if m in sys.modules])"
    light = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert light.stdout.strip() == "[]"


def test_published_estimates(recordings: Callable[[str], Path]) -> None:
    root = recordings("kitti_poses") / "kitti_poses"
    names = [root / f"estimates/{name}_00.txt" for name in ("simple_offline", "orb_slam")]
    done = evaluated(*names, root / "ground_truth/00.txt", "--json")
    simple, orb = json.loads(done.stdout)["evaluations"]
    assert simple["kitti_drift"]["translation_percent"] == pytest.approx(0.5114, abs=1e-4)
    assert orb["ate"]["se3"]["rmse"] == pytest.approx(1.3034, abs=1e-4)
    assert "by index" in simple["association"]["recipe"]
