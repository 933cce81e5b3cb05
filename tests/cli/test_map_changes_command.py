"""`lslam map --against --changes` as a user calls it: a town driven twice, and a box that somebody put beside the road."""

from __future__ import annotations

import base64
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from calling import SAMPLE, assert_one_sentence, lslam, strict_json
from made_once import MadeOnce
from numpy.typing import NDArray
from point_writers import write_points
from revisits import place_visits, town_poses, visit_drive
from scipy.spatial import cKDTree

from lslam.core.geometry import se3
from lslam.core.geometry.se3 import umeyama
from lslam.core.types.gnss import Georeference
from lslam.io.formats.point_files import read_points
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.maps.georeference import Projection, to_wgs84
from lslam.simulation.record import record
from lslam.simulation.scenarios import SimulatedDrive
from lslam.simulation.scene_mesh import MeshBuilder, RayScene, Surface

# Length, width and height of the box, m: well below a whole number of cells of 0.4 m, so that noise fills no further one.
BOX = np.array([1.7, 1.3, 1.3])


def beside_the_road(drive: SimulatedDrive) -> NDArray[np.float64]:
    """(3,) middle of the foot of the box in the town: on the other lane of the first visit."""
    T = drive.city_poses[30]
    at = T[:2, 3] + 3.0 * T[:2, 1]
    return np.array([*at, float(drive.city.terrain.height(at[None])[0])])


def with_box(drive: SimulatedDrive, foot: NDArray[np.float64]) -> SimulatedDrive:
    built = MeshBuilder()
    built.add_mesh(drive.city.mesh)
    half = BOX * [0.5, 0.5, 0.0]
    built.add_box(foot - half, foot + half + [0.0, 0.0, BOX[2]], Surface.WALL)
    drive.scene = RayScene(built.build())
    return drive


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory, made_once: MadeOnce) -> Path:
    """`monday` with its run `old`; `tuesday` as it was and `boxed`, located in it."""
    root = tmp_path_factory.mktemp("drives")
    place_visits(root, made_once, {"monday": "old"})
    foot = beside_the_road(visit_drive("monday"))
    record(with_box(visit_drive("tuesday"), foot), root / "boxed")
    for name in ("tuesday", "boxed"):
        done = lslam("localize", root / name, "--map", root / "old", "--out", root / f"{name}-run", "-q")
        assert done.returncode == 0, done.stderr
    est = read_trajectory(root / "old" / "trajectory.tum", "tum").positions
    T, _, _ = umeyama(town_poses(root, "monday")[:, :3, 3], est)
    np.save(root / "foot.npy", se3.apply(T, foot[None])[0])
    return root


def changed(drives: Path, new: str, old: str, out: Path, *more: object) -> dict[str, object]:
    done = lslam("map", drives / new, "--against", drives / old, "--changes", out, "--json", *more)
    assert done.returncode == 0, done.stderr
    return dict(strict_json(done.stdout))


def test_a_town_that_stayed_has_no_changes(drives: Path, tmp_path: Path) -> None:
    document = changed(drives, "tuesday-run", "old", tmp_path / "out")
    assert document["things"] == []
    cells = document["cells"]
    assert isinstance(cells, dict)
    assert cells["same"] > 0.95 * cells["occupied_new"] > 5000
    assert cells["unseen_old"] > 100, "what the second drive never passed"
    assert json.loads((tmp_path / "out" / "changes.geojson").read_text())["features"] == []
    assert len(read_points(tmp_path / "out" / "changes.ply").points) == cells["same"]


@pytest.mark.parametrize(("new", "old", "kind"), [("boxed-run", "old", "appeared"), ("old", "boxed-run", "vanished")])
def test_a_box_is_found_where_it_stands(new: str, old: str, kind: str, drives: Path, tmp_path: Path) -> None:
    """Whichever drive was first: the frame is the same."""
    document = changed(drives, new, old, tmp_path / "out")
    things = document["things"]
    assert isinstance(things, list)
    assert [thing["kind"] for thing in things] == [kind]
    (thing,) = things
    foot = np.load(drives / "foot.npy")
    # Cells of 0.4 m: a side lies within one of its place.
    assert np.hypot(thing["x_m"] - foot[0], thing["y_m"] - foot[1]) < 0.5
    assert abs(thing["base_m"] - foot[2]) <= 0.5
    assert np.all(np.abs([thing["length_m"] - BOX[0], thing["width_m"] - BOX[1], thing["height_m"] - BOX[2]]) <= 0.8)

    tree = json.loads((tmp_path / "out" / "changes.geojson").read_text())
    (feature,) = tree["features"]
    assert feature["properties"] == thing
    assert "m in the world of" in tree["frame"]
    (ring,) = feature["geometry"]["coordinates"]
    assert ring[0] == ring[-1]
    x, y = np.transpose(ring)
    assert 0.5 * np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]) == pytest.approx(thing["length_m"] * thing["width_m"], rel=0.3)
    assert min(x) < foot[0] < max(x)
    assert min(y) < foot[1] < max(y)
    cloud = (tmp_path / "out" / "changes.ply").read_bytes()
    assert b"property float change" in cloud
    assert b"property uchar red" in cloud


