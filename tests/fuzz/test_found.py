"""What the harness found once: the input, and the words of the sentence it gets now."""

from __future__ import annotations

from pathlib import Path

import pytest
from fuzz.cases import lay_out
from fuzz.parsers import PARSERS
from fuzz.texts import CORRECTED

from lslam.core.config.study import Range
from lslam.core.errors import InputError, LslamError
from lslam.io.readers import open_sequence
from lslam.pipeline.rebuild import read_run

DIGITS = b"9" * 5000
DEEP = b"[" * 5000
_NPY = b"\x93NUMPY\x01\x00\x76\x00%-118b"
_NOWHERE = CORRECTED.replace("[49.0, 8.4, 0.0]", "[49.0, NaN, 0.0]").encode()
_LINE = b'{"type": "Feature", "geometry": {"type": "LineString", "coordinates": [[8.4, 49, 9], [8.5, 49, 9], [8.6, 49, 9]]}}'
_TWO_LINES = b'{"type": "FeatureCollection", "features": [' + _LINE + b", " + _LINE + b"]}"
BY_NAME = {parser.name: parser for parser in PARSERS}


@pytest.mark.parametrize(
    ("name", "file", "data", "words"),
    [
        ("sequence.toml", "sequence.toml", b"rings = " + DIGITS, "thousands of digits"),
        ("sequence.toml", "sequence.toml", b"rate_hz = 1e300", "rate_hz = 1e"),
        ("sequence.toml", "sequence.toml", b"rate_hz = 1e-300", "rate_hz = 1e"),
        ("sequence.toml", "sequence.toml", b"rate_hz = 1" + b"0" * 400, "64 bits"),
        ("batch", "b.toml", b"a = " + DIGITS, "thousands of digits"),
        ("way-points, TOML", "w.toml", b"points = [[1" + b"0" * 400 + b", 0]]", "64 bits"),
        ("way-points, GeoJSON", "w.geojson", DEEP, "deep"),
        ("way-points, GeoJSON", "w.geojson", b'{"type":"FeatureCollection","features":3}', "no GeoJSON"),
        ("way-points, csv", "w.csv", b"x,y\n" + b"e" * 140_000, "field larger"),
        ("perturbed map", "p.json", DEEP, "deep"),
        ("GeoJSON line", "line.geojson", b"[1]", "no GeoJSON"),
        ("GeoJSON line", "line.geojson", _TWO_LINES, "no GeoJSON of one line"),
        ("timing.csv", "timing.csv", b"total\n" + b"1" * 140_000, "field larger"),
        ("stamps", "stamps.txt", b"0\n9999-01-01 00:00:00\n", "line 2"),
        ("PCD", "a.pcd", b"FIELDS x\nSIZE \xc2\xb2\nTYPE F\nCOUNT 1\nDATA ascii\n", "does not exist"),
        ("PCD", "a.pcd", b"FIELDS x\nSIZE 4\nTYPE F\nWIDTH " + DIGITS + b"\nDATA ascii\n", "no whole number"),
        ("PLY", "a.ply", b"ply\nformat ascii 1.0\nelement vertex " + DIGITS + b"\n", "bad PLY header"),
        ("NumPy", "a.npy", _NPY % b"{'descr': '<f4', 'shape': (9999999999999999999, 4), 'fortran_order': 0}", "NumPy array"),
        ("NumPy", "a.npy", _NPY % b"{'descr': '<f4', 3.5: (1, 4), 'fortran_order': False}", "NumPy array"),
        ("buildings.geojson", "buildings.geojson", _NOWHERE, "its origin"),
        ("KITTI calibration", "calib.txt", b"Tr: 1e308 1e308 0 0 1e308 1e308 0 0 0 0 1e308 0", "no rotation"),
        ("study", "s.toml", b'methods=["icp"]\n[parameters]\n"map.voxel"={start=1,stop=2,step=1e-10}', "more than 10000 values"),
        ("study", "s.toml", b'methods=["icp"]\n[parameters]\n"map.voxel"={start=0,stop=1e308,step=1}', "more than 10000 values"),
    ],
)  # fmt: skip
def test_it_is_refused_with_a_sentence(tmp_path: Path, name: str, file: str, data: bytes, words: str) -> None:
    lay_out(tmp_path, {file: data})
    with pytest.raises(LslamError) as caught:
        BY_NAME[name].read(tmp_path)
    assert words in str(caught.value)
    assert str(tmp_path / file) in str(caught.value)


