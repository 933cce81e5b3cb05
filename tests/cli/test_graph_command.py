"""`lslam graph`, and `--loops-file` and `--control` of `lslam run`, as a user calls them."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import SAMPLE, assert_one_sentence, lslam, manifest, strict_json

from lslam.core.geometry import se3, so3
from lslam.core.types.gnss import Georeference
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.io.readers import open_sequence
from lslam.maps.georeference import Projection

# 4 % and 12 deg/100 m: beyond the gates of loops and beyond what odometry may drift.
DRIFT = ("--set", "debug.drift=true", "--set", "debug.drift_percent=4", "--set", "debug.drift_deg_per_100m=12")


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`plain`, and `lost`, whose odometry drifts: no loop of it closes. Neither has a map."""
    root = tmp_path_factory.mktemp("graphs")
    for name, more in (("plain", ()), ("lost", DRIFT)):
        done = lslam("run", SAMPLE, "--out", root / name, "--set", "map.write=false", *more)
        assert done.returncode == 0, done.stderr
    return root


def again(run: Path, out: Path, *words: object) -> Any:
    done = lslam("graph", run, "--out", out, "--json", *words)
    assert done.returncode == 0, done.stderr
    return strict_json(done.stdout)


def ate(document: Any) -> float:
    return float(document["evaluation"]["ate"]["se3"]["rmse"])


