"""Heights: none is written beside a vertical datum that it does not count from."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import laspy
import numpy as np
import pytest
from numpy.typing import NDArray
from pyproj import CRS, Transformer

from lslam.core.errors import UsageError
from lslam.core.geometry import se3, so3
from lslam.core.geometry.geodesy import geoid_heights, local_crs
from lslam.core.types.cloud import ArrayCloud
from lslam.core.types.gnss import Georeference
from lslam.maps.georeference import Projection, to_wgs84
from lslam.pipeline.map_files import MapNote, georeference_note, georeference_of, write_map
from lslam.pipeline.stored_map import map_of
from tests.maps.geoid_grids import write_gtx

KARLSRUHE = np.array([49.0113, 8.4256, 116.4])
# m; of a grid with 46 m at 48 deg and 2 m more for each degree, at Karlsruhe.
UNDULATION = 46.0 + 2.0 * 1.0113


def reference(epsg: int | None, height_epsg: int | None = None, geoid: str = "") -> Georeference:
    T = se3.make(so3.exp(np.array([0.02, -0.01, 2.1])), np.array([12.0, -7.0, 1.5]))
    return Georeference(KARLSRUHE, T, epsg, height_epsg=height_epsg, geoid=geoid)


@pytest.fixture
def grid(tmp_path: Path) -> str:
    folder = tmp_path / "grids of others"
    folder.mkdir()
    return str(write_gtx(folder / "geoid.gtx", 46.0, 2.0))


def test_heights_without_an_exact_operation_are_refused() -> None:
    with pytest.raises(
        UsageError,
        match=r"EPSG:25832\+7837: PROJ lacks the grid de_bkg_gcg2016.tif: .*pyproj sync --file.*PROJ_NETWORK=ON.*--geoid",
    ):
        Projection(reference(25832, 7837)).check()
    # PROJ has nothing but a ballpark operation, which leaves z as it is.
    with pytest.raises(UsageError, match=r"EPSG:5555: PROJ knows no exact operation .*--geoid"):
        Projection(reference(5555)).check()
    for codes in ((5555, None), (25832, 7837)):
        with pytest.raises(UsageError, match="--geoid"):
            to_wgs84(np.array([[457996.0, 5428870.0, 70.0]]), *codes)
    with pytest.raises(UsageError, match=r"EPSG:25832\+4326: PROJ knows no such"):
        Projection(reference(25832, 4326)).check()


def test_a_plane_of_another_place_and_a_geoid_beside_ellipsoidal_heights_are_refused(grid: str) -> None:
    """Neither is a matter of a missing grid, and the sentence says which it is."""
    with pytest.raises(UsageError, match=r"EPSG:28992: PROJ knows no operation at 49.01, 8.43 deg") as far:
        Projection(reference(28992)).check()
    assert "--geoid" not in str(far.value)
    Projection(reference(32632, 4979)).check()
    with pytest.raises(UsageError, match=r"EPSG:32632\+4979 count from the ellipsoid"):
        Projection(reference(32632, 4979, grid)).check()


@pytest.mark.parametrize("codes", [(25832, None), (5555, None), (25832, 7837)])
def test_a_geoid_gives_the_heights(codes: tuple[int, int | None], grid: str, tmp_path: Path) -> None:
    points = np.random.default_rng(4).uniform(-800, 800, (500, 3))
    g = reference(*codes, geoid=grid)
    projection = Projection(g)
    projection.check()
    plain = Projection(reference(25832)).apply(points)
    lat = to_wgs84(plain, 25832)[:, 0]
    expected = plain - np.column_stack([np.zeros((500, 2)), 46.0 + 2.0 * (lat - 48.0)])
    np.testing.assert_allclose(projection.apply(points), expected, atol=1e-4)
    np.testing.assert_allclose(projection.invert(projection.apply(points)), points, atol=1e-6)
    np.testing.assert_allclose(to_wgs84(expected, *codes, geoid=grid), to_wgs84(plain, 25832), atol=1e-4, rtol=1e-12)
    write_map(tmp_path / "map.laz", ArrayCloud.of(points), MapNote("somewhere", 0.2), g)
    np.testing.assert_allclose(laspy.read(tmp_path / "map.laz").xyz, expected, atol=0.001)
    about = json.loads((tmp_path / "map.json").read_text())
    assert about["frame"].endswith("heights above the geoid of geoid.gtx")
    assert about["georeference"]["geoid"] == grid
    np.testing.assert_allclose(map_of(tmp_path / "map.laz").read().points, points, atol=0.002)


def test_a_plane_without_heights_says_none(tmp_path: Path) -> None:
    write_map(tmp_path / "map.laz", ArrayCloud.of(np.zeros((3, 3))), MapNote("x", 0.2), reference(25832))
    assert json.loads((tmp_path / "map.json").read_text())["frame"] == "EPSG:25832, heights above the WGS84 ellipsoid"
    vlr = laspy.read(tmp_path / "map.laz").header.vlrs.get("WktCoordinateSystemVlr")[0]
    assert not CRS.from_wkt(vlr.string).is_compound


BY_PROJ = """
import sys, numpy as np
from lslam.maps.georeference import Projection, to_wgs84
from lslam.core.types.gnss import Georeference
import pyproj
pyproj.datadir.append_data_dir(sys.argv[1])
p = Projection(Georeference(np.array([49.0113, 8.4256, 116.4]), np.eye(4), 32632, height_epsg=5773))
p.check()
assert p.wkt.startswith("COMPD_CS"), p.wkt
at = p.apply(np.zeros((1, 3)))
print(at[0, 2], np.abs(p.invert(at)).max(), to_wgs84(at, 32632, 5773)[0, 2], p.frame)
"""


def test_proj_gives_the_heights_where_it_has_the_grid(tmp_path: Path) -> None:
    """PROJ knows this grid by its older name, too."""
    write_gtx(tmp_path / "egm96_15.gtx", 46.0, 2.0)
    done = subprocess.run([sys.executable, "-c", BY_PROJ, str(tmp_path)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    height, apart, ellipsoidal, frame = done.stdout.split(maxsplit=3)
    assert float(height) == pytest.approx(116.4 - UNDULATION, abs=1e-4)
    assert float(ellipsoidal) == pytest.approx(116.4, abs=1e-4)
    assert float(apart) < 1e-3
    assert frame.strip() == "EPSG:32632+5773, EGM96 height"


def test_grids_that_will_not_do(tmp_path: Path, grid: str) -> None:
    (tmp_path / "words.gtx").write_text("no grid")
    for name in ("words.gtx", "none.tif"):
        with pytest.raises(UsageError, match="PROJ cannot read it"):
            geoid_heights(str(tmp_path / name), KARLSRUHE[None, :2])
    with pytest.raises(UsageError, match=r"has no height at 60.0000, 8.4256 deg: it is a grid of another place"):
        geoid_heights(grid, np.array([[49.0, 8.4256], [60.0, 8.4256]]))
    assert geoid_heights(grid, KARLSRUHE[None, :2]) == pytest.approx(UNDULATION, abs=1e-4)


def test_a_coarser_operation_of_a_plane_is_refused() -> None:
    """Maps, and control points in its coordinates alike; a plane whose best operation is there is not."""
    said = (
        r"EPSG:31467: PROJ lacks the grid de_adv_BETA2007.tif, without which it is accurate to 3 m: get it by .* or choose a "
        "plane that needs none"
    )
    with pytest.raises(UsageError, match=said):
        Projection(reference(31467)).check()
    with pytest.raises(UsageError, match=said):
        to_wgs84(np.array([[3457853.0, 5429990.0, 116.4]]), 31467)
    Projection(reference(5683)).check()


@pytest.mark.parametrize("epsg", [25832, 32632, 3035, 5683])
def test_planes_are_as_proj_has_them(epsg: int) -> None:
    points: NDArray[np.float64] = np.random.default_rng(1).uniform(-500, 500, (50, 3))
    g = Georeference(KARLSRUHE, np.eye(4), epsg)
    x, y = Transformer.from_crs(local_crs(KARLSRUHE), epsg, always_xy=True).transform(points[:, 0], points[:, 1])
    np.testing.assert_array_equal(Projection(g).apply(points), np.column_stack([x, y, points[:, 2] + 116.4]))


def test_a_note_keeps_what_heights_count_from() -> None:
    for g in (reference(25832), reference(25832, 7837, "PROJ's own.tif")):
        back = georeference_of(georeference_note(g))
        assert back is not None
        assert (back.epsg, back.height_epsg, back.geoid) == (g.epsg, g.height_epsg, g.geoid)
