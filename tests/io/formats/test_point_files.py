"""Point files: what is written reads back bit for bit, and files that lie are refused with a place."""

from __future__ import annotations

import errno
import struct
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from point_writers import ENCODINGS, write_pcd, write_points

from lslam.core.errors import InputError, OutputError, UsageError
from lslam.io.formats.point_files import read_points
from lslam.io.formats.point_records import KITTI

CLOUDS = hnp.arrays(
    np.float32,
    st.tuples(st.integers(0, 60), st.just(4)),
    elements=st.floats(width=32, allow_nan=True, allow_infinity=True),
)


def cloud(n: int = 500) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    rng = np.random.default_rng(1)
    return rng.normal(0, 30, (n, 3)).astype(np.float32), rng.random(n).astype(np.float32)


@pytest.mark.parametrize("suffix", [".bin", ".pcd", ".ply", ".npy"])
@given(table=CLOUDS)
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_round_trip_is_exact(suffix: str, table: NDArray[np.float32], tmp_path: Path) -> None:
    path = tmp_path / f"scan{suffix}"
    write_points(path, table[:, :3], table[:, 3])
    back = read_points(path)
    assert back.intensity is not None
    np.testing.assert_array_equal(back.points, table[:, :3])
    np.testing.assert_array_equal(back.intensity, table[:, 3])
    assert not path.with_name(path.name + ".part").exists()


@pytest.mark.parametrize("encoding", ENCODINGS)
@given(table=CLOUDS)
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_pcd_encodings_are_exact(encoding: str, table: NDArray[np.float32], tmp_path: Path) -> None:
    path = tmp_path / "scan.pcd"
    write_pcd(path, table[:, :3], table[:, 3], encoding)
    np.testing.assert_array_equal(read_points(path).points, table[:, :3])


@pytest.mark.parametrize("suffix", [".pcd", ".ply"])
def test_without_intensity(suffix: str, tmp_path: Path) -> None:
    points, _ = cloud()
    write_points(tmp_path / f"map{suffix}", points.astype(np.float64))
    back = read_points(tmp_path / f"map{suffix}")
    np.testing.assert_array_equal(back.points, points)
    assert back.intensity is None


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_open3d_reads_our_pcd_and_we_read_its(encoding: str, tmp_path: Path, open3d: ModuleType) -> None:
    points, intensity = cloud()
    write_pcd(tmp_path / "ours.pcd", points, intensity, encoding)
    theirs = np.asarray(open3d.io.read_point_cloud(str(tmp_path / "ours.pcd")).points)
    np.testing.assert_allclose(theirs, points, rtol=1e-5)
    other = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(np.float64)))
    ascii_, compressed = encoding == "ascii", encoding == "binary_compressed"
    open3d.io.write_point_cloud(str(tmp_path / "o.pcd"), other, write_ascii=ascii_, compressed=compressed)
    np.testing.assert_allclose(read_points(tmp_path / "o.pcd").points, points, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("ascii_", [True, False])
def test_open3d_reads_our_ply_and_we_read_its(ascii_: bool, tmp_path: Path, open3d: ModuleType) -> None:
    points, _ = cloud()
    write_points(tmp_path / "ours.ply", points)
    theirs = np.asarray(open3d.io.read_point_cloud(str(tmp_path / "ours.ply")).points)
    np.testing.assert_array_equal(theirs, points)
    other = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(np.float64)))
    open3d.io.write_point_cloud(str(tmp_path / "o.ply"), other, write_ascii=ascii_)
    np.testing.assert_allclose(read_points(tmp_path / "o.ply").points, points, rtol=1e-5, atol=1e-5)