def loops(folder: Path) -> list[dict[str, str]]:
    with (folder / "loops.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def pairs(path: Path, *rows: str) -> Path:
    path.write_text("\n".join(["scan_a,scan_b,verdict", *rows]) + "\n")
    return path


def points(path: Path, scans: tuple[int, ...], off: float = 0.0) -> Path:
    """Exact points in UTM; that of the last scan is `off` m too far east."""
    poses = open_sequence(SAMPLE).ground_truth.poses  # type: ignore[union-attr]
    T = se3.make(so3.exp(np.array([0.0, 0.0, 0.7])), np.zeros(3))
    places = Projection(Georeference(np.array([49.0112, 8.4229, 115.0]), T, 25832)).apply(poses[:, :3, 3])
    places[scans[-1], 0] += off
    rows = [f"{k},{places[k, 0]:.4f},{places[k, 1]:.4f},{places[k, 2]:.4f},0.02,EPSG:25832" for k in scans]
    path.write_text("\n".join(["scan,x,y,z,sigma,crs", *rows]) + "\n")
    return path


def test_without_edits_it_is_the_same_graph_to_the_byte(drives: Path, tmp_path: Path) -> None:
    again(drives / "plain", tmp_path / "out")
    for name in ("trajectory.tum", "trajectory_odometry.tum", "loops.csv", "graph.g2o", "scans.csv"):
        assert (tmp_path / "out" / name).read_bytes() == (drives / "plain" / name).read_bytes(), name
    # And from what came of it, once more, now with a map.
    again(tmp_path / "out", tmp_path / "third", "--set", "map.write=true")
    assert (tmp_path / "third" / "trajectory.tum").read_bytes() == (drives / "plain" / "trajectory.tum").read_bytes()
    assert (tmp_path / "third" / "map.ply").is_file()


def test_one_known_pair_closes_the_loops_that_drift_had_hidden(drives: Path, tmp_path: Path) -> None:
    assert not [row for row in loops(drives / "lost") if row["verdict"] == "accepted"]
    before = ate(again(drives / "lost", tmp_path / "before"))
    known = pairs(tmp_path / "edits.csv", "0,94,known")
    document = again(drives / "lost", tmp_path / "out", "--loops", known)
    stages = [row["stage"] for row in loops(tmp_path / "out") if row["verdict"] == "accepted"]
    assert stages[0] == "manual"
    assert len(stages) > 1
    assert ate(document) < 0.05 * before
    assert any("line 2: the known pair holds, though" in said for said in document["manifest"]["problems"])
    alone = again(drives / "lost", tmp_path / "alone", "--loops", known, "--only-known")
    assert len(loops(tmp_path / "alone")) == 1
    assert ate(alone) < 0.2 * before


def test_a_pair_that_shows_two_places_closes_nothing_and_is_said(drives: Path, tmp_path: Path) -> None:
    edits = pairs(tmp_path / "edits.csv", "0,50,known", "4,4,known", "50,0,known", "50,0,forbidden")
    document = again(drives / "plain", tmp_path / "out", "--loops", edits)
    said = document["manifest"]["problems"]
    assert any("line 2: the scans of the known pair do not close a loop" in sentence for sentence in said)
    for problem in (
        "line 3: both scans belong to one keyframe",
        "line 4: the pair is named twice",
        "line 2: the pair is known and",
    ):
        assert any(problem in sentence for sentence in said)
    assert document["manifest"]["status"] == "degraded"


def test_around_a_forbidden_pair_nothing_is_closed(drives: Path, tmp_path: Path) -> None:
    closed = [row for row in loops(drives / "plain") if row["verdict"] == "accepted"]
    edited = (drives / "plain" / "loops.csv").read_text().replace(",accepted,", ",forbidden,")
    (tmp_path / "edits.csv").write_text(edited)
    again(drives / "plain", tmp_path / "out", "--loops", tmp_path / "edits.csv")
    way = read_trajectory(drives / "plain" / "trajectory_odometry.tum", "tum").path_lengths
    assert closed
    for row in loops(tmp_path / "out"):
        if row["verdict"] == "accepted":
            ends = way[[int(row["scan_a"]), int(row["scan_b"])]]
            away = [np.abs(ends - way[[int(one["scan_a"]), int(one["scan_b"])]]).max() for one in closed]
            assert min(away) > 8.0, "one end at least lies farther along its way"


def test_control_points_give_the_place_and_hold_the_poses(drives: Path, tmp_path: Path) -> None:
    control = points(tmp_path / "points.csv", (0, 20, 45, 70, 94))
    document = again(drives / "lost", tmp_path / "out", "--control", control, "--only-known")
    assert document["manifest"]["georeference"]["method"] == "control"
    facts = document["manifest"]["graph"]["control_points"]
    assert facts["count"] == 5
    assert facts["rms_horizontal_m"] < 0.01
    assert ate(document) < 0.3 * ate(again(drives / "lost", tmp_path / "before"))
    with (tmp_path / "out" / "control.csv").open(newline="") as stream:
        assert len(list(csv.DictReader(stream))) == 5


def test_residuals_of_control_points_are_those_of_the_refined_poses(drives: Path, tmp_path: Path) -> None:
    control = points(tmp_path / "points.csv", (0, 20, 45, 70, 94))
    before = again(drives / "lost", tmp_path / "before", "--control", control, "--only-known")
    document = again(drives / "lost", tmp_path / "out", "--control", control, "--only-known", "--refine")
    assert document["manifest"]["refinement"]["is_taken"]
    assert ate(document) < 0.8 * ate(before)
    poses = read_trajectory(tmp_path / "out" / "trajectory.tum", "tum").poses[[0, 20, 45, 70, 94], :3, 3]
    place = document["manifest"]["georeference"]
    origin, T = np.array(place["origin_lat_lon_height"]), np.array(place["T_enu_world"])
    with control.open(newline="") as stream:
        surveyed = np.array([[float(row[axis]) for axis in "xyz"] for row in csv.DictReader(stream)])
    solved = Projection(Georeference(origin, T, 25832)).apply(poses)
    with (tmp_path / "out" / "control.csv").open(newline="") as stream:
        said = np.array([[float(row[name]) for name in ("east_m", "north_m")] for row in csv.DictReader(stream)])
    # East and north of the grid and of the place differ by its convergence, under 0.5 deg there.
    np.testing.assert_allclose(said, (surveyed - solved)[:, :2], atol=5e-4)
    rms = document["manifest"]["graph"]["control_points"]["rms_horizontal_m"]
    assert rms == pytest.approx(np.sqrt(np.mean(np.sum(said**2, axis=1))), abs=2e-4)


def test_a_wrong_control_point_is_named(drives: Path, tmp_path: Path) -> None:
    control = points(tmp_path / "points.csv", (0, 20, 45, 70, 94), off=3.0)
    said = again(drives / "plain", tmp_path / "out", "--control", control)["manifest"]["problems"]
    assert any("points.csv, line 5 and points.csv, line 6: the control points are" in sentence for sentence in said)
    assert any("without points.csv, line 6 the others do not" in sentence for sentence in said)


def test_a_run_takes_the_same_files(tmp_path: Path) -> None:
    known, control = pairs(tmp_path / "p.csv", "5,94,known"), points(tmp_path / "c.csv", (0, 45, 94))
    words = (
        "run",
        SAMPLE,
        "--out",
        tmp_path / "out",
        "--loops-file",
        known,
        "--control",
        control,
        "--set",
        "map.write=false",
    )
    done = lslam(*words)
    assert done.returncode == 0, done.stderr
    assert "control      3 points" in done.stdout
    assert loops(tmp_path / "out")[0]["stage"] == "manual"
    known.write_text(known.read_text() + "9,94,known\n")
    resumed = lslam(*words, "--resume")
    assert resumed.returncode == 2
    assert "the pairs of --loops-file or the points of --control are others" in resumed.stderr


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (("--loops", "none.csv"), 3, "none.csv does not exist"),
        (("--set", "odometry.method=loam"), 2, "odometry.method is of the odometry, which is not run again"),
        (("--set", "registration.sigma=0.1"), 2, "registration.sigma is of the odometry"),
        (("--sequence", "nowhere"), 3, "nowhere"),
        (("--crs", "EPSG:25832"), 2, "--control"),
        (("--resume", "--overwrite"), 2, "give one of them"),
    ],
)
def test_what_it_cannot_do_is_one_sentence(
    drives: Path, tmp_path: Path, words: tuple[str, ...], code: int, said: str
) -> None:
    done = lslam("graph", drives / "plain", "--out", tmp_path / "out", *words, cwd=tmp_path)
    assert done.returncode == code, done.stderr
    assert said in done.stderr
    assert_one_sentence(done.stderr)
    assert not (tmp_path / "out").exists()


