"""Map files: written block by block, read back, and read by others."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from datetime import date
from pathlib import Path
from typing import Any, ClassVar

import laspy
import numpy as np
import pytest

from lslam.core.errors import InputError, OutputError, UsageError
from lslam.core.extras import importing_open3d
from lslam.core.types import cloud as cloud_module
from lslam.core.types.cloud import ArrayCloud, CloudBlock, bounds, in_memory
from lslam.io.formats.las_files import read_las
from lslam.io.formats.pcd_files import pcd_columns
from lslam.io.formats.ply_files import ply_columns
from lslam.io.formats.point_files import MAP_SUFFIXES, read_cloud, write_cloud


def make(count: int = 1000, offset: float = 0.0, brightest: float = 1.0) -> ArrayCloud:
    rng = np.random.default_rng(count)
    points = rng.uniform(-120, 120, (count, 3)) + np.array([offset, 10 * offset, 0])
    return ArrayCloud.of(points, np.linspace(0, brightest, count))


@pytest.mark.parametrize("suffix", MAP_SUFFIXES)
@pytest.mark.parametrize("count", [0, 1, 1000])
def test_written_and_read_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str, count: int) -> None:
    monkeypatch.setattr(cloud_module, "BLOCK", 300)
    made = make(count)
    path = tmp_path / f"map{suffix}"
    write_cloud(path, made)
    back = read_cloud(path)
    assert len(back) == count
    np.testing.assert_allclose(back.points, made.points, atol=0.00051 if "la" in suffix else 1e-5)
    assert back.intensity is not None
    assert made.intensity is not None
    scale = 65535 if "la" in suffix else 1
    np.testing.assert_allclose(back.intensity, made.intensity * scale, atol=0.51 if "la" in suffix else 0)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", MAP_SUFFIXES)
def test_blocks_do_not_show_in_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str) -> None:
    digests = set()
    # lazrs compresses chunks of 50,000 points, so what is handed over in pieces must still come out the same.
    made = make(70_000)
    for block in (1 << 18, 999):
        monkeypatch.setattr(cloud_module, "BLOCK", block)
        write_cloud(tmp_path / f"map{suffix}", made)
        digests.add(hashlib.sha256((tmp_path / f"map{suffix}").read_bytes()).hexdigest())
    assert len(digests) == 1


def test_no_intensity_is_no_field(tmp_path: Path) -> None:
    made = ArrayCloud.of(make(10).points)
    for suffix in (".ply", ".pcd"):
        write_cloud(tmp_path / f"map{suffix}", made)
        assert read_cloud(tmp_path / f"map{suffix}").intensity is None


def test_las_is_what_laspy_and_gis_expect(tmp_path: Path) -> None:
    made = make(500, offset=456_789.0)
    wkt = 'PROJCS["anything"]'
    write_cloud(tmp_path / "map.las", made, wkt=wkt)
    data = laspy.read(tmp_path / "map.las")
    header = data.header
    assert (str(header.version), header.point_format.id, header.point_count) == ("1.4", 6, 500)
    assert header.scales.tolist() == [0.001] * 3
    assert header.offsets.tolist() == np.floor(made.points.min(0)).tolist()
    np.testing.assert_allclose(header.mins, made.points.min(0), atol=0.00051)
    np.testing.assert_allclose(header.maxs, made.points.max(0), atol=0.00051)
    assert header.global_encoding.wkt
    # What CloudCompare offers as scalar fields: the standard ones alone, of which a map has intensity.
    assert list(header.point_format.dimension_names) == list(laspy.PointFormat(6).dimension_names)
    assert {name for name in header.point_format.standard_dimension_names if np.any(data[name])} == {
        "X", "Y", "Z", "intensity", "return_number", "number_of_returns",
    }  # fmt: skip
    assert made.intensity is not None
    np.testing.assert_allclose(data.intensity, made.intensity * 65535, atol=0.51)
    assert read_las(tmp_path / "map.las")[1] == wkt
    np.testing.assert_allclose(data.xyz, made.points, atol=0.00051)


@pytest.mark.parametrize(("brightest", "largest"), [(1.0, 65535), (255.0, 65535), (4000.0, 4000), (1e6, 65535)])
def test_intensities_are_spread_over_16_bits(tmp_path: Path, brightest: float, largest: int) -> None:
    write_cloud(tmp_path / "map.laz", make(100, brightest=brightest))
    intensity = laspy.read(tmp_path / "map.laz").intensity
    assert intensity.max() == largest
    assert intensity.min() == 0


def test_the_same_cloud_gives_the_same_bytes_on_any_day(tmp_path: Path) -> None:
    write_cloud(tmp_path / "a.laz", make(100))
    assert laspy.open(tmp_path / "a.laz").header.creation_date == date(1970, 1, 1)


def test_what_is_no_map_file(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"known suffixes: \.ply, \.pcd, \.las, \.laz"):
        write_cloud(tmp_path / "map.xyz", make(3))
    with pytest.raises(InputError, match=r"map\.las cannot be read: No such file"):
        read_cloud(tmp_path / "map.las")
    write_cloud(tmp_path / "map.laz", make(5000))
    whole = (tmp_path / "map.laz").read_bytes()
    for kept in (0, 50, 400, len(whole) // 2):
        (tmp_path / "half.laz").write_bytes(whole[:kept])
        with pytest.raises(InputError, match=r"half\.laz cannot be read as LAS"):
            read_cloud(tmp_path / "half.laz")


def test_what_cannot_be_written(tmp_path: Path) -> None:
    for suffix in MAP_SUFFIXES:
        with pytest.raises(OutputError, match=f"map{suffix} cannot be written"):
            write_cloud(tmp_path / "absent" / f"map{suffix}", make(3))
    wide = ArrayCloud.of([[0, 0, 0], [3e6, 0, 0]])
    with pytest.raises(OutputError, match="wider than LAS can hold"):
        write_cloud(tmp_path / "map.las", wide)


def test_clouds_of_blocks() -> None:
    class Two:
        has_intensity = False
        column_types: ClassVar[dict[str, np.dtype[Any]]] = {}

        def __len__(self) -> int:
            return 3

        def blocks(self) -> Iterator[CloudBlock]:
            yield CloudBlock(np.array([[0.0, 1, 2], [np.nan, 0, 0]]))
            yield CloudBlock(np.array([[-1.0, 5, 1]]))

    assert in_memory(Two()).points.shape == (3, 3)
    assert [b.tolist() for b in bounds(Two())] == [[-1, 1, 1], [0, 5, 2]]
    assert np.isnan(bounds(ArrayCloud.of([]))[0]).all()
    assert len(in_memory(ArrayCloud.of([], []))) == 0


def test_further_columns_are_written_in_every_format(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    colours = rng.integers(0, 256, (3, 500)).astype(np.uint8)
    columns = {
        "red": colours[0],
        "green": colours[1],
        "blue": colours[2],
        "views": rng.integers(0, 9, 500).astype(np.uint16),
    }
    cloud = ArrayCloud(rng.uniform(-9, 9, (500, 3)), rng.random(500).astype(np.float32), columns)
    for suffix in ("ply", "pcd", "las", "laz"):
        write_cloud(tmp_path / f"a.{suffix}", cloud)
        np.testing.assert_allclose(read_cloud(tmp_path / f"a.{suffix}").points, cloud.points, atol=0.001)
    ply, pcd = ply_columns(tmp_path / "a.ply"), pcd_columns(tmp_path / "a.pcd")
    assert list(ply) == ["x", "y", "z", "intensity", "red", "green", "blue", "views"]
    for name, values in columns.items():
        assert ply[name].dtype == values.dtype
        assert (ply[name] == values).all()
    # PCL: the bytes blue, green, red of a float32.
    packed = np.ascontiguousarray(pcd["rgb"]).view(np.uint8).reshape(-1, 4)
    assert (colours[::-1] == packed[:, :3].T).all()
    assert (pcd["views"] == columns["views"]).all()
    for suffix in ("las", "laz"):
        las = laspy.read(tmp_path / f"a.{suffix}")
        assert las.header.point_format.id == 7
        assert (np.stack([las.red, las.green, las.blue]) == 257 * colours.astype(int)).all()
    with importing_open3d():
        import open3d
    for suffix in ("ply", "pcd"):
        seen = open3d.io.read_point_cloud(str(tmp_path / f"a.{suffix}"))
        np.testing.assert_allclose(255 * np.asarray(seen.colors), colours.T, atol=1e-3)