def test_ply_big_endian_with_an_element_before_and_faces_after(tmp_path: Path) -> None:
    points, intensity = cloud(7)
    table = np.zeros(7, [("x", ">f8"), ("y", ">f8"), ("z", ">f8"), ("ring", ">u2"), ("intensity", ">f4")])
    for k, axis in enumerate("xyz"):
        table[axis] = points[:, k]
    table["ring"], table["intensity"] = np.arange(7), intensity
    header = (
        "ply\r\nformat binary_big_endian 1.0\r\ncomment made by a test\r\nelement camera 1\r\nproperty int id\r\n"
        "element vertex 7\r\nproperty double x\r\nproperty double y\r\nproperty double z\r\nproperty ushort ring\r\n"
        "property float intensity\r\nelement face 1\r\nproperty list uchar int vertex_indices\r\nend_header\r\n"
    )
    path = tmp_path / "big.ply"
    path.write_bytes(header.encode() + struct.pack(">i", 3) + table.tobytes() + struct.pack(">Biii", 3, 0, 1, 2))
    back = read_points(path)
    np.testing.assert_array_equal(back.points, points)
    np.testing.assert_array_equal(back.intensity, intensity)
    np.testing.assert_array_equal(back.rings, np.arange(7))


def test_pcd_keeps_ring_and_time_and_skips_padding(tmp_path: Path) -> None:
    fields = np.dtype(
        {
            "names": ["x", "y", "z", "Intensity", "t", "ring"],
            "formats": ["<f4", "<f4", "<f4", "<f4", "<u4", "<u2"],
            "offsets": [0, 4, 8, 16, 20, 24],
            "itemsize": 26,
        }
    )
    table = np.zeros(5, fields)
    table["x"], table["t"], table["ring"] = np.arange(5), np.arange(5) * 10**7, 63 - np.arange(5)
    header = (
        "VERSION .7\nFIELDS x y z _ Intensity t ring\nSIZE 4 4 4 1 4 4 2\nTYPE F F F U F U U\nCOUNT 1 1 1 4 1 1 1\n"
        "WIDTH 5\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 5\nDATA binary\n"
    )
    path = tmp_path / "ouster.pcd"
    path.write_bytes(header.encode() + table.tobytes())
    back = read_points(path)
    assert ([clock.name for clock in back.clocks], back.points[3, 0]) == (["t"], 3)
    assert back.times is not None
    assert back.times.tolist() == (np.arange(5) * 10**7).tolist()
    assert back.rings is not None
    assert back.rings.dtype == np.uint16
    assert back.rings.tolist() == [63, 62, 61, 60, 59]


@pytest.mark.parametrize("kind", ["binary.pcd", "ascii.pcd", "binary_compressed.pcd", "a.ply", "a.npy", "a.bin"])
@given(place=st.integers(0, 10_000), what=st.binary(max_size=6), cut=st.integers(0, 8), end=st.integers(0, 60))
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damaged_files_are_read_or_refused(
    kind: str, place: int, what: bytes, cut: int, end: int, tmp_path: Path
) -> None:
    """Bytes replaced, inserted, removed or cut off: a cloud comes out, or one sentence that names the file."""
    path = tmp_path / f"damaged{Path(kind).suffix}"
    points, intensity = cloud(20)
    if kind.endswith(".pcd"):
        write_pcd(path, points, intensity, kind.removesuffix(".pcd"))
    else:
        write_points(path, points, intensity)
    data = path.read_bytes()
    place %= len(data)
    path.write_bytes((data[:place] + what + data[place + cut :])[: len(data) - end])
    sentence = None
    try:
        assert read_points(path).points.shape[1] == 3
    except InputError as error:
        sentence = str(error)
    assert sentence is None or str(path) in sentence


def test_a_coordinate_beyond_single_precision_is_infinite_and_nothing_is_said(tmp_path: Path) -> None:
    path = tmp_path / "far.pcd"
    path.write_text(pcd() + "1 -3e151 2\n4 5 6\n")
    assert read_points(path).points.tolist() == [[1, -np.inf, 2], [4, 5, 6]]


def pcd(**changes: str) -> str:
    entries = {
        "FIELDS": "x y z", "SIZE": "4 4 4", "TYPE": "F F F", "COUNT": "1 1 1", "WIDTH": "2", "HEIGHT": "1",
        "POINTS": "2", "DATA": "ascii",
    }  # fmt: skip
    entries.update(changes)
    return "".join(f"{k} {v}\n" for k, v in entries.items())


