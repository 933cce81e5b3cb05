"""The table of names for the fields of points, the same for all kinds of files, and values that do not go with their name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.types.scan import NO_RING
from lslam.io.formats.point_cloud import cloud_from_fields, plain_name
from lslam.io.formats.point_files import read_points
from lslam.io.readers.point_times import Sample, learn_rule

N = 1600
SECONDS = np.linspace(0, 0.0999, N)
NS = np.round(SECONDS * 1e9).astype(np.int64)
START_S = 1_700_000_000
AZIMUTH = -2 * np.pi * SECONDS / 0.1
PLACES = {"x": 20 * np.cos(AZIMUTH), "y": 20 * np.sin(AZIMUTH), "z": np.tile(np.linspace(-5, 5, 16), N // 16)}
RINGS = np.arange(N) % 16
Columns = dict[str, NDArray[Any]]


def rule_of(columns: Columns) -> tuple[str, float, bool] | None:
    """Field of the times, its unit in ns, whether it is a clock."""
    rule = learn_rule([Sample(cloud_from_fields(Path("a"), {**PLACES, **columns}), 0)], 10)
    return None if rule is None else (rule.field, rule.ns_per_unit, rule.is_absolute)


CLOCKS: dict[str, tuple[Columns, str, float, bool]] = {
    "velodyne": ({"time": (SECONDS - 0.1).astype("f4")}, "time", 1e9, False),
    "ouster": ({"t": NS.astype("u4"), "ambient": RINGS}, "t", 1, False),
    "hesai": ({"timestamp": START_S + SECONDS}, "timestamp", 1e9, True),
    "livox": ({"offset_time": NS.astype("u4")}, "offset_time", 1, False),
    "aeva": ({"time_offset_ns": NS.astype("i4")}, "time_offset_ns", 1, False),
    "luminar": (
        {"time_sec": np.full(N, START_S, "u4"), "time_nsec": (500_000_000 + NS).astype("u4")},
        "time_sec + time_nsec", 1, True,
    ),
    "blickfeld": ({"point_time_offset": NS.astype("u4"), "point_id": np.arange(N)}, "point_time_offset", 1, False),
    "cepton": ({"relative_timestamp": (NS // 1000).astype("i4")}, "relative_timestamp", 1e3, False),
    "cepton, absolute": (
        {"timestamp_s": np.full(N, START_S, "i8"), "timestamp_us": NS // 1000}, "timestamp_s + timestamp_us", 1, True,
    ),
    "sick": ({"ts": SECONDS.astype("f4"), "t": NS.astype("u4")}, "t", 1, False),
    "sick, clock alone": (
        {"lidar_sec": np.full(N, START_S, "u4"), "lidar_nsec": NS.astype("u4")}, "lidar_sec + lidar_nsec", 1, True,
    ),
    "seconds as floats": (
        {"sec": np.full(N, float(START_S)), "nsec": NS.astype(float)}, "sec + nsec", 1, True,
    ),
    "fast-lio": ({"curvature": (1e3 * SECONDS).astype("f4")}, "curvature", 1e6, False),
    "cloudcompare": ({"scalar_GPSTime": 300_000 + SECONDS}, "scalar_GPSTime", 1e9, True),
    "cloudcompare, spaced": ({"Scalar field: x": RINGS, "scalar_Time-Stamp": SECONDS}, "scalar_Time-Stamp", 1e9, False),
    "microseconds by name": ({"t_us": SECONDS * 1e6}, "t_us", 1e3, False),
    "an offset in ns": ({"offset_ns": NS.astype("u4")}, "offset_ns", 1, False),
    "a clock of the sensor": ({"lidar_timestamp": START_S + SECONDS}, "lidar_timestamp", 1e9, True),
    "a step since the first": ({"deltaT": SECONDS.astype("f4")}, "deltaT", 1e9, False),
    "the field that is filled": ({"time": np.zeros(N, "f4"), "timestamp": START_S + SECONDS}, "timestamp", 1e9, True),
    "curvature beside times": ({"curvature": (1e3 * SECONDS).astype("f4"), "time": SECONDS}, "time", 1e9, False),
}  # fmt: skip


@pytest.mark.parametrize("driver", CLOCKS)
def test_times_of_every_driver(driver: str) -> None:
    columns, *expected = CLOCKS[driver]
    assert rule_of(columns) == tuple(expected)


@pytest.mark.parametrize("names", [("px", "py", "pz"), ("X_m", "Y_m", "Z_m")])
def test_places_of_other_names(names: tuple[str, ...]) -> None:
    cloud = cloud_from_fields(Path("a"), dict(zip(names, PLACES.values(), strict=True)))
    np.testing.assert_array_equal(cloud.points, np.stack(list(PLACES.values()), axis=1).astype(np.float32))


def test_seconds_and_nanoseconds_carry_over() -> None:
    """The second begins within the scan."""
    ns = 950_000_000 + NS
    cloud = cloud_from_fields(
        Path("a"), {**PLACES, "time_sec": (START_S + ns // 10**9).astype("u4"), "time_nsec": (ns % 10**9).astype("u4")}
    )
    assert cloud.times is not None
    np.testing.assert_array_equal(cloud.times, START_S * 10**9 + ns)


@pytest.mark.parametrize("kind", ["surface", "heavy tail", "noise", "constant"])
def test_real_curvature_is_not_taken_for_times(kind: str) -> None:
    rng = np.random.default_rng(1)
    values = {
        "surface": rng.uniform(0, 1 / 3, N), "heavy tail": rng.exponential(1, N) ** 3 * 5, "noise": rng.uniform(0, 100, N),
        "constant": np.full(N, 50.0),
    }[kind]  # fmt: skip
    assert rule_of({"curvature": values.astype("f4")}) is None
    assert "curvature" in cloud_from_fields(Path("a"), {**PLACES, "curvature": values}).unread


def test_two_columns_that_are_no_seconds_and_parts_are_not_put_together() -> None:
    columns = {"time_sec": SECONDS, "time_nsec": SECONDS * 1e9}
    assert rule_of(columns) == ("time_nsec", 1, False) or rule_of(columns) == ("time_sec", 1e9, False)


@pytest.mark.parametrize("name", ["ring", "Rings", "laser_id", "channel", "line", "layer", "beam_id", "scalar_Ring"])
def test_rings_by_their_names(name: str) -> None:
    for kind in ("u1", "i2", "f4", "f8"):
        cloud = cloud_from_fields(Path("a"), {**PLACES, name: RINGS.astype(kind)})
        np.testing.assert_array_equal(cloud.rings, RINGS)
        assert name in cloud.fields


@pytest.mark.parametrize("name", ["laser_id", "channel", "line"])
@pytest.mark.parametrize("values", [RINGS % 2, RINGS * 0, np.arange(N), np.sin(RINGS), -1.0 - RINGS], ids=str)
def test_heads_and_counters_are_no_rings(name: str, values: NDArray[Any]) -> None:
    cloud = cloud_from_fields(Path("a"), {**PLACES, name: values})
    assert cloud.rings is None
    assert name in cloud.unread
    both = cloud_from_fields(Path("a"), {**PLACES, name: values, "beam": RINGS})
    np.testing.assert_array_equal(both.rings, RINGS)


@pytest.mark.parametrize("bad", [np.nan, -1.0, 65535.0, 1e9, 2.5])
def test_points_without_a_ring_are_told_apart(bad: float) -> None:
    values = np.where(np.arange(N) % 50, RINGS, bad)
    rings = cloud_from_fields(Path("a"), {**PLACES, "ring": values}).rings
    np.testing.assert_array_equal(rings, np.where(np.arange(N) % 50, RINGS, NO_RING))


def test_points_that_were_not_measured_have_no_say_in_the_rings() -> None:
    """Most rows are empty, as drivers write directions without a return."""
    empty = np.arange(N) % 10 > 1
    for nothing in (np.nan, 0.0):
        places = {axis: np.where(empty, nothing, values) for axis, values in PLACES.items()}
        rings = cloud_from_fields(Path("a"), {**places, "ring": np.where(empty, np.nan, RINGS)}).rings
        assert rings is not None
        np.testing.assert_array_equal(rings[~empty], RINGS[~empty])
        assert (rings[empty] == NO_RING).all()


def test_what_nobody_reads_is_listed() -> None:
    cloud = cloud_from_fields(Path("a"), {**PLACES, "Intensity": RINGS, "rgb": RINGS, "t": NS, "near_ir": RINGS})
    assert cloud.fields == ("x", "y", "z", "Intensity")
    assert cloud.unread == ("rgb", "t", "near_ir"), "whether times are read is known of a recording"


@pytest.mark.parametrize(
    ("name", "plain"),
    [("scalar_GpsTime", "gps_time"), ("Time Stamp", "time_stamp"), ("laserId", "laser_id"), ("X", "x"), ("_", "")],
)
def test_names_are_compared_without_their_spelling(name: str, plain: str) -> None:
    assert plain_name(name) == plain


@pytest.mark.parametrize("data", ["binary", "ascii"])
@pytest.mark.parametrize("shape", [(16, 100), (100, 16)])
def test_rows_of_pcd_files_are_rings(tmp_path: Path, shape: tuple[int, int], data: str) -> None:
    """As those of messages; and a time of two words is read, binary or as digits."""
    table = np.zeros(N, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("timestamp", "<u4", (2,))])
    for axis, values in PLACES.items():
        table[axis] = values
    ns = START_S * 10**9 + NS
    table["timestamp"] = np.stack([ns & 0xFFFFFFFF, ns >> 32], axis=1)
    header = (
        "VERSION 0.7\nFIELDS x y z timestamp\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 2\n"
        f"WIDTH {shape[1]}\nHEIGHT {shape[0]}\nPOINTS {N}\nDATA {data}\n"
    )
    body = table.tobytes()
    if data == "ascii":
        rows = ([*row["timestamp"].tolist()] for row in table)
        places = np.column_stack([table[axis] for axis in "xyz"]).tolist()
        lines = (" ".join(map(str, [*place, *words])) for place, words in zip(places, rows, strict=True))
        body = "\n".join(lines).encode()
    path = tmp_path / "a.pcd"
    path.write_bytes(header.encode() + body)
    cloud = read_points(path)
    rows_of, cols_of = np.divmod(np.arange(N), shape[1])
    np.testing.assert_array_equal(cloud.rings, rows_of if shape[0] < shape[1] else cols_of)
    assert cloud.times is not None
    np.testing.assert_array_equal(cloud.times.astype(np.int64), ns)
    assert not cloud.unread[1:], cloud.unread


@pytest.mark.parametrize("suffix", [".pcd", ".ply", ".npy"])
def test_all_kinds_of_files_share_the_table(tmp_path: Path, suffix: str) -> None:
    columns = {**PLACES, "scalar_Intensity": RINGS * 2.0, "laser_id": RINGS * 1.0, "time_offset_ns": NS * 1.0}
    table = np.zeros(N, [(name, "<f8") for name in columns])
    for name, values in columns.items():
        table[name] = values
    path = tmp_path / f"a{suffix}"
    k = len(columns)
    if suffix == ".npy":
        np.save(path, table)
    elif suffix == ".ply":
        properties = "".join(f"property double {name}\n" for name in columns)
        header = f"ply\nformat binary_little_endian 1.0\nelement vertex {N}\n{properties}end_header\n"
        path.write_bytes(header.encode() + table.tobytes())
    else:
        header = f"VERSION 0.7\nFIELDS {' '.join(columns)}\nSIZE {'8 ' * k}\nTYPE {'F ' * k}\nCOUNT {'1 ' * k}\n"
        path.write_bytes(f"{header}WIDTH {N}\nHEIGHT 1\nPOINTS {N}\nDATA binary\n".encode() + table.tobytes())
    cloud = read_points(path)
    np.testing.assert_allclose(cloud.points, np.column_stack(list(PLACES.values())), atol=1e-5)
    np.testing.assert_array_equal(cloud.intensity, RINGS * 2.0)
    np.testing.assert_array_equal(cloud.rings, RINGS)
    assert [(clock.name, clock.unit) for clock in cloud.clocks] == [("time_offset_ns", "ns")]
