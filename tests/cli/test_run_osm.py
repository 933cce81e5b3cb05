"""`lslam run --osm`: buildings correct a trajectory that drifts, and unusable input is reported."""

from __future__ import annotations

import csv
import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from calling import SAMPLE, Done, assert_one_sentence, lslam, manifest

from lslam.core.geometry import geodesy, se2
from lslam.io.formats.trajectory_files import read_trajectory

FOLDER = SAMPLE / "sequences" / "00"
PART = ("--count", 45, "-q", "--no-loops", "--set", "map.write=false", "--set", "report.html=false")
DRIFT = (
    "--set",
    "debug.drift=true",
    "--set",
    "debug.drift_percent=4",
    "--set",
    "debug.drift_deg_per_100m=3",
    "--set",
    "debug.drift_seed=1",
)


def truth() -> tuple[np.ndarray, np.ndarray]:
    """Poses T_enu_lidar of all scans, and the origin of that frame."""
    world = tomllib.loads((FOLDER / "truth" / "world.toml").read_text())
    poses = read_trajectory(FOLDER / "truth" / "trajectory.tum").poses
    return np.array(world["T_enu_world"]) @ poses, np.array(world["origin_lat_lon_alt"])


def start(east: float = 0.0, north: float = 0.0) -> str:
    """--origin, so far off."""
    poses, origin = truth()
    fix = geodesy.from_local(poses[0, :3, 3][None] + [[east, north, 0.0]], origin)[0]
    return ",".join(f"{v:.9f}" for v in fix)


def heading(off_deg: float = 0.0) -> float:
    """--heading, so far off."""
    return float((90 - np.degrees(se2.of_se3(truth()[0][0])[2]) + off_deg) % 360)


def refused(done: Done, code: int, *words: str) -> None:
    """One sentence on stderr that says all the words."""
    assert done.returncode == code
    assert_one_sentence(done.stderr)
    assert all(word in done.stderr for word in words), done.stderr


def off(folder: Path) -> np.ndarray:
    """(N, 3) m, m, deg, of the run's poses against the true ones, both east and north on the Earth."""
    poses, origin = truth()
    place = np.array(manifest(folder)["georeference"]["origin_lat_lon_height"])
    found = read_trajectory(folder / "trajectory.tum").poses
    found[:, :3, 3] = geodesy.to_local(geodesy.from_local(found[:, :3, 3], place), origin)
    error = se2.of_se3(found) - se2.of_se3(poses[: len(found)])
    error[:, 2] = np.degrees(se2.wrap(error[:, 2]))
    return np.abs(error)


@pytest.fixture(scope="module")
def held(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Odometry that runs away, begun 5 m and 8 deg off, held by the buildings of a map that is known to be good."""
    out = tmp_path_factory.mktemp("osm") / "held"
    done = lslam(
        "run", SAMPLE, "--out", out, "--osm", FOLDER / "map.osm", "--origin", start(4.0, -3.0), "--heading", heading(8.0),
        "--set", "osm.map_sigma=0.1", *DRIFT, *PART,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return out


def test_buildings_correct_drift_from_any_given_start(held: Path, tmp_path: Path) -> None:
    error = off(held)
    assert error[:, :2].max() < 0.6
    assert error[:, 2].max() < 1.0
    free = lslam("run", SAMPLE, "--out", tmp_path / "free", *DRIFT, *PART)
    assert free.returncode == 0
    ate = [json.loads((f / "evaluation.json").read_text())["thesis2"]["ate_mean"] for f in (held, tmp_path / "free")]
    assert ate[0] < 0.73 * ate[1]


def test_the_world_is_the_map_and_the_manifest_says_so(held: Path) -> None:
    facts = manifest(held)
    assert facts["georeference"]["method"] == "osm"
    assert "east, north, up" in facts["frames"]["world"]
    assert facts["graph"]["map_priors"] > 5


def test_every_match_is_listed(held: Path) -> None:
    with (held / "osm_matches.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    of_keyframes = [row for row in rows if not row["building"]]
    assert len(of_keyframes) == manifest(held)["keyframes"]["count"]
    assert all((row["verdict"] == "accepted") == (row["reason"] == "") for row in rows)
    houses = [row for row in rows if row["building"] and row["verdict"] == "accepted" and row["rank"] == "3"]
    assert len(houses) > 10
    # The extract is exact: no house is to be moved.
    assert np.median([np.hypot(float(row["x_m"]), float(row["y_m"])) for row in houses]) < 0.3


def test_the_heading_is_found(tmp_path: Path) -> None:
    done = lslam("run", SAMPLE, "--out", tmp_path / "out", "--osm", FOLDER / "map.osm", "--origin", start(-6, 5), *PART)
    assert done.returncode == 0, done.stderr
    assert off(tmp_path / "out")[:, :2].max() < 0.6


def test_fixes_say_where_it_begins(tmp_path: Path) -> None:
    done = lslam(
        "run", SAMPLE, "--out", tmp_path / "out", "--osm", FOLDER / "map.osm", "--georeference", *PART
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert manifest(tmp_path / "out")["georeference"]["method"] == "osm"
    assert off(tmp_path / "out")[:, :2].max() < 0.6


def test_without_a_place_it_asks_for_one(tmp_path: Path) -> None:
    done = lslam("run", SAMPLE, "--out", tmp_path / "out", "--osm", FOLDER / "map.osm", *PART)
    refused(done, 2, "--origin LAT,LON", "--gnss")
    assert not (tmp_path / "out").exists()


def test_another_town_is_refused_at_once_with_its_distance(tmp_path: Path) -> None:
    done = lslam(
        "run", SAMPLE, "--out", tmp_path / "out", "--osm", FOLDER / "map.osm", "--origin", "49.3,8.4", *PART
    )  # fmt: skip
    refused(done, 3, "map.osm", "33 km away", "--origin")
    assert not (tmp_path / "out").exists()


def test_a_start_without_buildings_continues_with_odometry(tmp_path: Path) -> None:
    done = lslam(
        "run", SAMPLE, "--out", tmp_path / "out", "--osm", FOLDER / "map.osm", "--origin", "49.02,8.4", "--heading", 0, *PART
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    facts = manifest(tmp_path / "out")
    assert facts["status"] == "degraded"
    assert any("no building of" in problem and "m away" in problem for problem in facts["problems"])
    assert not (tmp_path / "out" / "osm_matches.csv").exists()


@pytest.mark.parametrize("flag", [("--origin", "49,8.4"), ("--heading", "90")])
def test_a_place_without_a_map_is_reported(flag: tuple[str, str], tmp_path: Path) -> None:
    refused(lslam("run", SAMPLE, "--out", tmp_path / "out", *flag, *PART), 2, "without --osm")


def test_an_origin_without_coordinates_is_refused(tmp_path: Path) -> None:
    done = lslam("run", SAMPLE, "--out", tmp_path / "out", "--osm", FOLDER / "map.osm", "--origin", "north", *PART)
    refused(done, 2, "--origin north", "LAT,LON")


def test_an_extract_that_is_missing(tmp_path: Path) -> None:
    done = lslam("run", SAMPLE, "--out", tmp_path / "out", "--osm", tmp_path / "no.osm", "--origin", start(), *PART)
    refused(done, 3, "no.osm")