def cloud_of(page: Path) -> tuple[NDArray[np.float64], NDArray[np.int8]]:
    """Points (N, 3), m, of a page's map and what became of each: -1 gone, 0 as it was, 1 not in the map."""
    found = re.search(r'<script type="application/json" id="cloud">(.*?)</script>', page.read_text(), re.S)
    assert found
    data = json.loads(found[1])
    q = np.frombuffer(base64.b64decode(data["points"]), "<i2").reshape(-1, 3)
    points = np.array(data["low"]) + np.array(data["step"]) * (q + 32768.0)
    change = data.get("change")
    return points, np.zeros(len(q), np.int8) if change is None else np.frombuffer(base64.b64decode(change), "i1")


def test_the_page_of_localize_shows_the_old_map_and_the_box_that_is_not_in_it_or_gone(
    drives: Path, tmp_path: Path
) -> None:
    foot = np.load(drives / "foot.npy")
    old = read_points(drives / "old" / "map.ply").points
    for name, kind in (("tuesday", 0), ("boxed", 1)):
        points, change = cloud_of(drives / f"{name}-run" / "report.html")
        is_old = change == 0
        assert is_old.sum() > 50_000
        assert cKDTree(old).query(points[is_old][::50])[0].max() < 0.02
        assert set(change.tolist()) == {0, kind}
        found = json.loads((drives / f"{name}-run" / "manifest.json").read_text())["localization"]["differences"]
        assert (found["gone"], found["not_in_the_map"]) == (0, kind)
    new = points[change == 1]
    assert np.linalg.norm(new[:, :2].mean(axis=0) - foot[:2]) < 0.5
    assert np.ptp(new, axis=0)[:2].max() < max(BOX) + 2 * 0.4
    # The other way round: the map has the box, and the drive does not.
    with_it = np.concatenate([old, _surface(foot)])
    write_points(tmp_path / "boxed.ply", with_it)
    words = ("--map", tmp_path / "boxed.ply", "--count", 50, "--out", tmp_path / "run", "-q")
    assert lslam("localize", drives / "tuesday", *words).returncode == 0
    points, change = cloud_of(tmp_path / "run" / "report.html")
    gone = points[change == -1]
    assert set(change.tolist()) == {0, -1}
    assert np.linalg.norm(gone[:, :2].mean(axis=0) - foot[:2]) < 0.5
    off = np.abs(gone - foot - [0, 0, BOX[2] / 2]) - BOX / 2
    assert off.max() < 0.4 + 0.2, "only what lies in cells of the box"


