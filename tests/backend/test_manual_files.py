"""Pairs and control points that a person writes: what is read, and what is said of what cannot be."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lslam.backend.manual import read_control_points, read_named_pairs
from lslam.core.errors import InputError

PAIRS = "scan_a,scan_b,verdict\n"
POINTS = "scan,x,y,z,sigma,crs\n"
CRS = "EPSG:25832"


def written(folder: Path, text: str) -> Path:
    path = folder / "table.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_run_s_own_table_is_read_with_its_verdicts_passed_over(tmp_path: Path) -> None:
    text = (
        "keyframe_a,keyframe_b,scan_a,scan_b,verdict,reason\n0,42,0,84,forbidden,\n0,43,0,86,rejected,thinned\n"
        '1,44,2,88,Known,"overlap, low"\n'
    )
    pairs = read_named_pairs(written(tmp_path, text))
    assert [(p.first.scan, p.second.scan, p.verdict) for p in pairs] == [(0, 84, "forbidden"), (2, 88, "known")]
    assert pairs[1].first.source == "table.csv, line 4"


def test_stamps_are_exact_and_places_optional(tmp_path: Path) -> None:
    (pair,) = read_named_pairs(
        written(
            tmp_path, "stamp_a,stamp_b,verdict,x_m,y_m,within_m\n1317042272.349659964,1317042299.1,known,2.5,-1,4\n"
        )
    )
    assert pair.first.stamp_ns == 1317042272349659964
    assert pair.place.tolist() == [2.5, -1.0]
    assert pair.within == 4.0


def test_a_german_table_of_control_points(tmp_path: Path) -> None:
    text = "stamp;Easting;Northing;Height;sigma;sigma_z;CRS;lidar_x;lidar_y;lidar_z\n" + (
        f"12.5;457799.014;5428861.26;115.006;0.01;0.02;{CRS};1;2;-1.5\n"
    )
    (point,) = read_control_points(written(tmp_path, text))
    assert (point.at.stamp_ns, point.epsg) == (12_500_000_000, 25832)
    np.testing.assert_array_equal(point.position, [457799.014, 5428861.26, 115.006])
    np.testing.assert_array_equal(point.sigma, [0.01, 0.01, 0.02])
    np.testing.assert_array_equal(point.point_lidar, [1.0, 2.0, -1.5])


@pytest.mark.parametrize("separator", [";", "\t", " "])
def test_decimal_commas_of_control_points(separator: str, tmp_path: Path) -> None:
    rows = ("scan x y z sigma crs", f"12 457799,014 5428861,26 115,006 0,01 {CRS}")
    (point,) = read_control_points(written(tmp_path, "\n".join(row.replace(" ", separator) for row in rows)))
    np.testing.assert_array_equal(point.position, [457799.014, 5428861.26, 115.006])
    np.testing.assert_array_equal(point.sigma, [0.01, 0.01, 0.01])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is empty"),
        ("a,b\n1,2\n", "line 1: no column scan_a or stamp_a"),
        (PAIRS, "names no pair"),
        (PAIRS + "1,2,accepted\n", "names no pair"),
        (PAIRS + "1,2,know\n", "line 2: verdict 'know'.*known"),
        (PAIRS + "-1,2,known\n", "line 2: scan_a = '-1'"),
        (PAIRS + "\n1,,known\n", "line 3: scan_b or stamp_b is empty"),
        (PAIRS + "1,2,known,7\n", "line 2: 4 columns where the header has 3"),
        ("scan_a,scan_b,verdict,within_m\n1,2,known,0\n", "line 2: within_m = 0 must be above 0"),
        ("stamp_a,stamp_b,verdict\n1,nan,known\n", "line 2: 'nan' is no time"),
    ],
)
def test_what_is_wrong_with_pairs_is_said_with_its_line(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        read_named_pairs(written(tmp_path, text))


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("1,2,3,4,0.01,25832", "crs = '25832': EPSG and a number"),
        ("1,2,3,4,0.01,EPSG:99999", "crs EPSG:99999: PROJ knows no such"),
        ("1,2,3,4,,EPSG:25832", "sigma is empty"),
        ("1,2,3,4,-1,EPSG:25832", "sigma = -1 must be above 0"),
        ("1,2,,4,1,EPSG:25832", "y or northing or .* is empty"),
        ("1,2,inf,4,1,EPSG:25832", "y = 'inf' is no number"),
        ("x,2,3,4,1,EPSG:25832", "scan = 'x'"),
    ],
)
def test_what_is_wrong_with_control_points_is_said_with_its_line(tmp_path: Path, row: str, said: str) -> None:
    with pytest.raises(InputError, match=f"line 2: {said}"):
        read_control_points(written(tmp_path, POINTS + row + "\n"))


def test_comments_are_passed_over_and_a_header_may_be_one(tmp_path: Path) -> None:
    text = "# pairs of mine\n# scan_a, scan_b, verdict\n# the corner\n0,84,known\n"
    (pair,) = read_named_pairs(written(tmp_path, text))
    assert (pair.first.scan, pair.second.scan) == (0, 84)
    with pytest.raises(InputError, match="stands there twice"):
        read_named_pairs(written(tmp_path, "scan_a,scan_b,scan_a,verdict\n1,2,3,known\n"))


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.csv cannot be read"):
        read_control_points(tmp_path / "none.csv")
