"""Names a user types, and the part of a sequence a user asks for."""

from __future__ import annotations

from pathlib import Path

import pytest
from sequence_builders import kitti_root, raw_drive

from lslam.core.errors import InputError, UsageError
from lslam.core.types.sequence import select
from lslam.io.readers import find_folder, open_sequence


@pytest.mark.parametrize("name", ["seq07", "07", "7", "kitti/07"])
@pytest.mark.parametrize("below", ["", "dataset", "kitti"])
def test_sequence_names(name: str, below: str, tmp_path: Path) -> None:
    folder = kitti_root(tmp_path / below, 1) if below else kitti_root(tmp_path, 1)
    assert find_folder(name, tmp_path) == folder


@pytest.mark.parametrize(
    "name", ["2011_09_26_drive_0005_sync", "2011_09_26_drive_0005", "drive_0005", "0005", "0005_sync"]
)
@pytest.mark.parametrize("below", ["", "raw"])
def test_drive_names(name: str, below: str, tmp_path: Path) -> None:
    folder = raw_drive(tmp_path / below, 1) if below else raw_drive(tmp_path, 1)
    assert find_folder(name, tmp_path) == folder


def test_ambiguous_and_unknown_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    raw_drive(tmp_path, 1)
    raw_drive(tmp_path, 1, "2011_09_26_drive_0005_extract")
    with pytest.raises(InputError, match="may be any of"):
        find_folder("0005", tmp_path)
    with pytest.raises(InputError, match="2011_09_26_drive_0005_sync"):
        find_folder("2011_09_26_drive_0006_sync", tmp_path)
    with pytest.raises(InputError, match=r"data root .*nowhere does not exist"):
        find_folder("07", tmp_path / "nowhere")
    monkeypatch.delenv("LSLAM_DATA", raising=False)
    with pytest.raises(InputError, match="--data-root or LSLAM_DATA"):
        find_folder("seq07")
    file = tmp_path / "a.pcd"
    file.write_bytes(b"")
    with pytest.raises(InputError, match="is a file"):
        find_folder(file)


def test_environment_names_the_data_root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = kitti_root(tmp_path, 1)
    monkeypatch.setenv("LSLAM_DATA", str(tmp_path))
    assert find_folder("seq07") == folder


@pytest.mark.parametrize("name", ["seq07", "07", "kitti/07"])
def test_the_current_folder_is_a_data_root_too(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("LSLAM_DATA", raising=False)
    folder = kitti_root(tmp_path / "kitti", 1)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path)
    assert find_folder(name) == folder
    assert find_folder(name, tmp_path / "elsewhere") == folder


def test_relative_paths_and_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = kitti_root(tmp_path / "disk", 2)
    monkeypatch.chdir(folder)
    s = open_sequence(".")
    assert (s.name, s.path) == ("seq07", folder)
    assert s.ground_truth is not None
    (tmp_path / "home" / "sequences").mkdir(parents=True)
    (tmp_path / "home" / "sequences" / "07").symlink_to(folder)
    (tmp_path / "home" / "poses").mkdir()
    (tmp_path / "disk" / "poses" / "07.txt").rename(tmp_path / "home" / "poses" / "07.txt")
    assert open_sequence(tmp_path / "home").ground_truth is not None
    assert open_sequence(folder).ground_truth is None


def test_selection_keeps_indices_stamps_and_truth(tmp_path: Path) -> None:
    s = open_sequence(kitti_root(tmp_path, 10))
    part = select(s, start=2, count=3, skip_frames=3)
    assert len(part) == 3
    assert [part.scan(k).index for k in range(3)] == [2, 5, 8]
    assert part.stamps_ns.tolist() == [part.scan(k).stamp_ns for k in range(3)]
    assert part.ground_truth is s.ground_truth
    assert (part.name, part.rate_hz) == (s.name, s.rate_hz)
    with pytest.raises(IndexError):
        part.scan(3)
    with pytest.raises(IndexError):
        part.scan(-1)


def test_a_selection_keeps_the_facts_about_the_sensor() -> None:
    whole = open_sequence(Path(__file__).resolve().parents[3] / "sample_data")
    part = select(whole, count=10)
    assert (part.sensor, part.rings) == (whole.sensor, whole.rings)  # type: ignore[attr-defined]
    assert part.rings is not None  # type: ignore[attr-defined]


def test_selection_of_everything_is_the_sequence(tmp_path: Path) -> None:
    s = open_sequence(kitti_root(tmp_path, 3))
    assert select(s) is s
    assert select(s, count=99) is s


@pytest.mark.parametrize("bad", [{"start": 3}, {"start": -1}, {"count": 0}, {"skip_frames": 0}])
def test_selections_that_leave_nothing(bad: dict[str, int], tmp_path: Path) -> None:
    s = open_sequence(kitti_root(tmp_path, 3))
    with pytest.raises(UsageError):
        select(s, **bad)