BAD_PCD = {
    "more points than data": (pcd(WIDTH="3", POINTS="3") + "1 2 3\n4 5 6\n", "says 3 points"),
    "points against width": (pcd(POINTS="5") + "1 2 3\n4 5 6\n", "POINTS 5 is not WIDTH 2"),
    "no z": (pcd(FIELDS="x y q") + "1 2 3\n4 5 6\n", "no field z"),
    "size and type": (pcd(SIZE="4 4 3") + "1 2 3\n4 5 6\n", "'z' has TYPE F with SIZE 3"),
    "lengths": (pcd(SIZE="4 4") + "1 2 3\n4 5 6\n", "contradicts itself"),
    "short lines": (pcd() + "1 2\n4 5\n", "hold 2 numbers"),
    "no numbers": (pcd() + "1 2 3\n4 five 6\n", "cannot be read"),
    "ragged": (pcd() + "1 2 3\n4 5\n", "cannot be read"),
    "encoding": (pcd(DATA="zip") + "1 2 3\n4 5 6\n", "DATA 'zip' is unknown"),
    "no data": ("FIELDS x y z\n", "without DATA"),
    "negative": (pcd(WIDTH="-2") + "1 2 3\n4 5 6\n", "WIDTH '-2'"),
    "no pcd": ("hello\n", "line 1: 'hello'"),
    "empty": ("", "line 1 without DATA"),
    "binary too short": (pcd(DATA="binary") + "12345", "the file holds 0"),
    "compressed too short": (pcd(DATA="binary_compressed") + "123", "end before"),
    "compressed lies": (pcd(DATA="binary_compressed") + "\x05\0\0\0\x18\0\0\0ab", "the header needs 5"),
    "compressed broken": (pcd(DATA="binary_compressed") + "\x02\0\0\0\x18\0\0\0\x7fb", "damaged"),
}


@pytest.mark.parametrize("case", BAD_PCD)
def test_bad_pcd_names_the_file_and_the_place(case: str, tmp_path: Path) -> None:
    text, said = BAD_PCD[case]
    path = tmp_path / "bad.pcd"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError) as error:
        read_points(path)
    assert str(path) in str(error.value)
    assert said in str(error.value)


def ply(head: str, body: str = "1 2 3\n4 5 6\n") -> str:
    return f"ply\n{head}end_header\n{body}"


XYZ = "property float x\nproperty float y\nproperty float z\n"
ASCII = "format ascii 1.0\n"
BAD_PLY = {
    "no ply": ("plx\n", "first line is not 'ply'"),
    "no end": ("ply\nformat ascii 1.0\n", "without end_header"),
    "no format": (ply("element vertex 2\n" + XYZ), "has no format"),
    "unknown format": (ply("format morse 1.0\n"), "line 2: bad PLY header"),
    "property before element": (ply(ASCII + XYZ), "line 3: bad PLY header"),
    "unknown type": (ply(ASCII + "element vertex 2\nproperty quaternion x\n"), "line 4: bad PLY header"),
    "no vertex": (ply(ASCII + "element face 2\n" + XYZ), "no element 'vertex'"),
    "no z": (ply(ASCII + "element vertex 2\nproperty float x\nproperty float y\nproperty float q\n"), "no field z"),
    "too few lines": (ply(ASCII + "element vertex 3\n" + XYZ), "says 3 points, the file holds 2"),
    "short lines": (ply(ASCII + "element vertex 2\n" + XYZ, "1 2\n3 4\n"), "hold 2 numbers"),
    "list": (ply(ASCII + "element vertex 2\nproperty list uchar int x\n"), "list property"),
    "binary too short": (ply("format binary_little_endian 1.0\nelement vertex 9\n" + XYZ), "the file holds 1"),
}


@pytest.mark.parametrize("case", BAD_PLY)
def test_bad_ply_names_the_file_and_the_place(case: str, tmp_path: Path) -> None:
    text, said = BAD_PLY[case]
    path = tmp_path / "bad.ply"
    path.write_text(text)
    with pytest.raises(InputError) as error:
        read_points(path)
    assert str(path) in str(error.value)
    assert said in str(error.value)


def test_records_are_points_and_their_intensities(tmp_path: Path) -> None:
    raw = np.random.default_rng(0).random((50, 4)).astype(np.float32)
    raw.tofile(tmp_path / "a.bin")
    back = read_points(tmp_path / "a.bin", KITTI)
    assert back.intensity is not None
    np.testing.assert_array_equal(np.column_stack([back.points, back.intensity]), raw)


