"""`lslam localize` as a user calls it: a town driven twice, and what can go wrong between the two drives."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from calling import SAMPLE, assert_one_sentence, lslam, strict_json
from made_once import MadeOnce
from revisits import Floats, frame_from_town, place_visits, town_poses

from lslam.core.geometry import se3
from lslam.core.types.cloud import ArrayCloud
from lslam.io.formats.point_files import read_cloud, write_cloud
from lslam.io.formats.trajectory_files import read_trajectory

GRID = np.array([512_000.0, 5_427_000.0, 0.0])


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory, made_once: MadeOnce) -> Path:
    """`monday` with its run in `map`, and `tuesday`."""
    root = tmp_path_factory.mktemp("drives")
    place_visits(root, made_once, {"monday": "map"})
    return root


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "localization.csv").open() as stream:
        return list(csv.DictReader(stream))


def map_from_town(root: Path) -> Floats:
    return frame_from_town(root, root / "map" / "trajectory.tum", "monday")


def test_another_drive_is_found_and_followed_in_the_frame_of_the_map(drives: Path, tmp_path: Path) -> None:
    done = lslam("localize", drives / "tuesday", "--map", drives / "map", "--out", tmp_path / "run", "--json")
    assert done.returncode == 0, done.stderr
    document = strict_json(done.stdout)
    about = document["manifest"]["localization"]
    assert about["held"] == 50
    assert about["start"]["votes"] >= 2
    est = read_trajectory(tmp_path / "run" / "trajectory.tum", "tum").positions
    true = se3.apply(map_from_town(drives), town_poses(drives, "tuesday")[:, :3, 3])
    # No alignment: the frame is the map's.
    assert np.linalg.norm(est - true, axis=1).max() < 0.05
    table = rows(tmp_path / "run")
    assert [row["status"] for row in table] == ["held"] * 50
    assert np.allclose([[float(row[axis]) for axis in "xyz"] for row in table], est, atol=1e-3)
    assert not (tmp_path / "run" / "map.ply").exists()
    page = (tmp_path / "run" / "report.html").read_text()
    assert "<h2>In the map</h2>" in page
    assert "of the points agree" in page
    assert "the pose graph</h3>" not in page


def test_a_survey_in_projected_coordinates_keeps_them(drives: Path, tmp_path: Path) -> None:
    cloud = read_cloud(drives / "map" / "map.ply")
    write_cloud(tmp_path / "survey.laz", ArrayCloud.of(cloud.points + GRID))
    words = ("--map", tmp_path / "survey.laz", "--count", 30, "--out", tmp_path / "run", "-q")
    done = lslam("localize", drives / "tuesday", *words)
    assert done.returncode == 0, done.stderr
    true = se3.apply(map_from_town(drives), town_poses(drives, "tuesday")[:30, :3, 3]) + GRID
    at = np.array([[float(row[axis]) for axis in "xyz"] for row in rows(tmp_path / "run")])
    assert np.linalg.norm(at - true, axis=1).max() < 0.06


def test_a_start_that_is_given_is_where_it_begins(drives: Path, tmp_path: Path) -> None:
    T = map_from_town(drives) @ town_poses(drives, "tuesday")[0]
    heading = float(np.rad2deg(np.arctan2(T[1, 0], T[0, 0])))
    place = f"{T[0, 3] + 3:.1f},{T[1, 3] - 2:.1f},{heading + 8:.0f}"
    words = ("--start", place, "--count", 20, "--out", tmp_path / "run", "-q")
    done = lslam("localize", drives / "tuesday", "--map", drives / "map", *words)
    assert done.returncode == 0, done.stderr
    first = read_trajectory(tmp_path / "run" / "trajectory.tum", "tum").positions[0]
    assert np.linalg.norm(first - T[:3, 3]) < 0.05


def test_a_drive_elsewhere_is_refused_with_exit_1_and_nothing_invented(drives: Path, tmp_path: Path) -> None:
    done = lslam("localize", SAMPLE, "--map", drives / "map", "--count", 30, "--out", tmp_path / "run")
    assert done.returncode == 1
    assert "was not found in" in done.stderr
    assert "--start X,Y,HEADING" in done.stderr
    assert not (tmp_path / "run" / "trajectory.tum").exists()
    assert json.loads((tmp_path / "run" / "manifest.json").read_text())["status"] == "failed"


def test_a_new_map_lies_on_the_old_one(drives: Path, tmp_path: Path) -> None:
    words = ("--map", drives / "map", "--count", 25, "--save-map", "--out", tmp_path / "run", "-q")
    assert lslam("localize", drives / "tuesday", *words).returncode == 0
    done = lslam("map", tmp_path / "run", "--against", drives / "map" / "map.ply", "--threshold", 0.3, "--json")
    assert strict_json(done.stdout)["against"]["precision"] > 0.9


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (("--map", "nowhere"), 3, "nowhere does not exist"),
        (("--map", "map", "--start", "17"), 2, "--first 17"),
        (("--map", "map", "--start", "1,2"), 2, "X,Y,HEADING"),
        (("--map", "map", "--gnss"), 3, "satellite fixes"),
        (("--map", "monday"), 3, "no folder of a run"),
        (("--map", "monday.npy.txt"), 3, "no run folder and no cloud"),
        (("--map", "empty.ply"), 3, "empty.ply"),
    ],
)  # fmt: skip
def test_wrong_words_get_one_sentence(
    drives: Path, tmp_path: Path, words: tuple[str, ...], code: int, said: str
) -> None:
    (drives / "monday.npy.txt").write_text("no cloud")
    (drives / "empty.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    done = lslam("localize", drives / "tuesday", *words, "--count", 5, "--out", tmp_path / "run", cwd=drives)
    assert done.returncode == code, done.stderr
    assert said in done.stderr
    assert_one_sentence(done.stderr)


def test_gnss_wants_a_map_that_lies_on_the_earth(drives: Path, tmp_path: Path) -> None:
    done = lslam("localize", SAMPLE, "--map", drives / "map", "--gnss", "--out", tmp_path / "run")
    assert done.returncode == 2
    assert "not georeferenced" in done.stderr


def test_a_map_in_tiles_serves_as_the_map(drives: Path, tmp_path: Path) -> None:
    done = lslam("map", drives / "map", "--tiles", 20, "--format", "laz", "--out", tmp_path / "tiles", "--json")
    assert done.returncode == 0, done.stderr
    assert len(strict_json(done.stdout)["tiles"]) > 10
    words = ("--map", tmp_path / "tiles", "--count", 25, "--out", tmp_path / "run", "-q")
    assert lslam("localize", drives / "tuesday", *words).returncode == 0
    est = read_trajectory(tmp_path / "run" / "trajectory.tum", "tum").positions
    true = se3.apply(map_from_town(drives), town_poses(drives, "tuesday")[:25, :3, 3])
    assert np.linalg.norm(est - true, axis=1).max() < 0.05
    again = lslam("map", drives / "map", "--tiles", 20, "--out", tmp_path / "tiles")
    assert again.returncode == 2
    assert "--overwrite" in again.stderr


def test_fixes_lead_into_a_georeferenced_map(tmp_path: Path) -> None:
    words = ("--georeference", "--set", "map.format=laz", "--out", tmp_path / "map", "-q")
    assert lslam("run", SAMPLE, *words).returncode == 0
    words = ("--map", tmp_path / "map", "--gnss", "--first", 20, "--count", 25, "--out", tmp_path / "run")
    done = lslam("localize", SAMPLE, *words)
    assert done.returncode == 0, done.stderr
    assert "about its first satellite fix" in done.stderr
    assert "that of the map" in done.stdout
    here = read_trajectory(tmp_path / "run" / "trajectory.tum", "tum").positions
    there = read_trajectory(tmp_path / "map" / "trajectory.tum", "tum").positions[20:45]
    assert np.linalg.norm(here - there, axis=1).max() < 0.03
    assert (tmp_path / "run" / "trajectory.geojson").is_file()
