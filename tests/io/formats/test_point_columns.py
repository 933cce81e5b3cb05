"""Columns beside the points of a map file, read back by other programs' rules."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import laspy
import numpy as np
import pytest

from lslam.core.labels import CLASSES
from lslam.core.types.cloud import ArrayCloud, in_memory
from lslam.io.formats.las_files import gps_time_s
from lslam.io.formats.pcd_files import pcd_columns
from lslam.io.formats.ply_files import ply_columns
from lslam.io.formats.point_files import read_points, write_cloud

BEGIN_NS = 1_700_000_000_123_456_789
COUNT = 500


def cloud(begin_ns: int = BEGIN_NS, last_scan: int = 94) -> ArrayCloud:
    rng = np.random.default_rng(6)
    columns = {
        "time_ns": begin_ns + np.sort(rng.integers(0, 10**10, COUNT)),
        "scan": np.linspace(0, last_scan, COUNT).astype(np.uint16 if last_scan < 2**16 else np.uint32),
        "ring": rng.integers(0, 64, COUNT).astype(np.uint16),
        "range": rng.uniform(2, 80, COUNT).astype(np.float32),
        "observations": rng.integers(1, 70_000, COUNT).astype(np.uint32),
        "class": rng.choice([0, 10, 40, 50, 70, 72, 81, 252], COUNT).astype(np.uint16),
        "red": rng.integers(0, 256, COUNT).astype(np.uint8),
        "green": rng.integers(0, 256, COUNT).astype(np.uint8),
        "blue": rng.integers(0, 256, COUNT).astype(np.uint8),
    }
    return ArrayCloud(rng.uniform(-50, 50, (COUNT, 3)), rng.random(COUNT).astype(np.float32), columns)


@pytest.mark.parametrize("suffix", ["ply", "pcd"])
def test_ply_and_pcd_hold_every_column_in_its_type(suffix: str, tmp_path: Path) -> None:
    path, whole = tmp_path / f"a.{suffix}", cloud()
    write_cloud(path, whole)
    read = ply_columns(path) if suffix == "ply" else pcd_columns(path)
    if suffix == "pcd":  # the Point Cloud Library has blue, green, red and nothing in the bytes of one float
        shades = np.ascontiguousarray(read.pop("rgb")).view(np.uint8).reshape(-1, 4)[:, :3]
        read |= dict(zip(("blue", "green", "red"), shades.T, strict=True))
    assert set(read) == {"x", "y", "z", "intensity", "time", *list(whole.columns)[1:]}
    assert np.abs(read["time"] - 1e-9 * whole.columns["time_ns"]).max() < 1e-6
    for name in list(whole.columns)[1:]:
        assert read[name].dtype == whole.columns[name].dtype, name
        np.testing.assert_array_equal(read[name], whole.columns[name], name)
    points = read_points(path)
    assert points.labels is not None
    np.testing.assert_array_equal(points.labels, whole.columns["class"])


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_las_has_the_columns_in_its_own_fields(suffix: str, tmp_path: Path) -> None:
    path, whole = tmp_path / f"a.{suffix}", cloud()
    write_cloud(path, whole)
    read, columns = laspy.read(path), whole.columns
    assert read.header.point_format.id == 7
    assert read.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
    assert [d.name for d in read.point_format.extra_dimensions] == ["ring", "range", "observations", "class"]
    # 18 leap seconds lie between UTC and GPS since 2017; datetime knows none.
    gps = [datetime(1980, 1, 6, tzinfo=UTC) + timedelta(seconds=float(t) + 1e9 - 18) for t in read.gps_time]
    utc = [datetime.fromtimestamp(ns / 1e9, UTC) for ns in columns["time_ns"].tolist()]
    assert max(abs((a - b).total_seconds()) for a, b in zip(gps, utc, strict=True)) < 2e-6
    np.testing.assert_array_equal(read.point_source_id, columns["scan"])
    for name in ("ring", "range", "observations", "class"):
        np.testing.assert_array_equal(read[name], columns[name], name)
    np.testing.assert_array_equal(read.red, columns["red"] * np.uint16(257))
    groups = {"unlabeled": 0, "car": 1, "road": 2, "building": 6, "vegetation": 5, "terrain": 2, "moving-car": 64}
    for name, number in groups.items():
        assert set(np.array(read.classification)[columns["class"] == CLASSES[name]]) == {number}, name


def test_numbers_of_scans_beyond_16_bits_have_a_dimension_of_their_own(tmp_path: Path) -> None:
    path, whole = tmp_path / "a.laz", cloud(last_scan=70_000)
    write_cloud(path, whole)
    read, scans = laspy.read(path), whole.columns["scan"]
    np.testing.assert_array_equal(read["scan"], scans)
    np.testing.assert_array_equal(read.point_source_id, np.where(scans < 2**16, scans, 0))


def test_a_clock_without_an_epoch_is_no_gps_time(tmp_path: Path) -> None:
    path, whole = tmp_path / "a.laz", cloud(begin_ns=0)
    write_cloud(path, whole)
    read = laspy.read(path)
    assert read.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.WEEK_TIME
    np.testing.assert_allclose(read.gps_time, 1e-9 * whole.columns["time_ns"], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("utc", "ahead_s"),
    [
        ("2001-09-09T01:46:40", 13),
        ("2012-06-30T23:59:59", 15),
        ("2012-07-01T00:00:00", 16),
        ("2026-11-29T00:00:00", 18),
    ],
)
def test_gps_is_ahead_of_utc_by_the_leap_seconds_of_its_day(utc: str, ahead_s: int) -> None:
    """IERS Bulletin C: TAI - UTC less the 19 s of GPS."""
    when = datetime.fromisoformat(utc).replace(tzinfo=UTC)
    elapsed = (when - datetime(1980, 1, 6, tzinfo=UTC)).total_seconds()
    (there,) = gps_time_s(np.array([int(when.timestamp()) * 10**9]), True)
    assert there == elapsed + ahead_s - 1e9


def test_blocks_and_selections_keep_the_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lslam.core.types.cloud.BLOCK", 64)
    whole = cloud()
    some = whole.select(np.array([3, 7]))
    for name, values in whole.columns.items():
        np.testing.assert_array_equal(np.concatenate([b.columns[name] for b in whole.blocks()]), values, name)
        np.testing.assert_array_equal(some.columns[name], values[[3, 7]], name)
    assert in_memory(some) is some
