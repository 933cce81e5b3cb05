"""A map in tiles: every point in the tile where it belongs, none twice, and the whole of them the map."""

from __future__ import annotations

import json
from pathlib import Path

import laspy
import numpy as np
import pytest
from pyproj import CRS, Transformer
from scipy.spatial import cKDTree

from lslam.core.errors import InputError, LslamError, OutputError, OutputExistsError
from lslam.core.types.cloud import ArrayCloud
from lslam.core.types.gnss import Georeference
from lslam.io.formats.ply_files import ply_columns
from lslam.io.formats.point_files import read_cloud
from lslam.maps.colour import ColouredCloud
from lslam.maps.georeference import ProjectedCloud, Projection
from lslam.pipeline import map_tiles
from lslam.pipeline.map_files import MapNote
from lslam.pipeline.map_tiles import check_tiles, write_tiles
from lslam.pipeline.stored_map import is_tiles, map_of

NOTE = MapNote("drive", 0.2)
POINTS = np.random.default_rng(3).uniform([-70, -30, -2], [90, 45, 6], (5000, 3))
CLOUD = ArrayCloud.of(POINTS, np.arange(5000) / 5000)


@pytest.mark.parametrize("suffix", ["ply", "laz"])
def test_each_point_lies_in_its_tile_and_in_no_other(suffix: str, tmp_path: Path) -> None:
    index = write_tiles(tmp_path, CLOUD, NOTE, 25.0, suffix)
    assert index["points"] == 5000 == sum(tile["points"] for tile in index["tiles"])
    for tile in index["tiles"]:
        points = read_cloud(tmp_path / tile["file"]).points
        x, y = (int(part) for part in tile["file"].split(".")[0].split("_")[1:])
        assert (np.floor((points[:, :2] + 1e-4) / 25.0) >= [x, y]).all()
        assert (np.floor((points[:, :2] - 1e-3) / 25.0) <= [x, y]).all()
        assert len(points) == tile["points"]
    whole = map_of(tmp_path).read()
    away, nearest = cKDTree(POINTS).query(whole.points)
    assert away.max() < 0.002
    assert sorted(nearest.tolist()) == list(range(5000))


