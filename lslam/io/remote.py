"""Object storage in place of a disk: what lies at `s3://`, `gs://` or another URL of fsspec is a path as any other.

Readers ask a path what is there, list it and open it; a `RemotePath` answers from storage, and nothing is copied. What only
a disk has (a file that grows, a lock, a rename) it does not have: `os.fspath` of it raises UsageError.
"""

from __future__ import annotations

import fnmatch
import io
import logging
import os
import posixpath
import re
import stat
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from functools import cache
from pathlib import Path, PosixPath
from typing import Any

from lslam.core.errors import LslamError, OutputError, StorageError, UsageError, sentence
from lslam.core.extras import install_command

_URL = re.compile(r"[a-z][a-z0-9+.-]*://")
_DISK = "file://"
# When a thing was last written, as the file systems of fsspec name it.
_TIMES = ("LastModified", "last_modified", "mtime", "updated", "created")
_NO_CREDENTIALS = ("NoCredentialsError", "PartialCredentialsError", "DefaultCredentialsError", "RefreshError")
_NO_CONNECTION = re.compile(r"Connect|Timeout|gaierror|Endpoint|ServerDisconnected")


def as_path(place: str | Path) -> Path:
    """The path of a word: one in storage for a URL, else one of the disk; a path stays what it is.

    >>> as_path("s3://bucket/drive7.bag").parent
    RemotePath('s3://bucket')
    >>> as_path("file:///data/drive7.bag").as_posix(), as_path("data").as_posix()
    ('/data/drive7.bag', 'data')
    """
    if isinstance(place, Path):
        return place
    if place.startswith(_DISK):
        return Path(place.removeprefix(_DISK))
    return RemotePath(place) if _URL.match(place) else Path(place)


class RemotePath(PosixPath):
    """A place in storage. Everything asks the storage anew, but for paths that a folder's listing has just told of.

    Raises FileNotFoundError for what is not there, StorageError for what cannot be asked (permission, credentials, network),
    UsageError where the extra is missing.
    """

    def __str__(self) -> str:
        scheme, *rest = self.parts or (".",)
        # Relative to another one it is a name in storage, and no URL.
        return f"{scheme}//{'/'.join(rest)}" if scheme.endswith(":") else "/".join((scheme, *rest))

    def __fspath__(self) -> str:
        raise UsageError(f"{self} lies in storage, and here a file or folder of this machine is needed: copy it")

    def __reduce__(self) -> tuple[Any, ...]:
        return RemotePath, (str(self),)

    def as_posix(self) -> str:
        """The URL."""
        return str(self)

    def absolute(self) -> RemotePath:
        """Itself: a URL is nothing relative."""
        return self

    def resolve(self, strict: bool = False) -> RemotePath:
        """Without `..`; storage has no links."""
        scheme, *rest = self.parts
        return RemotePath(f"{scheme}//{posixpath.normpath('/'.join(rest))}")

    def expanduser(self) -> RemotePath:
        """Itself."""
        return self

    def stat(self, *, follow_symlinks: bool = True) -> os.stat_result:
        """Kind, size and time of the last change."""
        return _stat(self._info())

    def exists(self, *, follow_symlinks: bool = True) -> bool:
        """Whether there is an object of this name, or one below it."""
        return self._kind() != ""

    def is_dir(self, **_: Any) -> bool:
        """Whether there are objects below it."""
        return self._kind() == "directory"

    def is_file(self, **_: Any) -> bool:
        """Whether it is an object."""
        return self._kind() == "file"

    def iterdir(self) -> Generator[RemotePath, None, None]:
        """What lies in it, in the order of the names."""
        with _asking(self, "listed") as (system, place):
            entries = system.ls(place, detail=True)
        for entry in sorted(entries, key=lambda entry: str(entry["name"])):
            name = str(entry["name"]).rstrip("/").rpartition("/")[2]
            if name and str(entry["name"]).strip("/") != place.strip("/"):
                yield self._told(name, entry)

    def glob(self, pattern: str, **_: Any) -> Generator[RemotePath, None, None]:
        """Of one level."""
        try:
            yield from (path for path in self.iterdir() if fnmatch.fnmatchcase(path.name, pattern))
        except FileNotFoundError:
            return

    def files(self) -> Iterator[tuple[str, os.stat_result]]:
        """Name below it and `stat` of every object, in the order of the names: one request for a thousand of them."""
        with _asking(self, "listed") as (system, place):
            found = system.find(place, detail=True)
        for name in sorted(found):
            yield name.strip("/").removeprefix(place.strip("/")).lstrip("/"), _stat(found[name])

    def read_bytes(self) -> bytes:
        """All of the object."""
        with _asking(self, "read") as (system, place):
            return bytes(system.cat_file(place))

    def read_text(self, encoding: str | None = None, errors: str | None = None, newline: str | None = None) -> str:
        """All of the object as text."""
        with self.open(encoding=encoding, errors=errors, newline=newline) as stream:
            return str(stream.read())

    def open(
        self, mode: str = "r", buffering: int = -1, encoding: str | None = None, errors: str | None = None,
        newline: str | None = None,
    ) -> Any:  # fmt: skip
        """A stream over all of the object; raises UsageError for any other mode than reading."""
        if set(mode) - set("rbt"):
            os.fspath(self)
        stream = io.BytesIO(self.read_bytes())
        return stream if "b" in mode else io.TextIOWrapper(stream, encoding, errors, newline)

    def read_ranges(self, ranges: Sequence[tuple[int, int]]) -> list[bytes]:
        """The bytes [begin, end) of the object for each of `ranges`, asked for together."""
        with _asking(self, "read") as (system, place):
            if len(ranges) == 1:
                return [bytes(system.cat_file(place, start=ranges[0][0], end=ranges[0][1]))]
            begins, ends = zip(*ranges, strict=True)
            found = system.cat_ranges([place] * len(ranges), list(begins), list(ends), on_error="raise")
            return [bytes(data) for data in found]

    def mkdir(self, mode: int = 0o777, parents: bool = False, exist_ok: bool = False) -> None:
        """Nothing: folders of storage are names."""

    def write_bytes(self, data: Any) -> int:
        """Put an object there, which is whole at once."""
        with _asking(self, "written") as (system, place):
            system.pipe_file(place, bytes(data))
        return len(data)

    def upload(self, file: Path) -> None:
        """Put the object of a file of this machine there, which is whole at once; a large one goes in parts."""
        with _asking(self, "written") as (system, place):
            system.put_file(str(file), place)

    def unlink(self, missing_ok: bool = False) -> None:
        """Remove the object."""
        try:
            with _asking(self, "removed") as (system, place):
                system.rm_file(place)
        except FileNotFoundError:
            if not missing_ok:
                raise

    def _told(self, name: str, info: dict[str, Any]) -> RemotePath:
        path = self / name
        path.__dict__["_known"] = info
        return path

    def _info(self) -> dict[str, Any]:
        known = self.__dict__.get("_known")
        if known is None:
            with _asking(self, "read") as (system, place):
                known = system.info(place)
            self.__dict__["_known"] = known
        return dict(known)

    def _kind(self) -> str:
        try:
            return str(self._info()["type"])
        except (FileNotFoundError, NotADirectoryError):
            return ""


