"""Way-points from every kind of file, and the sentences for those that are none."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lslam.core.errors import InputError
from lslam.core.geometry import se3, so3
from lslam.core.geometry.geodesy import from_local
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats.trajectory_lines import write_kitti, write_tum
from lslam.simulation.routes import read_way_points
from lslam.simulation.scenarios import simulate

SQUARE = np.array([[0.0, 0.0], [120.0, 0.0], [120.0, 90.0], [0.0, 90.0]])


def test_toml(tmp_path: Path) -> None:
    file = tmp_path / "way.toml"
    file.write_text("closed = true\npoints = [[0, 0], [120, 0], [120, 90], [0, 90]]\n")
    found = read_way_points(file)
    np.testing.assert_array_equal(found.points, SQUARE)
    assert found.closed


def test_csv_with_and_without_names(tmp_path: Path) -> None:
    file = tmp_path / "way.csv"
    file.write_text("# a comment\n0,0\n120,0\n120,90\n0,90\n")
    np.testing.assert_array_equal(read_way_points(file).points, SQUARE)
    file.write_text("x, y, z\n0,0,5\n120,0,8\n")
    np.testing.assert_array_equal(read_way_points(file).points, [[0, 0, 5], [120, 0, 8]])
    assert not read_way_points(file).closed


@pytest.mark.parametrize("kind", ["LineString", "Polygon", "Feature", "open"])
def test_geojson_is_metres_east_and_north_of_its_first_point(tmp_path: Path, kind: str) -> None:
    origin = np.array([49.01, 8.4, 0.0])
    ring = SQUARE if kind == "open" else np.concatenate([SQUARE, SQUARE[:1]])
    fixes = from_local(np.column_stack([ring, np.zeros(len(ring))]), origin)
    coordinates = fixes[:, [1, 0]].tolist()
    shape = {"type": "Polygon", "coordinates": [coordinates]} if kind == "Polygon" else {
        "type": "LineString", "coordinates": coordinates}  # fmt: skip
    tree = (
        {"type": "FeatureCollection", "features": [{"type": "Feature", "geometry": shape}]}
        if kind == "Feature"
        else shape
    )
    file = tmp_path / "way.geojson"
    file.write_text(json.dumps(tree))
    found = read_way_points(file)
    np.testing.assert_allclose(found.points, SQUARE, atol=1e-4)
    assert found.closed == (kind != "open")


def test_a_trajectory_gives_its_level_shape_from_its_start_along_x(tmp_path: Path) -> None:
    s = np.linspace(0, 200, 800)
    heading = 0.7 + 0.004 * s
    xy = np.cumsum(np.column_stack([np.cos(heading), np.sin(heading)]) * 0.25, axis=0)
    R = so3.exp(np.column_stack([0 * s, 0 * s, heading]))
    poses = se3.make(R, np.column_stack([xy, 1 + 0 * s]))
    stamps = np.arange(len(s), dtype=np.int64) * 100_000_000
    write_tum(tmp_path / "a.tum", Trajectory(stamps, poses, "lidar"))
    # As KITTI has it: camera 0 in camera 0 at the start.
    axes = se3.make(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.zeros(3))
    write_kitti(
        tmp_path / "07.txt", Trajectory(stamps, axes @ se3.relative(poses[0], poses) @ se3.inverse(axes), "cam0")
    )
    for name in ("a.tum", "07.txt"):
        p = read_way_points(tmp_path / name).points
        steps = np.linalg.norm(np.diff(p, axis=0), axis=1)
        assert steps.min() >= 3.0
        assert steps.max() < 3.3
        assert steps.sum() == pytest.approx(200, abs=5)
        np.testing.assert_allclose(p[:2, 1], 0, atol=1e-9)
        # It bends to the left, by as much as the trajectory does.
        turned = np.arctan2(*(p[-1] - p[-2])[::-1])
        assert turned == pytest.approx(0.004 * 197, abs=0.03)


def test_a_drive_follows_its_way_points_and_the_town_is_built_round_them(tmp_path: Path) -> None:
    file = tmp_path / "way.csv"
    file.write_text("0,0\n80,0\n80,70\n150,90\n")
    bare = ["world.levels=0", "traffic.cars=0", "traffic.people=0", "path.smoothing=6"]
    drive = simulate("residential", way_points=read_way_points(file), settings=bare)
    line = drive.city_poses[:, :2, 3]
    assert np.linalg.norm(line[0]) < 0.1
    assert np.linalg.norm(line[-1] - [150, 90]) < 3
    for corner in ((40, 0), (80, 35), (115, 80)):
        assert np.linalg.norm(line - corner, axis=1).min() < 1.0
    assert len(drive.city.footprints) > 20
    # The street lies to the left of the line, by the lane.
    street = drive.city.streets[0]
    at = street.position(street.sample(0.5))
    away = np.linalg.norm(at[:, None] - line[len(line) // 4], axis=2).min()
    assert away == pytest.approx(drive.scenario.path.lane, abs=0.15)


def test_heights_of_way_points_are_flown(tmp_path: Path) -> None:
    file = tmp_path / "way.csv"
    file.write_text("x,y,z\n0,0,12\n100,0,12\n200,0,25\n")
    drive = simulate("open", way_points=read_way_points(file), settings=["world.levels=0", "path.swing=0"])
    z, x = drive.city_poses[:, 2, 3], drive.city_poses[:, 0, 3]
    assert z[np.argmin(np.abs(x - 50))] == pytest.approx(12, abs=0.1)
    assert z[np.argmin(np.abs(x - 150))] == pytest.approx(18.5, abs=0.2)


@pytest.mark.parametrize(
    ("name", "text", "sentence"),
    [
        ("way.toml", "points = [[0, 0], [50, 0]]\nclose = true", "unknown key 'close'; did you mean 'closed'"),
        ("way.toml", "points = [[0, 0, 0, 0]]", "rows of two or three numbers"),
        ("way.toml", "points = [[0, 0], [nan, 0]]", "rows of two or three numbers"),
        ("way.toml", "points = ", "not valid TOML"),
        ("way.toml", "closed = 1\npoints = [[0, 0], [50, 0]]", "expected true or false"),
        ("way.toml", "closed = true\npoints = [[0, 0], [50, 0]]", "too few way-points: 2, a closed path needs 3"),
        ("way.csv", "east,north\n0,0\n", "expected x,y"),
        ("way.csv", "0,0\n5,0\n", "at least 15 m"),
        ("way.csv", "0,0\n", "too few way-points: 1, a path needs 2"),
        ("way.csv", "0,0\n50,a\n", "rows of two or three numbers"),
        ("way.csv", "0,0\n50,0\n50,0\n", "way-point 3 is the same"),
        ("way.csv", "0,0\n90000,0\n", "way-points are in metres"),
        ("way.csv", "", "rows of two or three numbers"),
        ("way.geojson", "{", "not valid JSON"),
        ("way.geojson", '{"type": "Point", "coordinates": [8, 49]}', "holds 0 lines"),
        ("way.geojson", '{"type": "LineString", "coordinates": [[800, 49], [8, 49]]}', "longitude and latitude"),
        ("way.geojson", '{"type": "LineString"}', "rows of two or three numbers"),
        ("way.txt", "1 2 3\n", "no trajectory format"),
    ],
)
def test_what_is_no_way_points_is_said(tmp_path: Path, name: str, text: str, sentence: str) -> None:
    file = tmp_path / name
    file.write_text(text)
    with pytest.raises(InputError) as said:
        read_way_points(file)
    assert sentence in str(said.value)
    assert name in str(said.value)


def test_a_file_that_is_absent_is_exit_code_3(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist") as said:
        read_way_points(tmp_path / "07.txt")
    assert said.value.exit_code == 3
