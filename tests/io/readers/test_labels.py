"""Classes of points, in SemanticKITTI's files and in fields of clouds, from the disk to what a run is given."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from sequence_builders import cloud, kitti_root, scans
from stub_sequences import sample

from lslam.core.config import Config, load_config
from lslam.core.errors import ConfigError, InputError
from lslam.core.labels import CLASSES, numbers_of
from lslam.core.types.scan import Scan
from lslam.core.types.sequence import Sequence
from lslam.io.formats.point_cloud import cloud_from_fields
from lslam.io.readers import open_sequence
from lslam.io.readers.sequence_on_disk import add_labels
from lslam.odometry import create_odometry
from lslam.pipeline.convert.convert_sequence import convert_sequence
from lslam.pipeline.job import choose_scans
from lslam.registration.preprocessing.views import FurtherLidar, MergedLidars

POINTS = 300
CLASS_OF = np.tile(np.array([10, 40, 50, 252, 259], np.uint16), POINTS // 5)


def labelled_kitti(root: Path, count: int = 6) -> Path:
    """A KITTI sequence with SemanticKITTI's labels, whose upper halves number instances."""
    folder = kitti_root(root, count)
    (folder / "labels").mkdir()
    for k in range(count):
        instances = np.arange(POINTS, dtype=np.uint32) << 16
        (folder / "labels" / f"{k:06d}.label").write_bytes((instances | np.roll(CLASS_OF, k)).astype("<u4").tobytes())
    return folder


def chosen(sequence: Sequence, *dropped: str) -> Sequence:
    config = load_config(settings=[f"preprocess.drop_labels={list(dropped)}"])
    return choose_scans(sequence, create_odometry(config), config)


def write_pcd(path: Path, table: NDArray[np.float32], labels: NDArray[np.uint16]) -> None:
    """As PCL writes PointXYZL: the label is a number of 32 bits."""
    n = len(table)
    head = (
        "VERSION 0.7\nFIELDS x y z label\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\n"
        f"WIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA binary\n"
    )
    path.write_bytes(head.encode() + rows(table, labels, "<u4"))


def write_ply(path: Path, table: NDArray[np.float32], labels: NDArray[np.uint16]) -> None:
    """As CloudCompare writes a scalar field."""
    fields = "".join(f"property float {name}\n" for name in ("x", "y", "z", "scalar_Classification"))
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(table)}\n{fields}end_header\n"
    path.write_bytes(head.encode() + rows(table, labels, "<f4"))


def rows(table: NDArray[np.float32], labels: NDArray[np.uint16], kind: str) -> bytes:
    packed = np.empty(len(table), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("label", kind)])
    packed["x"], packed["y"], packed["z"], packed["label"] = *table[:, :3].T, labels
    return packed.tobytes()


def test_labels_beside_the_scans_are_those_of_their_points(tmp_path: Path) -> None:
    sequence = open_sequence(labelled_kitti(tmp_path))
    assert sequence.scan(2).labels is None, "nobody asked for them"
    scan = add_labels(sequence).scan(2)
    assert scan.labels is not None
    assert scan.labels.dtype == np.uint16
    assert scan.labels.tolist() == np.roll(CLASS_OF, 2).tolist()


def test_dropped_classes_are_gone_with_all_that_their_points_have(tmp_path: Path) -> None:
    sequence = open_sequence(labelled_kitti(tmp_path))
    left, whole = chosen(sequence, "car", "moving").scan(1), sequence.scan(1)
    is_left = np.isin(np.roll(CLASS_OF, 1), (40, 50))
    assert whole.intensity is not None
    assert left.intensity is not None
    assert np.array_equal(left.points, whole.points[is_left])
    assert np.array_equal(left.intensity, whole.intensity[is_left])
    assert not left.fault


def test_nothing_is_wrapped_where_nothing_is_dropped(tmp_path: Path) -> None:
    sequence = open_sequence(labelled_kitti(tmp_path))
    assert choose_scans(sequence, create_odometry(Config()), Config()) is sequence


@pytest.mark.parametrize(("suffix", "write"), [(".pcd", write_pcd), (".ply", write_ply)])
def test_a_field_of_a_point_file_is_read(suffix: str, write: object, tmp_path: Path) -> None:
    folder = scans(tmp_path / "drive", 3, suffix)
    for k, path in enumerate(sorted(folder.iterdir())):
        write(path, cloud(k), CLASS_OF)  # type: ignore[operator]
    sequence = open_sequence(folder)
    labels = sequence.scan(1).labels
    assert labels is not None
    assert labels.tolist() == CLASS_OF.tolist()
    assert len(chosen(sequence, "50", "40").scan(0)) == POINTS * 3 // 5