def _stat(info: dict[str, Any]) -> os.stat_result:
    mode = stat.S_IFDIR if info["type"] == "directory" else stat.S_IFREG
    size, changed_ns = int(info.get("size") or 0), _changed_ns(info)
    second = changed_ns // 10**9
    return os.stat_result((mode, 0, 0, 1, 0, 0, size, second, second, second), {"st_mtime_ns": changed_ns})


def _changed_ns(info: dict[str, Any]) -> int:
    said = next((info[name] for name in _TIMES if info.get(name) is not None), 0)
    if isinstance(said, str):
        try:
            said = datetime.fromisoformat(said)
        except ValueError:
            return 0
    return int((said.timestamp() if isinstance(said, datetime) else float(said)) * 1e6) * 1000


@contextmanager
def _asking(path: RemotePath, what: str) -> Iterator[tuple[Any, str]]:
    """The file system of a path and its name there; what goes wrong in the block is said in one sentence."""
    scheme = str(path).partition("://")[0]
    try:
        from fsspec.core import url_to_fs
    except ImportError:
        raise UsageError(f"{path}: to read {scheme}:// in place takes fsspec: {install_command('cloud')}") from None
    _silence()
    try:
        system, place = url_to_fs(str(path), use_listings_cache=False)
        yield system, place
    except ImportError as error:
        raise UsageError(f"{path}: {scheme}:// is not installed ({error}): {install_command('cloud')}") from None
    except (LslamError, FileNotFoundError, NotADirectoryError):
        raise
    except Exception as error:
        if isinstance(error, ValueError) and "rotocol not known" in str(error):
            raise UsageError(f"{path}: no storage is called {scheme}://; s3:// and gs:// are") from None
        if isinstance(error, OSError) and error.errno == 28:
            raise OutputError(f"{path} cannot be {what}: {error.strerror}") from None
        raise StorageError(f"{path} cannot be {what}: {_reason(error)}") from None


@cache
def _silence() -> None:
    """What goes wrong is said in one sentence, and not in tracebacks of every attempt."""
    for name in ("gcsfs", "s3fs", "fsspec"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


def _reason(error: Exception) -> str:
    name = type(error).__name__
    said = sentence(" ".join(str(error).split()))[:300]
    if name in _NO_CREDENTIALS:
        return f"no credentials for it are found ({said})"
    if isinstance(error, PermissionError) or getattr(error, "code", None) in (401, 403):
        return f"permission denied ({said or name}): these credentials may not, or it is another's"
    if _NO_CONNECTION.search(name):
        return f"the storage does not answer ({name}: {said})"
    return f"{name}: {said}"
