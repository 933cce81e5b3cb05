"""Stamps of scan files: by their own file, by names of any form, by absolute times of points; held against each other."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from sequence_builders import scans

from lslam.core.errors import InputError
from lslam.io.formats.point_files import read_points
from lslam.io.readers import open_sequence
from lslam.io.readers.scan_stamps import stamps_in_names

START_NS = 1_670_403_902_035_281_229
STAMPS = START_NS + np.arange(25) * 100_000_000 + np.random.default_rng(1).integers(0, 2_000_000, 25)


def iso(ns: int, form: str) -> str:
    return datetime.fromtimestamp(ns // 10**9, UTC).strftime(form) + f"{ns % 10**9:09d}"


NAMES = {
    "nanoseconds": (lambda ns: f"{ns}", 1, "nanoseconds since 1970"),
    "microseconds with a prefix": (lambda ns: f"scan_{ns // 1000}", 1_000, "microseconds since 1970"),
    "milliseconds with a suffix": (lambda ns: f"{ns // 10**6}_lidar", 10**6, "milliseconds since 1970"),
    "prefix, number of the sensor and suffix": (lambda ns: f"os1-64_{ns}_points", 1, "nanoseconds since 1970"),
    "signs that stand for numbers": (lambda ns: f"os#1_{ns}#", 1, "nanoseconds since 1970"),
    "a counter before": (lambda ns: f"{(ns - START_NS) // 10**8:06d}_{ns}", 1, "nanoseconds since 1970"),
    "sec.nanosec padded": (lambda ns: f"{ns // 10**9}.{ns % 10**9:09d}", 1, "seconds and 9 decimals"),
    "sec.nanosec unpadded": (
        lambda ns: f"{ns // 10**9}.{ns % 10**9}", 1, "seconds and nanoseconds without leading zeros"
    ),
    "sec_nanosec unpadded with a prefix": (
        lambda ns: f"cloud_{ns // 10**9}_{ns % 10**9}", 1, "seconds and nanoseconds without leading zeros"
    ),
    "seconds and microseconds unpadded": (
        lambda ns: f"{ns // 10**9}_{ns % 10**9 // 1000}", 1_000, "seconds and microseconds without leading zeros"
    ),
    "decimals without zeros at the end": (
        lambda ns: f"{ns // 10**9}.{ns % 10**9 // 1000:06d}".rstrip("0"), 1_000, "decimal seconds"
    ),
    "microseconds as decimals": (lambda ns: f"{ns // 10**9}.{ns % 10**9 // 1000:06d}", 1_000, "seconds and 6 decimals"),
    "ISO 8601": (lambda ns: iso(ns, "%Y-%m-%dT%H:%M:%S."), 1, "dates, UTC"),
    "ISO 8601, basic, to the millisecond": (lambda ns: iso(ns, "%Y%m%dT%H%M%S.")[:19] + "Z", 10**6, "dates, UTC"),
    "a date with hyphens for colons": (lambda ns: "pc_" + iso(ns, "%Y-%m-%d-%H-%M-%S-"), 1, "dates, UTC"),
    "seconds and decimals since the sensor started": (
        lambda ns: f"{(ns - START_NS) // 10**8 / 10:.1f}", 10**8, "began elsewhere",
    ),
    "nanoseconds that would be milliseconds since 1970": (lambda ns: f"{ns - START_NS + 10**12}", 1, "began elsewhere"),
    "microseconds since the sensor started": (lambda ns: f"{(ns - START_NS) // 1000:012d}", 1_000, "began elsewhere"),
}  # fmt: skip


@pytest.mark.parametrize("form", NAMES)
def test_stamps_in_file_names_of_any_form(form: str, tmp_path: Path) -> None:
    name, resolution, words = NAMES[form]
    folder = scans(tmp_path / "a", len(STAMPS))
    for path, stamp in zip(sorted(folder.iterdir()), STAMPS.tolist(), strict=True):
        path.rename(folder / f"{name(stamp)}.bin")
    s = open_sequence(folder)
    began = START_NS if "elsewhere" in words else 0
    began -= 10**12 if "would be" in form else 0
    np.testing.assert_array_equal(s.stamps_ns, (STAMPS - began) // resolution * resolution)
    assert [n for n in s.notes if "scan stamps from the file names" in n and words in n], s.notes
    assert not s.problems
    assert [len(s), s.scan(3).stamp_ns] == [25, s.stamps_ns[3]]
    for k in (0, 7, 24):
        np.testing.assert_array_equal(s.scan(k).points, scan_points(tmp_path, k))


def scan_points(tmp_path: Path, k: int) -> np.ndarray:
    folder = tmp_path / "plain"
    if not folder.is_dir():
        scans(folder, 25)
    return open_sequence(folder).scan(k).points


def test_the_number_of_a_scan_is_no_stamp() -> None:
    for names in (
        [f"{k:06d}" for k in range(20)],
        [f"scan_{k}_2022" for k in range(20)],
        [f"{k * 100:010d}" for k in range(20)],
        [f"1670403902_{k:06d}" for k in range(20)],
        [f"map_{k}.{k}" for k in range(20)],
        [f"20231114_{k:06d}" for k in range(20)],
        [f"2023-11-14-221320_{k:06d}" for k in range(20)],
        [f"tile_{k // 4}.{k % 4}" for k in range(20)],
        [f"scan_{k}.2022" for k in range(20)],
    ):
        found = stamps_in_names([Path(f"{name}.pcd") for name in names])
        assert found is None or found.stamps_ns is None, names
    repeated = stamps_in_names([Path(f"{1670403902 + k // 10}.pcd") for k in range(20)])
    assert repeated is not None
    assert repeated.stamps_ns is None


def test_stamps_of_names_that_repeat_are_said_and_not_used(tmp_path: Path) -> None:
    folder = scans(tmp_path / "a", 20)
    for k, path in enumerate(sorted(folder.iterdir())):
        path.rename(folder / f"{1670403902 + k // 10}_{k:06d}.bin")
    s = open_sequence(folder)
    np.testing.assert_array_equal(s.stamps_ns, np.arange(20) * 100_000_000)
    assert any("file names are not used: as seconds since 1970 they repeat" in p for p in s.problems)


# -- absolute times of the points


def timed(path: Path, times: np.ndarray, name: str = "time") -> None:
    """A cloud of len(times) points with a field of times, as PCD, PLY or NPY."""
    table = np.zeros(len(times), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), (name, times.dtype)])
    table["x"], table["y"], table[name] = 1 + np.arange(len(times)), np.arange(len(times)) % 7, times
    kind, size = times.dtype.kind.upper(), times.dtype.itemsize
    if path.suffix == ".npy":
        np.save(path, table)
    elif path.suffix == ".ply":
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(times)}\n"
        head += "".join(f"property float {axis}\n" for axis in "xyz") + f"property double {name}\nend_header\n"
        path.write_bytes(head.encode() + table.tobytes())
        assert len(read_points(path)) == len(times)
    else:
        head = (
            f"FIELDS x y z {name}\nSIZE 4 4 4 {size}\nTYPE F F F {kind}\nCOUNT 1 1 1 1\nWIDTH {len(times)}\nHEIGHT 1\n"
        )
        path.write_bytes(f"{head}POINTS {len(times)}\nDATA binary\n".encode() + table.tobytes())


WITHIN_S = np.linspace(0, 0.0999, 60)


@pytest.mark.parametrize("suffix", [".pcd", ".ply", ".npy"])
def test_absolute_times_of_the_points_are_the_stamps_where_there_are_no_others(suffix: str, tmp_path: Path) -> None:
    begins = np.array([1_700_000_000.25, 1_700_000_169.5, 1_700_000_489.75])
    for k, begin in enumerate(begins):
        timed(tmp_path / f"{k}{suffix}", begin + WITHIN_S)
    s = open_sequence(tmp_path)
    np.testing.assert_allclose(s.stamps_ns, begins * 1e9, atol=300)
    assert s.rate_hz == 10.0
    assert any("scan stamps from the absolute times of the points, field 'time'" in n for n in s.notes)
    assert not any("10 Hz" in n and "stamped" in n for n in s.notes)
    for k in range(3):
        scan = s.scan(k)
        assert scan.stamp_ns == s.stamps_ns[k]
        assert scan.times is not None
        np.testing.assert_allclose(scan.times, WITHIN_S, atol=1e-6)


@pytest.mark.parametrize(("scale", "kind", "start"), [(10**9, "u8", START_NS), (10**6, "f8", 0), (1, "f8", 12.5)])
def test_absolute_times_of_any_unit_and_epoch(scale: int, kind: str, start: float, tmp_path: Path) -> None:
    """Nanoseconds since 1970 as integers, microseconds since the recording began, seconds since the sensor was switched on."""
    gaps = np.array([0, 1, 2, 5, 6, 7, 8, 20]) * 0.1
    for k, begin in enumerate(gaps):
        values = np.rint((begin + WITHIN_S) * scale) if scale > 1 else begin + WITHIN_S
        timed(tmp_path / f"{k}.pcd", values.astype(kind) + np.array(start, kind))
    s = open_sequence(tmp_path)
    expected = gaps * 1e9 + (start if kind == "u8" else start * 1e9)
    np.testing.assert_allclose(s.stamps_ns - s.stamps_ns[0], gaps * 1e9, atol=2000)
    np.testing.assert_allclose(s.stamps_ns, expected, atol=2000)
    assert s.rate_hz == pytest.approx(10.0, abs=0.01)


def test_offsets_are_no_absolute_times_and_one_scan_of_zeros_is_no_gap(tmp_path: Path) -> None:
    for k in range(6):
        timed(tmp_path / f"{k}.pcd", WITHIN_S)
    assert any("stamped at 10 Hz" in n for n in open_sequence(tmp_path).notes)
    for k in range(6):
        timed(tmp_path / f"{k}.pcd", (1_700_000_000 + 0.1 * k + WITHIN_S) * (k != 3))
    np.testing.assert_allclose(open_sequence(tmp_path).stamps_ns - 1_700_000_000 * 10**9, np.arange(6) * 1e8, atol=300)


# -- clocks of a folder held against each other


def test_a_step_in_the_stamps_file_is_taken_out_by_the_times_of_the_points(tmp_path: Path) -> None:
    for k in range(20):
        timed(tmp_path / f"{k:02d}.pcd", 55.0 + 0.1 * k + WITHIN_S)
    true = 1_700_000_000 * 10**9 + np.arange(20) * 100_000_000
    for step_s in (37.0, -37.0):
        stamps = true + int(step_s * 1e9) * (np.arange(20) >= 8)
        (tmp_path / "stamps.txt").write_text("\n".join(map(str, stamps.tolist())))
        s = open_sequence(tmp_path)
        np.testing.assert_array_equal(np.diff(s.stamps_ns), 100_000_000)
        assert any("at message 8" in p or "at scan 8" in p for p in s.problems), s.problems
        assert s.rate_hz == 10.0
    (tmp_path / "stamps.txt").write_text("\n".join(["1700000000.0"] * 20))
    s = open_sequence(tmp_path)
    np.testing.assert_allclose(s.stamps_ns, 55e9 + np.arange(20) * 1e8, atol=300)
    assert any("its stamps stand still: the absolute times of the points" in p for p in s.problems)


def test_a_pause_that_all_clocks_tell_of_stays(tmp_path: Path) -> None:
    late = 600.0 * (np.arange(12) >= 5)
    for k in range(12):
        timed(tmp_path / f"{k:02d}.pcd", 55.0 + late[k] + 0.1 * k + WITHIN_S)
    stamps = 1_700_000_000 * 10**9 + np.rint((late + 0.1 * np.arange(12)) * 1e9).astype(np.int64)
    (tmp_path / "stamps.txt").write_text("\n".join(map(str, stamps.tolist())))
    s = open_sequence(tmp_path)
    np.testing.assert_array_equal(s.stamps_ns, stamps)
    assert not s.problems


# -- rows that were lost


def lost(folder: Path, missing: list[int], labels: bool = False) -> np.ndarray:
    """A folder of 20 scans of which the stamps file lacks rows; the stamps of all."""
    files = sorted(scans(folder, 20).iterdir())
    stamps = np.round(1_670_403_902.1 + 0.1 * np.arange(20), 3)
    rows = [f"{f.name + ' ' if labels else ''}{t:.3f}" for f, t in zip(files, stamps, strict=True)]
    (folder / "stamps.txt").write_text("\n".join(row for k, row in enumerate(rows) if k not in missing))
    return np.rint(stamps * 1e9).astype(np.int64)


@pytest.mark.parametrize("missing", [[7], [3, 4, 12]])
def test_rows_lost_from_the_middle_leave_gaps_that_tell_where(missing: list[int], tmp_path: Path) -> None:
    stamps = lost(tmp_path / "a", missing)
    s = open_sequence(tmp_path / "a")
    assert len(s) == 20
    np.testing.assert_allclose(s.stamps_ns, stamps, atol=1000)
    assert any(f"has {20 - len(missing)} stamps for 20 scans: the lost rows leave gaps" in p for p in s.problems)


def test_rows_lost_from_the_end_cost_the_last_scans(tmp_path: Path) -> None:
    stamps = lost(tmp_path / "a", [18, 19])
    s = open_sequence(tmp_path / "a")
    np.testing.assert_allclose(s.stamps_ns, stamps[:18], atol=1000)
    assert any("the 18 common ones are used, by index" in p for p in s.problems)


def test_where_nothing_tells_which_rows_were_lost_the_stamps_are_refused(tmp_path: Path) -> None:
    lost(tmp_path / "a", [3, 18, 19])
    with pytest.raises(
        InputError, match=r"stamps\.txt has 17 stamps for 20 scans, and neither numbers, names nor gaps"
    ):
        open_sequence(tmp_path / "a")
    folder = scans(tmp_path / "b", 18)
    for k, path in enumerate(sorted(folder.iterdir())):
        path.rename(folder / f"{'abcdefghijklmnopqrstuvwxyz'[k]}.bin")
    (folder / "stamps.txt").write_text("\n".join(f"{0.1 * k:.1f}" for k in range(20)))
    with pytest.raises(InputError, match="has 20 stamps for 18 scans, and neither numbers"):
        open_sequence(folder)


def test_scans_lost_from_numbered_files_go_by_their_numbers(tmp_path: Path) -> None:
    stamps = lost(tmp_path / "a", [])
    for k in (4, 11):
        (tmp_path / "a" / f"{k:06d}.bin").unlink()
    np.testing.assert_allclose(open_sequence(tmp_path / "a").stamps_ns, np.delete(stamps, [4, 11]), atol=1000)


@pytest.mark.parametrize("lost_row", [None, 7])
@pytest.mark.parametrize("label", ["{k:06d}.bin", "{k}"])
def test_rows_go_with_the_scans_that_they_name(label: str, lost_row: int | None, tmp_path: Path) -> None:
    stamps = lost(tmp_path / "a", [])
    order = np.random.default_rng(0).permutation(20) if label.endswith("bin") else np.arange(20)
    rows = [f"{label.format(k=k)} {stamps[k]}" for k in order.tolist() if k != lost_row]
    (tmp_path / "a" / "stamps.txt").write_text("\n".join(rows))
    s = open_sequence(tmp_path / "a")
    np.testing.assert_array_equal(s.stamps_ns, stamps if lost_row is None else np.delete(stamps, lost_row))


# -- what rides along


def with_imu(folder: Path, shift_s: np.ndarray, imu_shift_s: float, words: str = "") -> np.ndarray:
    """How far, ns, an IMU shifted from scan 8 on lies off 20 scans, whose stamps file is shifted by `shift_s` (20,)."""
    folder.mkdir()
    true = 1_700_000_000 * 10**9 + np.arange(20) * 100_000_000
    for k in range(20):
        timed(folder / f"{k:02d}.pcd", 55.0 + 0.1 * k + WITHIN_S)
    (folder / "stamps.txt").write_text("\n".join(map(str, (true + np.rint(shift_s * 1e9).astype(np.int64)).tolist())))
    imu = true[0] + np.arange(200) * 10_000_000
    shifted = imu + int(imu_shift_s * 1e9) * (imu > true[8] - 40_000_000)
    rows = [f"{ns},0,0,9.81,0,0,{k}" for k, ns in enumerate(shifted.tolist())]
    (folder / "imu.csv").write_text("\n".join(["stamp_ns,ax,ay,az,wx,wy,wz", *rows]))
    s = open_sequence(folder)
    np.testing.assert_array_equal(np.diff(s.stamps_ns), 100_000_000)
    assert words or s.stamps_ns[0] == true[0]
    assert s.imu is not None
    np.testing.assert_array_equal(s.imu.gyro[:, 2], np.arange(200))
    assert any("IMU: its stamps step with those of the scans" in p for p in s.problems) == bool(words)
    return s.imu.stamps_ns - imu - (s.stamps_ns[0] - true[0])


@pytest.mark.parametrize("shift_s", [37.0, -37.0, 0.7])
def test_an_imu_on_the_clock_of_the_scans_is_moved_as_they_are(tmp_path: Path, shift_s: float) -> None:
    steps = shift_s * (np.arange(20) >= 8)
    np.testing.assert_array_equal(with_imu(tmp_path / "same", steps, shift_s, "moved"), 0)
    np.testing.assert_array_equal(with_imu(tmp_path / "other", steps, 0.0), 0)


def test_stamps_of_arrival_are_named(tmp_path: Path) -> None:
    folder = scans(tmp_path / "a", 60)
    jitter = np.clip(np.random.default_rng(1).normal(0, 0.01, 60), -0.045, 0.045)
    (folder / "times.txt").write_text("\n".join(f"{t:.6f}" for t in 100 + 0.1 * np.arange(60) + jitter))
    (note,) = [n for n in open_sequence(folder).notes if "unevenly" in n]
    assert 10 < float(note.split("unevenly, ")[1].split(" ms")[0]) < 20, "steps of two stamps of 10 ms each"
    (folder / "times.txt").write_text("\n".join(f"{t:.6f}" for t in 100 + 0.1 * np.arange(60) + 0.1 * jitter))
    assert not [n for n in open_sequence(folder).notes if "unevenly" in n]