def test_files_that_do_not_fit_the_run_are_refused_before_any_work(drives: Path, tmp_path: Path) -> None:
    for name, text, said in (
        ("--loops", "scan_a,scan_b,verdict\n0,95,known\n", "line 2: scan 95 is none of the run's, which are 0 to 94"),
        ("--loops", "stamp_a,stamp_b,verdict\n0,99,known\n", "line 2: the stamp 99.000 s is none of the run's"),
        ("--control", "scan,x,y,z,sigma,crs\n0,1,2,3,0.1,EPSG:1999\n", "EPSG:1999: PROJ knows no such"),
        (
            "--control",
            "stamp,x,y,z,sigma,crs\n9.45,8,49,3,0.1,EPSG:4326\n",
            "line 2: the stamp 9.450 s is none of the run's",
        ),
    ):
        (tmp_path / "file.csv").write_text(text)
        done = lslam("graph", drives / "plain", "--out", tmp_path / "out", name, tmp_path / "file.csv")
        assert done.returncode in (2, 3), done.stderr
        assert said in done.stderr
        assert_one_sentence(done.stderr)


def test_a_run_without_the_state_of_its_odometry_is_refused(drives: Path, tmp_path: Path) -> None:
    done = lslam(
        "run", SAMPLE, "--count", 8, "--out", tmp_path / "run", "--set", "odometry.checkpoint_s=0", "--set", "map.write=false"
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    refused = lslam("graph", tmp_path / "run")
    assert refused.returncode == 3
    assert "kept no state of its odometry" in refused.stderr
    assert not (tmp_path / "run-graph").exists()


def test_a_damaged_state_of_odometry_is_no_reason_to_run_it_again(drives: Path, tmp_path: Path) -> None:
    shutil.copytree(drives / "plain", tmp_path / "run")
    (tmp_path / "run" / "keyframes" / "odometry.npz").write_bytes(b"PK")
    refused = lslam("graph", tmp_path / "run")
    assert refused.returncode == 3
    assert "damaged or incomplete" in refused.stderr
    # What was begun from it is repeated from one that is whole.
    shutil.copy(drives / "plain" / "keyframes" / "odometry.npz", tmp_path / "run" / "keyframes")
    done = lslam("graph", tmp_path / "run", "--resume", "--no-map")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run-graph" / "trajectory.tum").read_bytes() == (
        drives / "plain" / "trajectory.tum"
    ).read_bytes()


def test_the_run_itself_is_never_written_over(drives: Path) -> None:
    before = manifest(drives / "plain")
    link = drives / "link"
    link.symlink_to(drives / "plain")
    for out, flag in (
        (drives / "plain", "--overwrite"),
        (link, "--overwrite"),
        (drives / "lost" / ".." / "plain", "--resume"),
    ):
        done = lslam("graph", drives / "plain", "--out", out, flag)
        assert done.returncode == 2
        assert "the run itself stays as it is" in done.stderr
    assert manifest(drives / "plain") == before