def test_tiles_keep_the_colours_of_their_points(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(map_tiles, "MOST_WAITING", 1000)
    colours = np.random.default_rng(5).integers(0, 256, (5000, 3)).astype(np.uint8)
    index = write_tiles(tmp_path, ColouredCloud(CLOUD, colours), NOTE, 25.0, "ply")
    for tile in index["tiles"]:
        columns = ply_columns(tmp_path / tile["file"])
        _, nearest = cKDTree(POINTS).query(np.stack([columns[axis] for axis in "xyz"], axis=1))
        assert (np.stack([columns[c] for c in ("red", "green", "blue")], axis=1) == colours[nearest]).all()


def test_projected_points_keep_their_colours() -> None:
    colours = np.random.default_rng(5).integers(0, 256, (5000, 3)).astype(np.uint8)
    projection = Projection(Georeference(np.array([49.0, 8.4, 100.0]), np.eye(4)))
    blocks = list(ProjectedCloud(ColouredCloud(CLOUD, colours), projection.apply).blocks())
    found = np.concatenate([np.stack([block.columns[c] for c in ("red", "green", "blue")], axis=1) for block in blocks])
    assert (found == colours).all()


def test_few_points_in_memory_give_the_same_tiles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (one := tmp_path / "one").mkdir()
    (many := tmp_path / "many").mkdir()
    write_tiles(one, CLOUD, NOTE, 20.0, "ply")
    monkeypatch.setattr(map_tiles, "MOST_WAITING", 100)
    monkeypatch.setattr("lslam.core.types.cloud.BLOCK", 64)
    write_tiles(many, CLOUD, NOTE, 20.0, "ply")
    assert sorted(p.name for p in one.iterdir()) == sorted(p.name for p in many.iterdir())
    for path in one.iterdir():
        assert path.read_bytes() == (many / path.name).read_bytes(), path.name


def test_tiles_of_a_georeferenced_run_lie_on_the_grid_of_their_crs(tmp_path: Path) -> None:
    georeference = Georeference(np.array([49.0, 8.4, 110.0]), np.eye(4))
    index = write_tiles(tmp_path, CLOUD, NOTE, 50.0, "laz", georeference)
    assert index["crs"] == "EPSG:32632"
    there = Projection(georeference).apply(POINTS)
    names = {f"tile_{x}_{y}.copc.laz" for x, y in np.floor(there[:, :2] / 50.0).astype(int).tolist()}
    assert {tile["file"] for tile in index["tiles"]} == names


def test_qgis_finds_the_tiles_in_a_virtual_point_cloud(tmp_path: Path) -> None:
    georeference = Georeference(np.array([49.0, 8.4, 110.0]), np.eye(4))
    columns = {"time_ns": 1_700_000_000_000_000_000 + np.arange(5000), "class": np.full(5000, 40, np.uint16)}
    cloud = ArrayCloud(CLOUD.points, CLOUD.intensity, columns)
    index = write_tiles(tmp_path, cloud, NOTE, 50.0, "laz", georeference)
    items = json.loads((tmp_path / "tiles.vpc").read_text())["features"]
    assert sum(item["properties"]["pc:count"] for item in items) == len(cloud)
    to_utm = Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True)
    for item, tile in zip(items, index["tiles"], strict=True):
        assert item["assets"]["data"]["href"] == f"./{tile['file']}"
        about, header = item["properties"], laspy.open(tmp_path / tile["file"]).header
        np.testing.assert_allclose(about["proj:bbox"], [*header.mins, *header.maxs], atol=1e-3)
        assert CRS.from_wkt(about["proj:wkt2"]).to_epsg() == 32632
        corners = np.array(item["geometry"]["coordinates"][0])
        x, y = to_utm.transform(*corners.T)
        assert [min(x), min(y), max(x), max(y)] == pytest.approx([*header.mins[:2], *header.maxs[:2]], abs=2e-3)
        named = {one["name"]: one for one in about["pc:schemas"]}
        own = {"X", "Y", "Z", "Intensity", "GpsTime", "Classification", "class"}
        assert set(named) == own
        assert named["class"] == {"name": "class", "size": 2, "type": "unsigned"}
        assert about["datetime"] == "2023-11-14T22:13:20Z"
    write_tiles(tmp_path, cloud, NOTE, 50.0, "ply", georeference)
    assert not (tmp_path / "tiles.vpc").exists()


def test_tiles_of_an_earlier_map_are_gone(tmp_path: Path) -> None:
    write_tiles(tmp_path, CLOUD, NOTE, 10.0, "ply")
    index = write_tiles(tmp_path, CLOUD, NOTE, 50.0, "laz")
    assert {p.name for p in tmp_path.iterdir()} == {"map.json", *(tile["file"] for tile in index["tiles"])}


def test_what_is_no_folder_of_tiles_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    with pytest.raises(OutputExistsError):
        check_tiles(tmp_path, 50.0, False)
    with pytest.raises(OutputError, match="something else"):
        check_tiles(tmp_path, 50.0, True)
    assert (tmp_path / "thesis.txt").exists()


@pytest.mark.parametrize("size", [0.0, -5.0, 1e6, float("nan")])
def test_a_size_that_makes_no_sense_is_refused(size: float, tmp_path: Path) -> None:
    with pytest.raises(LslamError, match="--tiles"):
        check_tiles(tmp_path / "new", size, False)


def test_a_missing_tile_is_named(tmp_path: Path) -> None:
    index = write_tiles(tmp_path, CLOUD, NOTE, 25.0, "ply")
    (tmp_path / index["tiles"][1]["file"]).unlink()
    assert is_tiles(tmp_path)
    with pytest.raises(InputError, match=index["tiles"][1]["file"]):
        map_of(tmp_path).read()


def test_an_index_cannot_point_elsewhere(tmp_path: Path) -> None:
    (tmp_path / "map.json").write_text('{"schema": 1, "kind": "tiles", "tiles": [{"file": "../secret.ply"}]}')
    with pytest.raises(InputError, match="lists no tiles"):
        map_of(tmp_path)