@pytest.mark.parametrize("kind", ["bag", "mcap", "kitti"])
def test_labels_survive_conversion(kind: str, tmp_path: Path) -> None:
    drive = sample(3)
    classes = [(np.arange(len(scan)) % 7 * 40).astype(np.uint16) for scan in drive.scans if isinstance(scan, Scan)]
    of_scans = zip(drive.scans, classes, strict=True)
    drive = replace(drive, scans=[replace(s, labels=c) for s, c in of_scans if isinstance(s, Scan)])
    out = tmp_path / f"out.{kind}" if kind != "kitti" else tmp_path / "out"
    convert_sequence(drive, kind, out)
    back = add_labels(open_sequence(out))
    for k, own in enumerate(classes):
        labels = back.scan(k).labels
        assert labels is not None
        assert labels.tolist() == own.tolist()


def test_tags_of_livox_are_classes_by_number() -> None:
    columns = {axis: np.arange(1.0, 5.0) for axis in "xyz"} | {"tag": np.array([0, 16, 48, 16], np.uint8)}
    read = cloud_from_fields(Path("a"), columns)
    assert read.labels is not None
    assert read.labels.tolist() == [0, 16, 48, 16]
    assert "tag" in read.fields
    both = cloud_from_fields(Path("a"), columns | {"label": np.array([1, 2, 3, 4], np.int32)})
    assert both.labels is not None
    assert both.labels.tolist() == [1, 2, 3, 4]
    shares = cloud_from_fields(Path("a"), {**columns, "class": np.array([0.5, 1.0, 2.0, 3.0])})
    assert shares.labels is not None
    assert shares.labels.tolist() == [0, 16, 48, 16], "a class is a whole number"


def test_points_of_merged_lidars_keep_their_classes() -> None:
    one, other = sample(3), sample(3)
    scans = [replace(s, labels=np.full(len(s), 50, np.uint16)) for s in one.scans if isinstance(s, Scan)]
    others = [replace(s, labels=np.full(len(s), 10, np.uint16)) for s in other.scans if isinstance(s, Scan)]
    merged = MergedLidars(replace(one, scans=scans), [FurtherLidar("b", replace(other, scans=others), np.eye(4))])
    scan = chosen(merged, "car").scan(1)
    assert scan.lidars is not None
    assert len(scan)
    assert not scan.lidars.any()


@pytest.mark.parametrize("fault", ["missing", "short", "empty"])
def test_a_scan_whose_labels_are_broken_stays_whole_and_says_so(fault: str, tmp_path: Path) -> None:
    folder = labelled_kitti(tmp_path)
    path = folder / "labels" / "000003.label"
    path.unlink() if fault == "missing" else path.write_bytes(path.read_bytes()[:-4] if fault == "short" else b"")
    sequence = chosen(open_sequence(folder), "moving")
    assert "000003.label" in sequence.scan(3).fault
    assert len(sequence.scan(3)) == POINTS
    assert not sequence.scan(4).fault
    assert len(sequence.scan(4)) == POINTS * 3 // 5


def test_a_recording_without_labels_is_refused(tmp_path: Path) -> None:
    folder = labelled_kitti(tmp_path / "broken", 3)
    for path in (folder / "labels").iterdir():
        path.write_bytes(b"123")
    for given in (kitti_root(tmp_path / "plain", 3), folder):
        with pytest.raises(InputError, match="needs labels"):
            chosen(open_sequence(given), "car")


def test_unknown_classes_are_refused_with_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"'tree' is no class of points.*vegetation"):
        load_config(settings=["preprocess.drop_labels=car,tree"])
    for wrong in ("70000", "[-1]", "[true]", "[1.5]"):
        with pytest.raises(ConfigError, match="is no class"):
            load_config(settings=[f"preprocess.drop_labels={wrong}"])
    assert load_config(settings=["preprocess.drop_labels=[252, 'car']"]).preprocess.drop_labels == ("252", "car")
    assert load_config(settings=["preprocess.drop_labels=moving"]).preprocess.drop_labels == ("moving",)
    assert numbers_of(["moving"]) == {number for number in CLASSES.values() if number > 250}
