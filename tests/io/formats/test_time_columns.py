"""The time of a table's rows: one rule for IMU, fixes and stamps files, held against stamps that are known."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lslam.core.errors import InputError
from lslam.io.formats.stamped_csv import read_gnss_csv, read_imu_csv
from lslam.io.formats.text_tables import date_to_ns
from lslam.io.formats.time_columns import read_stamps, read_times

NS = 1_700_000_000_950_000_007 + np.arange(30) * 97_000_000
STAMPS = NS.tolist()
IMU = "accel_x,accel_y,accel_z,gyro_x,gyro_y,gyro_z"
ROS_IMU = ",".join(f"field.{kind}.{a}" for kind in ("linear_acceleration", "angular_velocity") for a in "xyz")
Clock = Callable[[int, int], str]

# Names of the columns of time, and their cells by row and stamp.
CLOCKS: dict[str, Clock] = {
    "sec,nanosec": lambda k, t: f"{t // 10**9},{t % 10**9}",
    "#sec,nsec": lambda k, t: f"{t // 10**9},{t % 10**9}",
    "secs,nsecs": lambda k, t: f"{t // 10**9},{t % 10**9}",
    "header.stamp.sec,header.stamp.nanosec": lambda k, t: f"{t // 10**9},{t % 10**9}",
    "time,remainder": lambda k, t: f"{t // 10**9},{t % 10**9}",
    "index,stamp_ns": lambda k, t: f"{k},{t}",
    "t,timestamp": lambda k, t: f"{k},{t // 10**9}.{t % 10**9:09d}",
    "%time,field.header.stamp": lambda k, t: f"{t + 5_000_000},{t}",
    ",time": lambda k, t: f"{k},{np.datetime64(t, 'ns')}",
    "frame,timestamp": lambda k, t: f"{10 * k},{t}",
    "date,time": lambda k, t: f"{np.datetime64(t, 'ns')}".replace("T", ","),
    "sec,fraction": lambda k, t: f"{t // 10**9},0.{t % 10**9:09d}",
}


@pytest.mark.parametrize("names", CLOCKS)
def test_imu_and_fixes_have_the_time_of_the_table(names: str, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    for columns in (IMU, ROS_IMU, "accX,accY,accZ,gyrX,gyrY,gyrZ", "acc_x,acc_y,acc_z,gyr_x,gyr_y,gyr_z"):
        path.write_text(
            "\n".join([f"{names},{columns}", *(f"{CLOCKS[names](k, t)},1,2,{k},4,5,6" for k, t in enumerate(STAMPS))])
        )
        imu = read_imu_csv(path)
        assert imu.stamps_ns.tolist() == STAMPS
        assert imu.accel[7].tolist() == [1, 2, 7]
        assert imu.gyro[7].tolist() == [4, 5, 6]
    for columns in ("lat,lon,alt", "lat,lon,h", "/fix/latitude,/fix/longitude,/fix/altitude"):
        path.write_text(
            "\n".join([f"{names},{columns}", *(f"{CLOCKS[names](k, t)},49,8.5,{k}" for k, t in enumerate(STAMPS))])
        )
        fixes = read_gnss_csv(path)
        assert fixes.stamps_ns.tolist() == STAMPS
        assert fixes.lat_lon_alt[7].tolist() == [49, 8.5, 7]


@pytest.mark.parametrize("names", CLOCKS)
@pytest.mark.parametrize("more", ["", ",exposure"])
def test_stamps_files_have_the_time_of_the_table(names: str, more: str, tmp_path: Path) -> None:
    rows = [CLOCKS[names](k, t) + (",7" if more else "") for k, t in enumerate(STAMPS)]
    (tmp_path / "stamps.csv").write_text("\n".join([names + more, *rows]))
    assert read_stamps(tmp_path / "stamps.csv").tolist() == STAMPS


@pytest.mark.parametrize(
    "row",
    [
        lambda k, t: f"{t // 10**9} {t % 10**9}",
        lambda k, t: f"{t // 10**9} {t % 10**9} scan_{k}.pcd",
        lambda k, t: f"{k} {t // 10**9}.{t % 10**9:09d}",
        lambda k, t: f"{k},{t}",
        lambda k, t: f"{10 * k} {t}",
        lambda k, t: f"{5 * k + 100},{t // 10**9},{t % 10**9}",
        lambda k, t: f"{t // 10**9},0.{t % 10**9:09d}",
        lambda k, t: f"{np.datetime64(t, 'ns')}".replace("T", ",").replace("-", "/"),
        lambda k, t: f"{k + k // 7} {t // 10**9}.{t % 10**9:09d}",
        lambda k, t: f"scan_{k}.pcd,{t}",
        lambda k, t: f"scan_{k}.pcd {t // 10**9} {t % 10**9}",
        lambda k, t: f"{k} {t // 10**9} {t % 10**9}",
        lambda k, t: f"{t // 10**9}.{t % 10**9:09d} {k}",
        lambda k, t: f"{np.datetime64(t, 'ns')}Z {k}",
        lambda k, t: f"{t // 10**9},{t % 10**9:09d}; {k}",
    ],
)
def test_stamps_files_without_names(row: Clock, tmp_path: Path) -> None:
    (tmp_path / "stamps.txt").write_text("\n".join(row(k, t) for k, t in enumerate(STAMPS)))
    assert read_times(tmp_path / "stamps.txt").tolist() == STAMPS


def test_one_hertz_is_no_index_and_a_second_column_of_something_else_no_fraction(tmp_path: Path) -> None:
    (tmp_path / "stamps.txt").write_text("\n".join(f"{1_700_000_000 + k} {k % 3}" for k in range(9)))
    assert read_stamps(tmp_path / "stamps.txt").tolist() == [(1_700_000_000 + k) * 10**9 for k in range(9)]
    (tmp_path / "imu.csv").write_text(f"sec,nsec,{IMU}\n" + "".join(f"{k * 0.5},0,0,0,9.8,0,0,0\n" for k in range(9)))
    assert read_imu_csv(tmp_path / "imu.csv").stamps_ns.tolist() == [k * 500_000_000 for k in range(9)]


@pytest.mark.parametrize("unit", [10**3, 10**6])
def test_us_and_ms_without_names_beside_seconds_that_repeat(unit: int, tmp_path: Path) -> None:
    path = tmp_path / "times.txt"
    path.write_text("\n".join(f"{t // 10**9} {t % 10**9 // unit}" for t in STAMPS))
    assert read_stamps(path).tolist() == [t // unit * unit for t in STAMPS]


def test_whole_seconds_say_that_the_column_beside_them_is_not_read(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "times.txt"
    path.write_text("\n".join(f"{1_700_000_000 + k} {450_000 + 7 * k % 5}" for k in range(9)))
    assert read_stamps(path).tolist() == [(1_700_000_000 + k) * 10**9 for k in range(9)]
    assert "column 2 beside them is not read" in caplog.text
    path.write_text("\n".join(f"{1_700_000_000 + k} {450_000_000 + 7 * k % 5}" for k in range(2)))
    assert read_stamps(path).tolist() == [1_700_000_000_450_000_000, 1_700_000_001_450_000_002]


def test_a_row_without_its_fraction_is_named(tmp_path: Path) -> None:
    (tmp_path / "stamps.csv").write_text("#sec,nsec\n7,100000000\n7\n8,1\n" + "".join(f"{k},5\n" for k in range(9, 30)))
    with pytest.raises(InputError, match=r"stamps\.csv, line 3: '' is no time"):
        read_stamps(tmp_path / "stamps.csv")


def test_fractions_alone_are_no_time(tmp_path: Path) -> None:
    """They increase within a second; a cell of the seconds that is no number leaves the other clock."""
    rows = [f"{7 + k * 0.1:.1f},{'x' if k == 4 else 7},{k * 100_000_000}" for k in range(9)]
    (tmp_path / "stamps.csv").write_text("\n".join(["%time,header.stamp.sec,header.stamp.nanosec", *rows]))
    assert read_stamps(tmp_path / "stamps.csv").tolist() == [7 * 10**9 + k * 100_000_000 for k in range(9)]


def test_a_cell_that_is_no_time_is_named(tmp_path: Path) -> None:
    (tmp_path / "imu.csv").write_text(f"sec,nsec,{IMU}\n1,0,0,0,9.8,0,0,0\n1,later,0,0,9.8,0,0,0\n")
    with pytest.raises(InputError, match=r"imu\.csv, line 3: .*'later'|imu\.csv, line 3: '1,later"):
        read_imu_csv(tmp_path / "imu.csv")


@pytest.mark.parametrize(
    ("text", "ns"),
    [
        ("2023-11-14T22:13:20Z", 1_700_000_000 * 10**9),
        ("2023-11-15 00:13:20.5+02:00", 1_700_000_000_500_000_000),
        ("2023-11-14T17:13:20-0500", 1_700_000_000 * 10**9),
        ("noon", None),
    ],
)
def test_dates(text: str, ns: int | None) -> None:
    assert date_to_ns(text) == ns
