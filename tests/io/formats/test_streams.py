"""Stamps, IMU, GNSS, OXTS and MCD files."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lslam.core.errors import InputError
from lslam.core.types.gnss import GnssStream
from lslam.core.types.imu import ImuStream
from lslam.io.formats.kitti_layout import POS_ACC, read_mcd_extrinsics, read_oxts
from lslam.io.formats.stamped_csv import read_gnss_csv, read_imu_csv, write_gnss_csv, write_imu_csv
from lslam.io.formats.time_columns import read_stamps


def stamp_of(text: str, folder: Path) -> int:
    (folder / "stamps.txt").write_text(f"{text}\n")
    (stamp,) = read_stamps(folder / "stamps.txt").tolist()
    return int(stamp)


@given(st.integers(0, 4 * 10**18))
def test_seconds_with_nine_digits_are_exact(ns: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        assert stamp_of(f"{ns // 10**9}.{ns % 10**9:09d}", Path(folder)) == ns


@pytest.mark.parametrize(
    ("text", "ns"),
    [
        ("2011-09-26 13:04:32.349659964", 1317042272349659964),
        ("2011-09-26T13:04:32.5", 1317042272500000000),
        ("1.036224e-01", 103622400),
        ("0", 0),
        ("1317042272349659964", 1317042272349659964),
        ("12", 12 * 10**9),
    ],
)
def test_notations(text: str, ns: int, tmp_path: Path) -> None:
    assert stamp_of(text, tmp_path) == ns


NO_TIMES = [
    "nan", "inf", "noon", "x", "1e30", "1e999999999", "-1e999999999", "2011-13-26 13:04:32", "9223372036854775808",
    "99999999999999999999",
]  # fmt: skip


@pytest.mark.parametrize("text", NO_TIMES)
def test_no_times(text: str, tmp_path: Path) -> None:
    (tmp_path / "stamps.txt").write_text(f"0.5\n{text}\n")
    with pytest.raises(InputError, match=r"line 2: .*(no time|out of range)"):
        read_stamps(tmp_path / "stamps.txt")


def test_stamps_file_with_header_comments_and_columns(tmp_path: Path) -> None:
    path = tmp_path / "stamps.csv"
    path.write_text("stamp,exposure\n# a comment\n0.1,7\n\n0.2,7\n")
    assert read_stamps(path).tolist() == [100_000_000, 200_000_000]
    path.write_text("0.1\n0.2\nlater\n")
    with pytest.raises(InputError, match="line 3: 'later'"):
        read_stamps(path)


def imu(n: int = 20) -> ImuStream:
    rng = np.random.default_rng(0)
    return ImuStream(10**18 + np.arange(n) * 10_000_001, rng.normal(size=(n, 3)), rng.normal(size=(n, 3)))


def test_imu_round_trip_is_exact(tmp_path: Path) -> None:
    stream = imu()
    write_imu_csv(tmp_path / "imu.csv", stream)
    back = read_imu_csv(tmp_path / "imu.csv")
    np.testing.assert_array_equal(back.stamps_ns, stream.stamps_ns)
    np.testing.assert_array_equal(back.accel, stream.accel)
    np.testing.assert_array_equal(back.gyro, stream.gyro)


def _rows(order: NDArray[np.int64]) -> ImuStream:
    stream = imu()
    return ImuStream(stream.stamps_ns[order], stream.accel[order], stream.gyro[order])


@pytest.mark.parametrize(
    "order",
    [
        np.r_[12:20, 0:12],
        np.arange(20)[::-1],
        np.repeat(np.arange(20), 2),
        np.random.default_rng(2).permutation(20),
    ],
    ids=["parts", "backwards", "twice", "shuffled"],
)
def test_rows_in_another_order_than_their_stamps_are_sorted(order: NDArray[np.int64], tmp_path: Path) -> None:
    write_imu_csv(tmp_path / "imu.csv", _rows(order))
    notes: list[str] = []
    back, expected = read_imu_csv(tmp_path / "imu.csv", notes), imu()
    assert [note for note in notes if "sorted" in note] == notes != []
    np.testing.assert_array_equal(back.stamps_ns, expected.stamps_ns)
    np.testing.assert_array_equal(back.accel, expected.accel)
    np.testing.assert_array_equal(back.gyro, expected.gyro)


def test_rows_behind_a_clock_that_was_set_back_stay_where_they_are(tmp_path: Path) -> None:
    """Sorted, one time would be told of twice."""
    stream = imu()
    stamps = stream.stamps_ns - 57_000_000 * (np.arange(20) >= 12)
    write_imu_csv(tmp_path / "imu.csv", ImuStream(stamps, stream.accel, stream.gyro))
    np.testing.assert_array_equal(read_imu_csv(tmp_path / "imu.csv").stamps_ns, stamps)


def test_euroc_imu_reads_with_its_column_order(tmp_path: Path) -> None:
    path = tmp_path / "data.csv"
    path.write_text(
        "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],"
        "a_RS_S_z [m s^-2]\n1403636579758555392,1,2,3,4,5,6\n"
    )
    back = read_imu_csv(path)
    assert back.stamps_ns.tolist() == [1403636579758555392]
    assert (back.gyro[0].tolist(), back.accel[0].tolist()) == ([1, 2, 3], [4, 5, 6])


def test_gnss_round_trip_and_unknown_sigma(tmp_path: Path) -> None:
    stream = GnssStream(np.array([1, 2]), np.array([[49.0112128, 8.4, 112.0], [49.1, 8.5, 113]]), np.array([0.4, 2.0]))
    write_gnss_csv(tmp_path / "gnss.csv", stream)
    back = read_gnss_csv(tmp_path / "gnss.csv")
    np.testing.assert_array_equal(back.lat_lon_alt, stream.lat_lon_alt)
    np.testing.assert_array_equal(back.sigma, stream.sigma)
    np.testing.assert_array_equal(back.stamps_ns, [1, 2])
    (tmp_path / "gnss.csv").write_text("t,lat,lon,alt\n0.5,49,8,100\n")
    assert np.isnan(read_gnss_csv(tmp_path / "gnss.csv").sigma[0])


@pytest.mark.parametrize("stamps", [[0, 10_000_000], [9_220_000_000, 9_230_000_000], [0, 2**62], [-5, 5]])
def test_stamps_in_ns_are_ns_however_small(stamps: list[int], tmp_path: Path) -> None:
    """Recordings that count from zero: ten seconds are 10000000000, not three hundred years."""
    write_imu_csv(tmp_path / "imu.csv", ImuStream(np.array(stamps), np.ones((2, 3)), np.zeros((2, 3))))
    assert read_imu_csv(tmp_path / "imu.csv").stamps_ns.tolist() == stamps


BAD_CSV = {
    "": "line 1: no time column",
    "accel_x,accel_y\n": "line 1: no time column",
    "t,ax,ay,az,gx,gy\n": "no column gyro_z",
    "t,ax,ay,az,gx,gy,gz\n0,1,2,3,4,5\n": "line 2: 6 columns where the header has 7",
    "t,ax,ay,az,gx,gy,gz\n0,1,2,3,4,5,6\n1,1,2,x,4,5,6\n": "line 3",
    "stamp_ns,ax,ay,az,gx,gy,gz\n0,1,2,3,4,5,6\n0.5,1,2,3,4,5,6\n": "line 3",
    "stamp_ns,ax,ay,az,gx,gy,gz\nsoon,1,2,3,4,5,6\n": "line 2",
}


@pytest.mark.parametrize("text", BAD_CSV)
def test_bad_csv_names_line(text: str, tmp_path: Path) -> None:
    path = tmp_path / "imu.csv"
    path.write_text(text)
    with pytest.raises(InputError) as error:
        read_imu_csv(path)
    assert str(path) in str(error.value)
    assert BAD_CSV[text] in str(error.value)


def oxts_folder(folder: Path, numbers: list[int], stamps: int) -> Path:
    (folder / "data").mkdir(parents=True)
    for n in numbers:
        row = np.zeros(30)
        row[0], row[POS_ACC] = 49 + n * 1e-6, 0.05
        (folder / "data" / f"{n:010d}.txt").write_text(" ".join(map(repr, row.tolist())))
    (folder / "timestamps.txt").write_text(
        "".join(f"2011-09-26 13:04:32.{k * 10_000_000:09d}\n" for k in range(stamps))
    )
    return folder


def test_oxts_goes_with_the_line_of_its_number(tmp_path: Path) -> None:
    oxts = read_oxts(oxts_folder(tmp_path, [0, 1, 3], 4))
    assert oxts is not None
    assert oxts.stamps_ns is not None
    assert (oxts.stamps_ns - oxts.stamps_ns[0]).tolist() == [0, 10_000_000, 30_000_000]
    assert len(oxts.problems) == 1
    assert "3 OXTS samples but 4 stamps" in oxts.problems[0]


def test_oxts_bad_or_missing(tmp_path: Path) -> None:
    assert read_oxts(tmp_path / "none") is None
    folder = oxts_folder(tmp_path / "oxts", [0, 1], 2)
    (folder / "data" / "0000000001.txt").write_text("1 2 3")
    with pytest.raises(InputError, match=r"0000000001\.txt is no OXTS sample: 3 numbers"):
        read_oxts(folder)
    (folder / "data" / "0000000001.txt").write_text("north")
    with pytest.raises(InputError, match="0000000001"):
        read_oxts(folder)
    (folder / "data" / "0000000001.txt").unlink()
    (folder / "timestamps.txt").unlink()
    oxts = read_oxts(folder)
    assert oxts is not None
    assert oxts.stamps_ns is None
    assert "missing" in oxts.problems[0]


def test_mcd_extrinsics(tmp_path: Path) -> None:
    path = tmp_path / "hhs_calib.yaml"
    block = (
        "body:\n    os_sensor:\n        T:\n        - [1.0, 0.0, 0.0, 0.1]\n        - [0.0, 1.0, 0.0, 0.2]\n"
        "        - [0.0, 0.0, 1.0, 0.3]\n        - [0.0, 0.0, 0.0, 1.0]\n"
    )
    path.write_text(block)
    T = read_mcd_extrinsics(path)
    assert T is not None
    assert T[:3, 3].tolist() == [0.1, 0.2, 0.3]
    assert read_mcd_extrinsics(path, "mid70") is None
    path.write_text(block.replace("[0.0, 1.0, 0.0, 0.2]", "[0.0, 1.0, oops, 0.2]"))
    with pytest.raises(InputError, match="line 2"):
        read_mcd_extrinsics(path)
    path.write_text(block.replace("[1.0, 0.0, 0.0, 0.1]", "[2.0, 0.0, 0.0, 0.1]"))
    with pytest.raises(InputError, match="no rigid"):
        read_mcd_extrinsics(path)


@pytest.mark.parametrize("stamp", ["1e999999999", "-1e999999999", "9" * 5000, "²", "1e-999999999"])
def test_stamps_no_clock_shows_are_said_or_are_nought(tmp_path: Path, stamp: str) -> None:
    (tmp_path / "times.txt").write_text(f"0.0\n{stamp}\n")
    (tmp_path / "imu.csv").write_text(f"stamp_ns,ax,ay,az,wx,wy,wz\n0,0,0,9.8,0,0,0\n{stamp},0,0,9.8,0,0,0\n")
    for read, name in ((read_stamps, "times.txt"), (read_imu_csv, "imu.csv")):
        try:
            assert stamp == "1e-999999999"
            read(tmp_path / name)
        except (AssertionError, InputError):
            with pytest.raises(InputError, match=f"{name}, line "):
                read(tmp_path / name)
