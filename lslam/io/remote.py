"""Object storage as paths: `s3://`, `gs://` and other URLs of fsspec behave like files on a disk.

Readers list, test and open paths; a `RemotePath` answers from storage, and nothing is copied. Features of a disk alone
(appending, locks, renaming) are missing: `os.fspath` of it raises UsageError.
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
    """Path of a word: a RemotePath for a URL, else a Path. A path is returned unchanged.

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
    """Path in object storage.

    Each call sends a request, except for entries that a listing of their folder has just returned.

    Raises FileNotFoundError for missing objects, StorageError for a failed request (permission, credentials, network),
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
        """The path itself: a URL is always absolute."""
        return self

    def resolve(self, strict: bool = False) -> RemotePath:
        """Path without `..`; storage has no links."""
        scheme, *rest = self.parts
        return RemotePath(f"{scheme}//{posixpath.normpath('/'.join(rest))}")

    def expanduser(self) -> RemotePath:
        """The path itself."""
        return self

    def stat(self, *, follow_symlinks: bool = True) -> os.stat_result:
        """Kind, size and time of the last change."""
        return _stat(self._info())

    def exists(self, *, follow_symlinks: bool = True) -> bool:
        """Whether an object has this name or lies below it."""
        return self._kind() != ""

    def is_dir(self, **_: Any) -> bool:
        """Whether objects lie below it."""
        return self._kind() == "directory"

    def is_file(self, **_: Any) -> bool:
        """Whether it is an object."""
        return self._kind() == "file"

    def iterdir(self) -> Generator[RemotePath, None, None]:
        """Entries of the folder, sorted by name."""
        with _asking(self, "listed") as (system, place):
            entries = system.ls(place, detail=True)
        for entry in sorted(entries, key=lambda entry: str(entry["name"])):
            name = str(entry["name"]).rstrip("/").rpartition("/")[2]
            if name and str(entry["name"]).strip("/") != place.strip("/"):
                yield self._with_info(name, entry)

    def glob(self, pattern: str, **_: Any) -> Generator[RemotePath, None, None]:
        """Entries of the folder that match a pattern of one level."""
        try:
            yield from (path for path in self.iterdir() if fnmatch.fnmatchcase(path.name, pattern))
        except FileNotFoundError:
            return

    def files(self) -> Iterator[tuple[str, os.stat_result]]:
        """Relative name and `stat` of every object below, sorted by name, with one request per thousand objects."""
        with _asking(self, "listed") as (system, place):
            entries = system.find(place, detail=True)
        for name in sorted(entries):
            yield name.strip("/").removeprefix(place.strip("/")).lstrip("/"), _stat(entries[name])

    def read_bytes(self) -> bytes:
        """Whole content of the object."""
        with _asking(self, "read") as (system, place):
            return bytes(system.cat_file(place))

    def read_text(self, encoding: str | None = None, errors: str | None = None, newline: str | None = None) -> str:
        """Whole content of the object as text."""
        with self.open(encoding=encoding, errors=errors, newline=newline) as stream:
            return str(stream.read())

    def open(
        self,
        mode: str = "r",
        buffering: int = -1,
        encoding: str | None = None,
        errors: str | None = None,
        newline: str | None = None,
    ) -> Any:
        """A stream over all of the object; raises UsageError for any other mode than reading."""
        if set(mode) - set("rbt"):
            os.fspath(self)
        stream = io.BytesIO(self.read_bytes())
        return stream if "b" in mode else io.TextIOWrapper(stream, encoding, errors, newline)

    def read_ranges(self, ranges: Sequence[tuple[int, int]]) -> list[bytes]:
        """Bytes [begin, end) of the object for each of `ranges`, at least one, requested together."""
        with _asking(self, "read") as (system, place):
            if len(ranges) == 1:
                return [bytes(system.cat_file(place, start=ranges[0][0], end=ranges[0][1]))]
            begins, ends = zip(*ranges, strict=True)
            parts = system.cat_ranges([place] * len(ranges), list(begins), list(ends), on_error="raise")
            return [bytes(data) for data in parts]

    def mkdir(self, mode: int = 0o777, parents: bool = False, exist_ok: bool = False) -> None:
        """Do nothing: folders of storage are prefixes of names."""

    def write_bytes(self, data: Any) -> int:
        """Write an object; it appears whole at once."""
        with _asking(self, "written") as (system, place):
            system.pipe_file(place, bytes(data))
        return len(data)

    def upload(self, file: Path) -> None:
        """Upload a local file; the object appears whole at once. Large files are sent in parts."""
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

    def _with_info(self, name: str, info: dict[str, Any]) -> RemotePath:
        """Path of an entry, with the `info` of its listing cached."""
        path = self / name
        path.__dict__["_known"] = info
        return path

    def _info(self) -> dict[str, Any]:
        """Attributes of the object by its file system, requested once."""
        known = self.__dict__.get("_known")
        if known is None:
            with _asking(self, "read") as (system, place):
                known = system.info(place)
            self.__dict__["_known"] = known
        return dict(known)

    def _kind(self) -> str:
        """`file`, `directory`, or empty if it does not exist."""
        try:
            return str(self._info()["type"])
        except (FileNotFoundError, NotADirectoryError):
            return ""


def _stat(info: dict[str, Any]) -> os.stat_result:
    """`stat` result of an entry's attributes."""
    mode = stat.S_IFDIR if info["type"] == "directory" else stat.S_IFREG
    size, changed_ns = int(info.get("size") or 0), _changed_ns(info)
    second = changed_ns // 10**9
    return os.stat_result((mode, 0, 0, 1, 0, 0, size, second, second, second), {"st_mtime_ns": changed_ns})


def _changed_ns(info: dict[str, Any]) -> int:
    """Time of the last change, ns since 1970, 0 if unknown."""
    said = next((info[name] for name in _TIMES if info.get(name) is not None), 0)
    if isinstance(said, str):
        try:
            said = datetime.fromisoformat(said)
        except ValueError:
            return 0
    return int((said.timestamp() if isinstance(said, datetime) else float(said)) * 1e6) * 1000


@contextmanager
def _asking(path: RemotePath, what: str) -> Iterator[tuple[Any, str]]:
    """Context with a path's file system and its name there; storage's exceptions become errors, `path` cannot be `what`."""
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
    """Suppress the tracebacks that the storage library logs for every attempt."""
    for name in ("gcsfs", "s3fs", "fsspec"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


def _reason(error: Exception) -> str:
    """Reason of a failed request, in words."""
    name = type(error).__name__
    said = sentence(" ".join(str(error).split()))[:300]
    if name in _NO_CREDENTIALS:
        return f"no credentials for it are found ({said})"
    if isinstance(error, PermissionError) or getattr(error, "code", None) in (401, 403):
        return f"permission denied ({said or name}): these credentials may not, or it is another's"
    if _NO_CONNECTION.search(name):
        return f"the storage does not answer ({name}: {said})"
    return f"{name}: {said}"
