"""Records without a header: what a point consists of is seen in the values, whatever the size, the types and the order."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from point_writers import packed, revolution

from lslam.core.errors import InputError
from lslam.io.formats.point_files import read_cloud, read_points
from lslam.io.formats.point_records import KITTI, name_columns, parse_record, recognise
from lslam.io.formats.sequence_toml import SequenceInfo, write_sequence_toml
from lslam.io.readers import open_sequence

UTM_M = np.array([456_789.5, 5_432_100.25, 115.0])


def as_bytes(words: str, seeds: tuple[int, ...] = (0, 1, 2)) -> list[NDArray[np.uint8]]:
    return [np.frombuffer(packed(revolution(seed), words), np.uint8) for seed in seeds]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("x y z intensity", "x y z intensity"),
        ("x y z", "x y z"),
        ("x y z intensity ring", "x y z intensity ring"),
        ("x y z intensity time", "x y z intensity time"),
        ("x y z intensity ring time", "x y z intensity ring time"),
        ("x y z intensity time ring", "x y z intensity time ring"),
        ("x y z ring intensity", "x y z ring intensity"),
        ("x y z intensity ring time noise noise", "x y z intensity ring time _ _"),
        ("x:f8 y:f8 z:f8", "x:f8 y:f8 z:f8"),
        ("x:f8 y:f8 z:f8 intensity:f8", "x:f8 y:f8 z:f8 intensity:f8"),
        ("x:f8 y:f8 z:f8 intensity:f8 ring:f8 stamp:f8", "x:f8 y:f8 z:f8 intensity:f8 ring:f8 time:f8"),
        *(
            (" ".join(f"{name}:>f4" for name in names), " ".join(f"{name}:>f4" for name in names))
            for names in (("x", "y", "z", "intensity"), ("x", "y", "z", "intensity", "ring", "time"))
        ),
        ("x y z intensity ring:u2 time", "x y z intensity ring:u2 time"),
        ("x y z intensity ring:u2 stamp:f8", "x y z intensity ring:u2 time:f8"),
        ("x y z intensity time_ns:u4 pad:u2 ring:u2 pad:u2", "x y z intensity time:u4 _:u2 ring:u2 _:u2"),
        ("x y z one intensity ring:u2 pad:u2 time pad", "x y z _ intensity ring:u2 _:u2 time _"),
    ],
)
def test_a_record_is_recognised_by_its_values(words: str, expected: str) -> None:
    """All sizes are multiples of 16 bytes here: the size decides nothing."""
    files = as_bytes(words)
    assert all(len(raw) % 16 == 0 for raw in files)
    found = recognise(files)
    assert str(found.record) == expected
    assert (found.reason == "") == (words == "x y z intensity")


@pytest.mark.parametrize("order", ["by ring", "shuffled"])
def test_the_order_of_the_points_does_not_matter_for_size_and_rings(order: str) -> None:
    columns = revolution()
    n = len(columns["x"])
    kept = np.argsort(columns["ring"], kind="stable") if order == "by ring" else np.random.default_rng(5).permutation(n)
    columns = {name: values[kept] for name, values in columns.items()}
    found = recognise([np.frombuffer(packed(columns, "x y z intensity ring time"), np.uint8)])
    # Times that jump about are not taken for times.
    assert str(found.record) == "x y z intensity ring " + ("time" if order == "by ring" else "_")


def test_normals_are_no_points_and_sizes_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(packed(revolution(), "x y z noise noise noise"))
    with pytest.raises(InputError, match=r"a\.bin: as x y z intensity of 16 bytes .* negative.*12.*24.*bin_record = "):
        read_points(tmp_path / "a.bin")


def test_a_truncated_file_among_others_is_named_and_the_rest_is_read(tmp_path: Path) -> None:
    for seed in range(5):
        (tmp_path / f"{seed:06d}.bin").write_bytes(packed(revolution(seed), "x y z intensity ring"))
    cut = tmp_path / "000002.bin"
    cut.write_bytes(cut.read_bytes()[:-7])
    s = open_sequence(tmp_path)
    rings = s.scan(4).rings
    assert rings is not None
    np.testing.assert_array_equal(rings, revolution(4)["ring"])
    with pytest.raises(InputError, match=r"000002\.bin: 163833 bytes are no multiple of 20 \(x y z intensity ring\)"):
        s.scan(2)


def test_a_folder_of_six_floats_has_rings_and_times(tmp_path: Path) -> None:
    for seed in range(4):
        (tmp_path / f"{seed:06d}.bin").write_bytes(packed(revolution(seed), "x y z intensity ring time"))
    s = open_sequence(tmp_path)
    assert any("24 bytes, x y z intensity ring time, by their values" in note for note in s.notes)
    scan, truth = s.scan(3), revolution(3)
    assert scan.times is not None
    np.testing.assert_allclose(scan.times, truth["time"], atol=1e-6)
    np.testing.assert_array_equal(scan.points[:, 2], truth["z"].astype(np.float32))


def test_six_floats_in_the_layout_of_kitti_are_not_taken_for_compensated_ones(tmp_path: Path) -> None:
    (tmp_path / "velodyne").mkdir()
    for seed in range(4):
        (tmp_path / "velodyne" / f"{seed:06d}.bin").write_bytes(packed(revolution(seed), "x y z intensity ring time"))
    s = open_sequence(tmp_path)
    assert (s.kind, s.motion_compensated) == ("kitti-odometry", None)
    assert s.scan(1).times is not None
    np.testing.assert_array_equal(s.scan(1).points[:, 2], revolution(1)["z"].astype(np.float32))


def test_a_record_can_be_stated(tmp_path: Path) -> None:
    words = "x:i2 y:i2 z:i2 ring:u1 _:u1"
    columns = {name: np.round(100 * values) if name in "xyz" else values for name, values in revolution().items()}
    for k in range(3):
        (tmp_path / f"{k}.bin").write_bytes(packed(columns | {"_": columns["ring"]}, words))
    write_sequence_toml(tmp_path / "sequence.toml", SequenceInfo(bin_record=words, point_unit="cm"))
    s = open_sequence(tmp_path)
    assert any(f"{words}, as stated" in note for note in s.notes)
    np.testing.assert_allclose(s.scan(1).points[:, 0], revolution()["x"], atol=0.0051)
    np.testing.assert_array_equal(s.scan(1).rings, columns["ring"])
    # Some files of many have whole records of any size, by chance.
    (tmp_path / "sequence.toml").write_text('bin_record = "x y z intensity _:u1"\n')
    with pytest.raises(InputError, match="bytes are no multiple of 17"):
        open_sequence(tmp_path)
    for bad in ("x y", "x y z z", "x:f1 y z", "x y z:q3", ""):
        (tmp_path / "sequence.toml").write_text(f'bin_record = "{bad}"\n')
        with pytest.raises(InputError, match="bin_record"):
            open_sequence(tmp_path)


@pytest.mark.parametrize("kind", ["<f4", "<f8", ">f8"])
def test_columns_of_arrays_are_named_by_their_values(kind: str, tmp_path: Path) -> None:
    for seed in range(3):
        columns = revolution(seed)
        table = np.column_stack([columns[name] for name in ("x", "y", "z", "intensity", "time", "ring", "noise")])
        np.save(tmp_path / f"{seed}.npy", table.astype(kind))
    s = open_sequence(tmp_path)
    assert any("x y z intensity time ring _, by their values; column 7 not read" in note for note in s.notes)
    scan = s.scan(2)
    assert scan.times is not None
    np.testing.assert_allclose(scan.times, columns["time"], atol=1e-6)
    np.testing.assert_array_equal(scan.rings, columns["ring"])


def test_structured_arrays_may_hold_places_as_one_field(tmp_path: Path) -> None:
    columns = revolution()
    table = np.zeros(len(columns["x"]), [("xyz", "<f4", 3), ("ring", "u1"), ("name", "S4"), ("t", "<u4")])
    table["xyz"] = np.column_stack([columns[name] for name in "xyz"])
    table["ring"], table["t"] = columns["ring"], columns["time_ns"]
    np.save(tmp_path / "a.npy", table)
    read = read_points(tmp_path / "a.npy")
    np.testing.assert_array_equal(read.points, table["xyz"])
    assert ([clock.name for clock in read.clocks], read.rings is not None) == (["t"], True)


def test_ranges_and_flags_are_no_times_and_no_rings() -> None:
    columns = revolution()
    columns["range"] = np.linalg.norm([columns[name] for name in "xyz"], axis=0)
    columns["flag"] = (columns["intensity"] > 180).astype(float)
    table = np.column_stack([columns[name] for name in ("x", "y", "z", "range", "flag", "ring")])
    assert name_columns([table]) == ("x", "y", "z", "_", "intensity", "ring")


def test_rings_one_after_the_other_are_no_times() -> None:
    columns = revolution(rings=64)
    kept = np.argsort(columns["ring"], kind="stable")
    table = np.column_stack([columns[name][kept] for name in ("x", "y", "z", "intensity", "ring", "time")])
    assert name_columns([table]) == ("x", "y", "z", "intensity", "ring", "time")
    assert name_columns([table[:, [0, 1, 2, 3, 4]]]) == ("x", "y", "z", "intensity", "ring")


def test_few_points_and_nothing_are_kittis() -> None:
    raw = np.frombuffer(struct.pack("<8f", 1, 2, 3, -5, 4, 5, 6, -7), np.uint8)
    assert recognise([raw]).record == KITTI
    assert recognise([raw[:0]]).record == KITTI
    assert recognise([np.full(16_000, 255, np.uint8)]).record == KITTI


def test_words_of_a_record_are_read_back() -> None:
    for words in ("x y z intensity", "ring:u2 x:f8 y:f8 z:f8 _:u1 time:u4", "x:>f4 y:>f4 z:>f4"):
        assert str(parse_record(words)) == words


@pytest.mark.parametrize("suffix", ["ply", "ascii.ply", "pcd", "ascii.pcd", "npy", "bin"])
def test_double_coordinates_of_maps_keep_their_digits(suffix: str, tmp_path: Path) -> None:
    columns = revolution()
    points = np.column_stack([columns[name] for name in "xyz"]) + UTM_M
    path = tmp_path / f"map.{suffix}"
    kind = "float" if "ascii" in suffix else "double"  # text holds its digits whatever the header says
    lines = "".join("{:.4f} {:.4f} {:.4f}\n".format(*row) for row in points).encode()
    ply = f"ply\nformat {'ascii' if 'ascii' in suffix else 'binary_little_endian'} 1.0\nelement vertex {len(points)}\n"
    pcd = (
        f"VERSION .7\nFIELDS x y z\nSIZE {' '.join(['4' if 'ascii' in suffix else '8'] * 3)}\nTYPE F F F\n"
        f"WIDTH 0\nHEIGHT 1\nPOINTS {len(points)}\nDATA {'ascii' if 'ascii' in suffix else 'binary'}\n"
    )
    body = lines if "ascii" in suffix else points.tobytes()
    if suffix.endswith("ply"):
        path.write_bytes((ply + "".join(f"property {kind} {a}\n" for a in "xyz") + "end_header\n").encode() + body)
    elif suffix.endswith("pcd"):
        path.write_bytes(pcd.encode() + body)
    elif suffix == "npy":
        np.save(path, points)
    else:
        # Three doubles, far from the origin.
        path.write_bytes(points.tobytes())
    np.testing.assert_allclose(read_cloud(path).points, points, atol=6e-5)
    assert read_points(path).points.dtype == np.float32


def test_coordinates_in_coarse_steps_are_warned_about(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    columns = revolution()
    points = np.column_stack([columns[name] for name in "xyz"]) + UTM_M
    np.save(tmp_path / "fine.npy", points)
    np.save(tmp_path / "coarse.npy", points.astype(np.float32))
    read_cloud(tmp_path / "fine.npy")
    assert caplog.text == ""
    read_cloud(tmp_path / "coarse.npy")
    assert "coarse.npy: its coordinates lie in steps of 0.5 m" in caplog.text


def test_raw_bytes_in_a_column_of_text_leave_the_others(tmp_path: Path) -> None:
    """A char that C++ streamed into text: any byte, a blank and the end of a line among them."""
    head = (
        "VERSION .7\nFIELDS x y flag z intensity\nSIZE 4 4 1 4 4\nTYPE F F U F F\nCOUNT 1 1 1 1 1\n"
        "WIDTH 256\nHEIGHT 1\nPOINTS 256\nDATA ascii\n"
    )
    rows = b"".join(b"%d.5 -1.25e+01 %c nan %d\n" % (k, k, 2 * k) for k in range(256))
    path = tmp_path / "a.pcd"
    path.write_bytes(head.encode() + rows)
    read = read_points(path)
    np.testing.assert_array_equal(read.points[:, 0], np.arange(256) + 0.5)
    assert (read.points[:, 1] == -12.5).all()
    assert np.isnan(read.points[:, 2]).all()
    np.testing.assert_array_equal(read.intensity, 2 * np.arange(256))
    # As a ring the bytes are numbers, and one of another type is left out.
    path.write_bytes(head.replace("flag", "ring").encode() + rows)
    np.testing.assert_array_equal(read_points(path).rings, np.arange(256))
    rgb = b"".join(b"%d.5 -1.25e+01 %s nan %d\n" % (k, bytes([k, 255 - k, 10, 32]), 2 * k) for k in range(256))
    path.write_bytes(head.replace("flag", "rgb").replace("SIZE 4 4 1", "SIZE 4 4 4").encode() + rgb)
    np.testing.assert_array_equal(read_points(path).points[:, 0], np.arange(256) + 0.5)
    np.testing.assert_array_equal(read_points(path).intensity, 2 * np.arange(256))
    path.write_bytes(head.encode() + rows.replace(b"-1.25e+01", b"-1.2x", 1))
    with pytest.raises(InputError, match=r"a\.pcd: PCD ascii data"):
        read_points(path)


@pytest.mark.parametrize(("count", "words"), [("3000000000", "numbers a point: too many"), ("0", "has no FIELDS")])
@pytest.mark.parametrize("data", ["ascii", "binary"])
def test_counts_that_no_point_has_are_refused(count: str, words: str, data: str, tmp_path: Path) -> None:
    path = tmp_path / "a.pcd"
    head = f"FIELDS x\nSIZE 4\nTYPE F\nCOUNT {count}\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA {data}\n"
    path.write_text(f"{head}1 2 3\n1 2 3\n")
    with pytest.raises(InputError, match=words):
        read_points(path)
