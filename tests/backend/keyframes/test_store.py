"""The store gives back what it got, and says what is wrong with its files."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from lslam.backend.keyframes.store import INDEX, KeyframeStore
from lslam.core.errors import InputError, OutputError
from lslam.core.types.trajectory import Keyframe
from lslam.io.formats.bag_chunks import zstd
from lslam.io.formats.state_files import write_npz

FLOATS = st.floats(width=32, allow_nan=True, allow_infinity=True)
CLOUDS = st.lists(
    st.integers(0, 20).flatmap(lambda n: arrays(np.float32, (n, 3), elements=FLOATS)), min_size=1, max_size=4
)


def keyframe(number: int, covariance: bool = True) -> Keyframe:
    rng = np.random.default_rng(number)
    C = rng.normal(size=(6, 6)) if covariance else None
    return Keyframe(number, 3 * number + 1, 10**18 + number, rng.normal(size=(4, 4)), C, 2.5 * number)


def cloud(seed: int, count: int = 500) -> NDArray[np.float32]:
    return np.random.default_rng(seed).normal(size=(count, 3)).astype(np.float32)


def filled(folder: Path | None, count: int, cache_size: int = 2) -> KeyframeStore:
    store = KeyframeStore(folder, cache_size)
    for k in range(count):
        store.add(keyframe(k, k % 2 == 0), cloud(k))
    return store


@given(CLOUDS)
@settings(max_examples=40)
def test_every_bit_comes_back(clouds: list[NDArray[np.float32]]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        for home in (None, Path(folder) / "keyframes"):
            store = KeyframeStore(home, cache_size=0)
            for k, points in enumerate(clouds):
                store.add(keyframe(k), points)
            for k, points in enumerate(clouds):
                found = store.points(k)
                assert (found.shape, found.dtype) == (points.shape, np.float32)
                assert found.tobytes() == points.tobytes()


def test_a_saved_store_can_be_opened_again(tmp_path: Path) -> None:
    first = filled(tmp_path / "keyframes", 5)
    first.save()
    again = KeyframeStore(tmp_path / "keyframes")
    assert (len(again), again.size) == (5, first.size)
    for a, b in zip(first.keyframes, again.keyframes, strict=True):
        assert (a.number, a.scan, a.stamp_ns, a.distance) == (b.number, b.scan, b.stamp_ns, b.distance)
        np.testing.assert_array_equal(a.T_world_lidar, b.T_world_lidar)
        assert (a.covariance is None) == (b.covariance is None)
        np.testing.assert_array_equal(first.points(a.number), again.points(b.number))


def test_the_same_clouds_make_the_same_bytes(tmp_path: Path) -> None:
    for name in "ab":
        filled(tmp_path / name, 3).save()
    for file in sorted((tmp_path / "a").iterdir()):
        assert file.read_bytes() == (tmp_path / "b" / file.name).read_bytes()
    assert len(list((tmp_path / "a").iterdir())) == 4


def test_clouds_are_packed_on_disk_and_in_memory(tmp_path: Path) -> None:
    points = np.round(cloud(0) * 512) / 512
    on_disk, in_memory = (KeyframeStore(home, cache_size=0) for home in (tmp_path / "packed", None))
    for store in (on_disk, in_memory):
        store.add(keyframe(0), points)
        assert np.array_equal(store.points(0), points)
    assert on_disk.size == in_memory.size < points.nbytes


def test_classes_are_packed_with_their_cloud(tmp_path: Path) -> None:
    points, labels = cloud(3), np.arange(len(cloud(3)), dtype=np.uint16)
    store = KeyframeStore(tmp_path / "keyframes", cache_size=0)
    store.add(keyframe(0), points, labels)
    np.testing.assert_array_equal(store.points(0), points)
    np.testing.assert_array_equal(np.asarray(store.labels(0)), labels)


@pytest.mark.parametrize("level", [0, 1])
def test_clouds_of_an_older_version_are_read(tmp_path: Path, level: int) -> None:
    """Their planes are a member of the archive, stored or deflated."""
    filled(tmp_path, 2).save()
    planes = np.ascontiguousarray(cloud(1).T).view(np.uint8).reshape(3, -1, 4).transpose(2, 0, 1)
    write_npz(tmp_path / "000001.npz", {"planes": planes}, level)
    np.testing.assert_array_equal(KeyframeStore(tmp_path, cache_size=0).points(1), cloud(1))


@pytest.mark.parametrize("data", [b"", b"no zstd", bytes(zstd().compress(b"x" * 25))])
def test_a_cloud_that_was_packed_otherwise_is_damaged(tmp_path: Path, data: bytes) -> None:
    filled(tmp_path, 2).save()
    write_npz(tmp_path / "000001.npz", {"planes.zst": np.frombuffer(data, np.uint8)}, 0)
    with pytest.raises(InputError, match=r"000001\.npz is damaged"):
        KeyframeStore(tmp_path, cache_size=0).points(1)


def test_few_clouds_stay_in_memory(tmp_path: Path) -> None:
    store = filled(tmp_path / "keyframes", 6, cache_size=2)
    for file in (tmp_path / "keyframes").iterdir():
        file.unlink()
    for recent in (4, 5):
        np.testing.assert_array_equal(store.points(recent), cloud(recent))
    with pytest.raises(InputError, match=r"000003\.npz cannot be read"):
        store.points(3)


def test_a_cloud_that_is_handed_out_cannot_be_spoilt() -> None:
    store = filled(None, 1)
    with pytest.raises(ValueError, match="read-only"):
        store.points(0)[:] = 0


def test_numbers_follow_each_other() -> None:
    store = filled(None, 2)
    with pytest.raises(ValueError, match="cannot follow"):
        store.add(keyframe(3), cloud(0))


@pytest.mark.parametrize("name", ["000001.npz", INDEX])
@pytest.mark.parametrize("how", ["cut", "flip", "other", "empty"])
def test_damaged_files_are_named(tmp_path: Path, name: str, how: str) -> None:
    filled(tmp_path, 3).save()
    file = tmp_path / name
    data = file.read_bytes()
    other = (tmp_path / ("000000.npz" if name == INDEX else INDEX)).read_bytes()
    middle = len(data) // 2
    flipped = data[:middle] + bytes([data[middle] ^ 255]) + data[middle + 1 :]
    file.write_bytes({"cut": data[:middle], "flip": flipped, "other": other, "empty": b""}[how])
    with pytest.raises(InputError, match=rf"{name}|index of keyframes"):
        KeyframeStore(tmp_path, cache_size=0).points(1)


def test_an_index_without_its_clouds_is_refused(tmp_path: Path) -> None:
    filled(tmp_path, 3).save()
    (tmp_path / "000002.npz").unlink()
    with pytest.raises(InputError, match="cloud of keyframe 2 is missing"):
        KeyframeStore(tmp_path)


def test_what_cannot_be_written_says_so(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        filled(tmp_path / "file" / "keyframes", 1)


def test_no_keyframes_leave_no_folder(tmp_path: Path) -> None:
    KeyframeStore(tmp_path / "keyframes").save()
    assert not (tmp_path / "keyframes").exists()