@pytest.mark.parametrize(
    ("file", "data"),
    [
        ("map.json", b"null"),
        ("map.json", b'{"georeference": {"origin_lat_lon_height": [NaN, 0, 0]}}'),
        ("map.json", DEEP),
    ],
)
def test_a_note_that_is_none_does_not_hide_the_map(tmp_path: Path, file: str, data: bytes) -> None:
    parser = BY_NAME["run folder"]
    lay_out(tmp_path, parser.corpus(tmp_path / "corpus")[0] | {file: data})
    parser.read(tmp_path)


def test_scans_csv_with_odd_lines(tmp_path: Path) -> None:
    good = BY_NAME["run folder"].corpus(tmp_path / "corpus")[0]
    table = good["scans.csv"]
    for k, (data, words) in enumerate(
        [
            (table.replace(b"\n2", b"\n\n2"), ""),  # an empty line says nothing
            (table.replace(b"ok", b"\xff"), "does not list the 5 scans"),
            (table.replace(b"\n2,0,ok,", b"\n2,0"), "does not list the 5 scans"),
            (b"", "does not list the 5 scans"),
        ]
    ):
        lay_out(tmp_path / str(k), good | {"scans.csv": data})
        if not words:
            assert read_run(tmp_path / str(k)).statuses == ("ok",) * 5
            continue
        with pytest.raises(InputError, match=words):
            read_run(tmp_path / str(k))


def test_oxts_off_the_earth_or_without_time(tmp_path: Path) -> None:
    good = BY_NAME["KITTI raw"].corpus(tmp_path / "corpus")[0]
    drive = "2011_09_26/2011_09_26_drive_0005_sync"
    sample = f"{drive}/oxts/data/0000000001.txt"
    for k, (file, data) in enumerate(
        [
            (sample, good[sample].replace(b"49.0", b"490", 1)),
            (sample, good[sample].replace(b" 0.0", b" -1e308", 1)),
            (f"{drive}/oxts/timestamps.txt", b"0\n0\n0\n"),
        ]
    ):
        lay_out(tmp_path / str(k), good | {file: data})
        assert open_sequence(tmp_path / str(k) / drive).ground_truth is None


def test_names_that_no_disk_takes() -> None:
    with pytest.raises(InputError, match="name too long"):
        open_sequence("a" * 400)
    with pytest.raises(LslamError, match="neither numbers nor a file"):
        open_sequence(Path(__file__).parents[2] / "sample_data", extrinsics="a" * 300)
    with pytest.raises(ValueError, match="more than"):
        Range(start=0, stop=1, num=10**9)


@pytest.mark.parametrize("problems", [b"null", b"3"])
def test_a_manifest_whose_problems_are_none(tmp_path: Path, problems: bytes) -> None:
    good = BY_NAME["run folder"].corpus(tmp_path / "corpus")[0]
    manifest = good["manifest.json"].replace(b'["one"]', problems).replace(b'"interrupted"', b'"done"')
    lay_out(tmp_path, good | {"manifest.json": manifest})
    with pytest.raises(LslamError, match="finished"):
        BY_NAME["run folder"].read(tmp_path)


def test_many_keys_that_a_configuration_lacks_are_some_in_a_sentence(tmp_path: Path) -> None:
    good = BY_NAME["run folder"].corpus(tmp_path / "corpus")[0]
    lay_out(tmp_path, good | {"config.toml": good["config.toml"][:60]})
    with pytest.raises(LslamError, match=r"an earlier lslam, which had no \S+, .* and \d+ more;") as caught:
        BY_NAME["run folder"].read(tmp_path)
    assert len(str(caught.value)) < 500
