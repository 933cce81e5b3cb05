"""Paths in storage: they answer as a disk's do, survive pickling, and say in one sentence what they cannot."""

from __future__ import annotations

import io
import os
import pickle
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from storages import Counted, counted, stored

from lslam.core.errors import LslamError, StorageError, UsageError
from lslam.io.formats.atomic import atomic_write, write_text
from lslam.io.remote import RemotePath, as_path


@pytest.fixture
def bucket() -> Iterator[RemotePath]:
    with counted() as root:
        yield root


def test_words_become_paths() -> None:
    assert as_path("gs://b/fleet/a.bag") == RemotePath("gs://b/fleet/a.bag")
    assert type(as_path("data/00")) is type(as_path("file:///data/00")) is type(Path())
    assert as_path("file:///data/00") == Path("/data/00")
    place = as_path("s3://b/x/y.bag")
    assert (str(place), place.name, place.suffix, str(place.parent)) == ("s3://b/x/y.bag", "y.bag", ".bag", "s3://b/x")
    assert str(place.with_name("z.bag")) == str(place.parent / "z.bag") == "s3://b/x/z.bag"
    assert str((place / "../../poses/00.txt").resolve()) == "s3://b/poses/00.txt"
    assert str(place.relative_to(RemotePath("s3://b"))) == "x/y.bag"
    assert pickle.loads(pickle.dumps(place)) == place
    assert type(pickle.loads(pickle.dumps(place.parent))) is RemotePath


def test_storage_paths_behave_as_paths_of_a_disk(bucket: RemotePath, tmp_path: Path) -> None:
    for name in ("a/2.txt", "a/10.txt", "a/b/c.csv", "top.txt"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(f"in {name}\nü\n", encoding="utf-8")
    stored(tmp_path, bucket)
    for name in ("", "a", "a/b", "a/2.txt", "none", "a/none", "top.txt/none"):
        here, there = tmp_path / name, bucket / name
        assert (there.exists(), there.is_dir(), there.is_file()) == (here.exists(), here.is_dir(), here.is_file()), name
    assert [p.name for p in (bucket / "a").iterdir()] == sorted(p.name for p in (tmp_path / "a").iterdir())
    assert [p.is_dir() for p in (bucket / "a").iterdir()] == [False, False, True]
    assert [str(p) for p in (bucket / "a").glob("*.txt")] == ["counted://bucket/a/10.txt", "counted://bucket/a/2.txt"]
    assert list((bucket / "none").glob("*")) == []
    assert (bucket / "a/2.txt").read_text("utf-8") == (tmp_path / "a/2.txt").read_text("utf-8")
    with (bucket / "a/2.txt").open(encoding="utf-8") as stream:
        assert stream.readlines() == ["in a/2.txt\n", "ü\n"]
    assert (bucket / "a/2.txt").stat().st_size == (tmp_path / "a/2.txt").stat().st_size
    assert {name: stat.st_size for name, stat in bucket.files()} == {
        p.relative_to(tmp_path).as_posix(): p.stat().st_size for p in tmp_path.rglob("*") if p.is_file()
    }
    with pytest.raises(FileNotFoundError):
        (bucket / "none").read_bytes()


def test_writes_are_visible_at_once_and_have_a_new_time(bucket: RemotePath) -> None:
    place = bucket / "results.csv"
    write_text(place, "one\n")
    before = (bucket / "results.csv").stat().st_mtime_ns
    write_text(place, "two\n")
    assert (place.read_text(), (bucket / "results.csv").stat().st_mtime_ns > before > 1.5e18) == ("two\n", True)
    place.unlink()
    place.unlink(missing_ok=True)
    assert not (bucket / "results.csv").exists()
    with pytest.raises(FileNotFoundError):
        place.unlink()


def test_an_object_whose_writing_fails_is_not_written(bucket: RemotePath) -> None:
    def half(place: RemotePath) -> None:
        with atomic_write(place) as stream:
            stream.write(b"half")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        half(bucket / "x")
    assert not (bucket / "x").exists()


def test_storage_is_refused_where_a_disk_is_needed(bucket: RemotePath) -> None:
    for use in (os.fspath, os.listdir, lambda path: path.open("wb"), io.open):
        with pytest.raises(
            UsageError, match="counted://bucket lies in storage, and here a file or folder of this machine"
        ):
            use(bucket)


class NoCredentialsError(Exception):
    """As botocore has it: no OSError."""


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (PermissionError("Forbidden"), "permission denied (Forbidden)"),
        (NoCredentialsError("Unable to locate credentials"), "no credentials for it are found (Unable to locate"),
        (ConnectionRefusedError(111, "refused"), "the storage does not answer (ConnectionRefusedError"),
        (RuntimeError("a strange\nthing"), "RuntimeError: a strange thing"),
    ],
)
def test_unreadable_storage_is_an_error_in_one_sentence(error: Exception, said: str, bucket: RemotePath) -> None:
    def refuse(verb: str, name: str) -> None:
        raise error

    (bucket / "x").write_bytes(b"x")
    Counted.refuse = staticmethod(refuse)
    with pytest.raises(StorageError) as caught:
        (bucket / "x").read_bytes()
    assert str(caught.value).startswith(f"counted://bucket/x cannot be read: {said}")
    assert caught.value.exit_code == 3
    assert "\n" not in str(caught.value)


def test_the_error_about_a_missing_package_names_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "s3fs", None)
    monkeypatch.setitem(sys.modules, "fsspec.core", None)
    with pytest.raises(UsageError, match=r"s3://b/x: to read s3:// in place takes fsspec: pip install .*\[cloud\]"):
        as_path("s3://b/x").exists()
    monkeypatch.undo()
    monkeypatch.setitem(sys.modules, "gcsfs", None)
    for url, said in (
        ("gs://b/x", r"gs:// is not installed .*\[cloud\]"),
        ("nfs://b/x", "no storage is called nfs://"),
    ):
        with pytest.raises(LslamError, match=said) as caught:
            as_path(url).exists()
        assert caught.value.exit_code == 2