@pytest.mark.parametrize(
    ("size", "said"), [(17, "after point 1"), (60, "records are of 12, 15, 20, 30, 60 bytes"), (3, "point 0")]
)
def test_truncated_bin_says_size_and_what_it_could_be(size: int, said: str, tmp_path: Path) -> None:
    path = tmp_path / "000007.bin"
    path.write_bytes(bytes(size))
    with pytest.raises(InputError, match="000007") as error:
        read_points(path, KITTI)
    assert f"{size} bytes" in str(error.value)
    assert said in str(error.value)


@pytest.mark.parametrize("suffix", [".bin", ".pcd", ".ply", ".npy", ".txt", ".las"])
def test_missing_file(suffix: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="none"):
        read_points(tmp_path / f"none{suffix}")


def test_npy_of_other_shapes(tmp_path: Path) -> None:
    organised = np.arange(2 * 3 * 3, dtype=np.float64).reshape(2, 3, 3)
    np.save(tmp_path / "organised.npy", organised)
    np.testing.assert_array_equal(read_points(tmp_path / "organised.npy").points, organised.reshape(6, 3))
    np.save(tmp_path / "flat.npy", np.zeros(9))
    with pytest.raises(InputError, match="shape"):
        read_points(tmp_path / "flat.npy")
    np.save(tmp_path / "text.npy", np.array([["a", "b", "c"]]))
    with pytest.raises(InputError, match="text"):
        read_points(tmp_path / "text.npy")
    (tmp_path / "junk.npy").write_bytes(b"junk")
    with pytest.raises(InputError, match="junk"):
        read_points(tmp_path / "junk.npy")


def test_writers_refuse_what_makes_no_sense(tmp_path: Path) -> None:
    points, intensity = cloud(3)
    with pytest.raises(UsageError, match="suffixes"):
        write_points(tmp_path / "a.xyz", points)
    with pytest.raises(UsageError, match="intensity"):
        write_points(tmp_path / "a.bin", points, intensity[:2])
    with pytest.raises(OutputError, match="nowhere"):
        write_points(tmp_path / "nowhere" / "a.ply", points)
    assert not list(tmp_path.iterdir())


def test_a_full_disk_leaves_the_old_file_and_no_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points, _ = cloud(3)
    path = tmp_path / "map.ply"
    write_points(path, points)
    before = path.read_bytes()

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("lslam.io.formats.atomic.os.replace", full)
    with pytest.raises(OutputError, match="No space left"):
        write_points(path, points[:1])
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["map.ply"]


@pytest.mark.parametrize("kind", ["binary.pcd", "ascii.pcd", "binary.ply", "ascii.ply"])
@pytest.mark.parametrize("end", ["points", "zeros", "faces"])
def test_points_that_a_header_does_not_count_are_named(kind: str, end: str, tmp_path: Path) -> None:
    """Zeros that fill a file up, or another element, are none."""
    encoding, suffix = kind.split(".")
    path = tmp_path / f"a.{suffix}"
    points, _ = cloud(20)
    counted = 20 - 5 * (end == "points")
    body = points.tobytes() if encoding == "binary" else b"".join(b"%r %r %r\n" % tuple(p) for p in points.tolist())
    if suffix == "pcd":
        head = f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {counted}\nHEIGHT 1\nDATA {encoding}\n"
    else:
        faces = "element face 5\nproperty list uchar int vertex_indices\n" if end == "faces" else ""
        axes = "".join(f"property float {axis}\n" for axis in "xyz")
        form = "ascii" if encoding == "ascii" else "binary_little_endian"
        head = f"ply\nformat {form} 1.0\nelement vertex {counted}\n{axes}{faces}end_header\n"
    more = {"points": b"", "zeros": bytes(4096), "faces": 5 * struct.pack("<B3i", 3, 0, 1, 2)}[end]
    if encoding == "ascii":
        more = b"3 0 1 2\n" * 5 * (end == "faces")
    path.write_bytes(head.encode() + body + (more if suffix == "ply" or end == "zeros" else b""))
    back = read_points(path)
    np.testing.assert_allclose(back.points, points[:counted], rtol=1e-6)
    assert back.unread == (("5 points behind the 15 of the header",) if end == "points" else ())
