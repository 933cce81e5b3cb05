"""Where a map lies on the Earth, against pyproj's own way from latitude and longitude."""

from __future__ import annotations

import json
from pathlib import Path

import laspy
import numpy as np
import pytest
from numpy.typing import NDArray
from pyproj import CRS, Transformer

from lslam.core.errors import UsageError
from lslam.core.geometry import se3, so3
from lslam.core.geometry.crs_names import parse_crs
from lslam.core.types.cloud import ArrayCloud
from lslam.core.types.gnss import Georeference
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats.las_files import read_las
from lslam.maps.georeference import Projection, to_lat_lon, utm_epsg
from lslam.pipeline.map_files import MapNote, write_geojson, write_map

KARLSRUHE = np.array([49.0113, 8.4256, 116.4])


def reference(epsg: int | None = None, origin: NDArray[np.float64] = KARLSRUHE) -> Georeference:
    T = se3.make(so3.exp(np.array([0.02, -0.01, 2.1])), np.array([12.0, -7.0, 1.5]))
    return Georeference(origin, T, epsg)


def true_places(points: NDArray[np.float64], georeference: Georeference, epsg: int) -> NDArray[np.float64]:
    """By the geographic coordinates on the ellipsoid: WGS84 -> the coordinate reference system."""
    lat_lon = to_lat_lon(points, georeference)
    x, y = Transformer.from_crs("EPSG:4326", f"EPSG:{epsg}", always_xy=True).transform(lat_lon[:, 1], lat_lon[:, 0])
    return np.column_stack([x, y, lat_lon[:, 2]])


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize("epsg", [None, 25832, 5683])
def test_las_lies_at_the_right_place(tmp_path: Path, suffix: str, epsg: int | None) -> None:
    points = np.random.default_rng(4).uniform(-800, 800, (2000, 3))
    g = reference(epsg)
    write_map(tmp_path / f"map.{suffix}", ArrayCloud.of(points), MapNote("somewhere", 0.2), g)
    back = laspy.read(tmp_path / f"map.{suffix}")
    truth = true_places(points, g, epsg or 32632)
    np.testing.assert_allclose(back.xyz, truth, atol=0.01)
    wkt = read_las(tmp_path / f"map.{suffix}")[1]
    assert CRS.from_wkt(wkt).is_projected
    assert wkt.endswith(f'AUTHORITY["EPSG","{epsg or 32632}"]]')
    about = json.loads((tmp_path / "map.json").read_text())
    assert about["crs"] == f"EPSG:{epsg or 32632}"
    assert (about["points"], about["voxel"], about["sequence"]) == (2000, 0.2, "somewhere")


def test_the_origin_itself_is_at_the_origin() -> None:
    g = Georeference(KARLSRUHE, np.eye(4))
    at = to_lat_lon(np.zeros((1, 3)), g)[0]
    np.testing.assert_allclose(at, KARLSRUHE, atol=1e-9)
    x, y = Transformer.from_crs(4326, 32632, always_xy=True).transform(KARLSRUHE[1], KARLSRUHE[0])
    np.testing.assert_allclose(Projection(g).apply(np.zeros((1, 3)))[0], [x, y, KARLSRUHE[2]], atol=1e-4)


def test_back_from_the_map_to_the_run() -> None:
    points = np.random.default_rng(4).uniform(-800, 800, (50, 3))
    projection = Projection(reference(5683))
    np.testing.assert_allclose(projection.invert(projection.apply(points)), points, atol=1e-3)


def test_zones() -> None:
    assert [utm_epsg(*p) for p in ((0, -180), (0, 179.9), (-1, 0), (59, 10), (0, 180))] == [
        32601, 32660, 32731, 32632, 32601,
    ]  # fmt: skip


def test_ply_stays_in_the_world_of_the_run(tmp_path: Path) -> None:
    points = np.random.default_rng(4).uniform(-8, 8, (20, 3))
    write_map(tmp_path / "map.ply", ArrayCloud.of(points), MapNote("somewhere", 0.2, ("cropped",)), reference())
    about = json.loads((tmp_path / "map.json").read_text())
    assert about["frame"] == "world of trajectory.tum"
    assert about["crs"] is None
    assert about["done"] == ["cropped"]
    T = np.array(about["georeference"]["T_enu_world"])
    np.testing.assert_allclose(T, reference().T_enu_world)
    write_map(tmp_path / "map.laz", ArrayCloud.of(points), MapNote("nowhere", 0.2))
    about = json.loads((tmp_path / "map.json").read_text())
    assert (about["crs"], about["georeference"]) == (None, None)
    np.testing.assert_allclose(laspy.read(tmp_path / "map.laz").xyz, points, atol=0.00051)


def test_coordinate_reference_systems_that_will_not_do(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"EPSG:4326 \(WGS 84\) does not count in metres.*EPSG:32632"):
        write_map(tmp_path / "map.laz", ArrayCloud.of(np.zeros((1, 3))), MapNote("x", 0.2), reference(4326))
    with pytest.raises(UsageError, match="knows no such"):
        Projection(reference(99999)).check()
    with pytest.raises(UsageError, match="EPSG:2263"):
        Projection(reference(2263)).check()  # US feet
    assert parse_crs("epsg:25832") == (25832, None)
    assert parse_crs("EPSG:25832+7837") == parse_crs("EPSG:25832+EPSG:7837") == (25832, 7837)
    for bad in ("25832", "EPSG:", "EPSG:x", "EPSG:25832+", "EPSG:25832+x", "ESRI:102100"):
        with pytest.raises(UsageError, match="expected EPSG and a number"):
            parse_crs(bad)
    assert not list(tmp_path.iterdir())


def test_the_trajectory_as_geojson(tmp_path: Path) -> None:
    g = reference()
    poses = np.tile(np.eye(4), (30, 1, 1))
    poses[:, 0, 3] = np.arange(30)
    write_geojson(tmp_path / "t.geojson", Trajectory(np.arange(30) * 10**8, poses), g, "somewhere")
    document = json.loads((tmp_path / "t.geojson").read_text())
    feature = document["features"][0]
    assert (document["type"], feature["geometry"]["type"]) == ("FeatureCollection", "LineString")
    places = np.array(feature["geometry"]["coordinates"])
    expected = to_lat_lon(poses[:, :3, 3], g)
    np.testing.assert_allclose(places[:, [1, 0]], expected[:, :2], atol=0.51e-7)
    np.testing.assert_allclose(places[:, 2], expected[:, 2], atol=0.51e-3)
    for count, kind in ((1, "Point"), (0, None)):
        from lslam.io.formats.geojson import write_line

        write_line(tmp_path / "t.geojson", expected[:count], {})
        geometry = json.loads((tmp_path / "t.geojson").read_text())["features"][0]["geometry"]
        assert (geometry and geometry["type"]) == kind