def _surface(foot: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points 0.1 m apart on the sides and the top of the box."""
    x, y, z = (np.arange(-half, half, 0.1) for half in BOX / 2)
    grid = np.stack(np.meshgrid(x, y, z + BOX[2] / 2), -1).reshape(-1, 3)
    shell = (np.abs(grid - [0, 0, BOX[2] / 2]) > BOX / 2 - 0.15).any(axis=1)
    return foot + grid[shell]


def test_the_table_and_the_rules_of_overwriting(drives: Path, tmp_path: Path) -> None:
    words = ("map", drives / "boxed-run", "--against", drives / "old", "--changes", tmp_path / "out", "--voxel", 0.5)
    done = lslam(*words)
    assert done.returncode == 0, done.stderr
    assert "cells of 0.5 m" in done.stdout
    assert "    1 appeared" in done.stdout
    before = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    assert set(before) == {"changes.ply", "changes.geojson"}
    again = lslam(*words)
    assert again.returncode == 2
    assert "--overwrite" in again.stderr
    assert_one_sentence(again.stderr)
    assert lslam(*words, "--overwrite", "-q", "--set", "input.threads=1").returncode == 2
    assert lslam(*words, "--overwrite", "-q").returncode == 0
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before


def test_scans_that_have_moved_are_named(drives: Path, tmp_path: Path) -> None:
    old = Path(shutil.copytree(drives / "old", tmp_path / "old"))
    manifest = json.loads((old / "manifest.json").read_text())
    manifest["sequence"]["path"] = str(tmp_path / "gone")
    (old / "manifest.json").write_text(json.dumps(manifest))
    words = ("map", old, "--against", drives / "tuesday-run", "--changes", tmp_path / "out")
    # Located in a map of another folder: two copies of a run are two runs.
    done = lslam(*words)
    assert done.returncode == 2
    assert "lslam localize" in done.stderr
    run = Path(shutil.copytree(drives / "tuesday-run", tmp_path / "tuesday-run"))
    about = json.loads((run / "manifest.json").read_text())
    about["localization"]["map"] = str(old / "map.ply")
    (run / "manifest.json").write_text(json.dumps(about))
    words = ("map", run, "--against", old, "--changes", tmp_path / "out")
    done = lslam(*words)
    assert done.returncode == 3
    assert "--against-sequence" in done.stderr
    assert_one_sentence(done.stderr)
    assert not (tmp_path / "out").exists()
    assert lslam(*words, "--against-sequence", drives / "monday", "-q").returncode == 0
    assert (tmp_path / "out" / "changes.ply").is_file()


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (("--changes", "out"), 2, "--against RUN"),
        (("--against", "old", "--against-sequence", "monday"), 2, "belongs to --changes"),
        (("--against", "old", "--changes", "out", "--clean"), 2, "--clean has no meaning"),
        (("--against", "old", "--changes", "out", "--threshold", 0.1), 2, "--threshold has no meaning"),
        (("--against", "old", "--changes", "old/manifest.json"), 2, "is no folder"),
        (("--against", "nowhere", "--changes", "out"), 3, "nowhere does not exist"),
        (("--against", "monday", "--changes", "out"), 3, "no folder of a run"),
        (("--against", "old", "--changes", "out", "--voxel", -1), 2, "occupancy_voxel"),
    ],
)  # fmt: skip
def test_wrong_words_get_one_sentence(words: tuple[object, ...], code: int, said: str, drives: Path) -> None:
    done = lslam("map", "tuesday-run", *words, cwd=drives)
    assert done.returncode == code, done.stderr
    assert said in done.stderr
    assert_one_sentence(done.stderr)
    assert not (drives / "out").exists()


def test_runs_that_nothing_ties_together_are_refused(drives: Path, tmp_path: Path) -> None:
    assert lslam("run", SAMPLE, "--count", 5, "--out", tmp_path / "other", "-q").returncode == 0
    done = lslam("map", tmp_path / "other", "--against", drives / "old", "--changes", tmp_path / "out")
    assert done.returncode == 2
    assert f"--map {drives / 'old'}" in done.stderr
    assert_one_sentence(done.stderr)


def test_drives_that_only_the_earth_ties_are_compared_too(drives: Path, tmp_path: Path) -> None:
    """Each is placed by its own surveyed points, in coordinates of its own origin."""
    assert lslam("run", drives / "boxed", "--out", tmp_path / "alone", "-q", "--set", "map.write=false").returncode == 0
    on_earth = Projection(Georeference(np.array([49.0112, 8.4229, 115.0]), np.eye(4), 25832))
    for run, name in ((drives / "old", "monday"), (tmp_path / "alone", "tuesday")):
        places = on_earth.apply(town_poses(drives, name)[:, :3, 3])
        rows = [
            f"{k},{places[k, 0]:.4f},{places[k, 1]:.4f},{places[k, 2]:.4f},0.02,EPSG:25832" for k in (0, 20, 40, 49)
        ]
        (tmp_path / "points.csv").write_text("\n".join(["scan,x,y,z,sigma,crs", *rows]) + "\n")
        words = ("--control", tmp_path / "points.csv", "--no-map", "--out", tmp_path / f"{run.name}-placed", "-q")
        done = lslam("graph", run, *words)
        assert done.returncode == 0, done.stderr
    done = lslam(
        "map", tmp_path / "alone-placed", "--against", tmp_path / "old-placed", "--changes", tmp_path / "out", "--json"
    )
    assert done.returncode == 0, done.stderr
    assert "only their places on the Earth tie" in done.stderr
    assert [thing["kind"] for thing in strict_json(done.stdout)["things"]] == ["appeared"]
    tree = json.loads((tmp_path / "out" / "changes.geojson").read_text())
    (ring,) = tree["features"][0]["geometry"]["coordinates"]
    lon, lat = np.mean(ring[:-1], axis=0)
    true = on_earth.apply(beside_the_road(visit_drive("monday"))[None])
    (box,) = to_wgs84(true, 25832)
    assert np.hypot((lat - box[0]) * 111_200, (lon - box[1]) * 72_900) < 0.6
