"""ROS 2 bags in SQLite (`.db3`), every version of their tables; messages are read by row, one at a time."""

from __future__ import annotations

import sqlite3
import threading
from pathlib import Path
from urllib.parse import quote

import numpy as np

from lslam.core.errors import InputError, UsageError
from lslam.io.formats.bag_chunks import Topic
from lslam.io.remote import RemotePath

_TABLES = {"topics", "messages"}


class SqliteBag:
    """One `.db3` file: `topics`, and `loss`, a sentence when it was cut off."""

    def __init__(self, path: Path, unpacked: Path | None = None) -> None:
        """Open `path`, or its decompressed copy if there is one."""
        if isinstance(path, RemotePath):
            raise UsageError(
                f"{path}: SQLite cannot be read in place from storage; *.mcap and *.bag are: `lslam convert` makes an MCAP file "
                "of a copy, or run the copy"
            )
        self.path, self._on_disk = path, unpacked or path
        self.loss = ""
        self._lock = threading.Lock()
        try:
            # Nothing is written beside the file, neither a lock nor a journal.
            self._db = sqlite3.connect(
                f"file:{quote(str(self._on_disk.resolve()))}?immutable=1", uri=True, check_same_thread=False
            )
            # SQLite then opens files that are shorter than their header says; nothing can be changed all the same.
            self._db.execute("PRAGMA writable_schema = ON")
            names = {str(name) for (name,) in self._db.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
            if not names >= _TABLES:
                raise InputError(f"{path} is no ROS 2 bag: its tables are {', '.join(sorted(names)) or 'none'}")
            rows = self._db.execute("SELECT id, name, type, serialization_format FROM topics ORDER BY id").fetchall()
        except sqlite3.Error as error:
            raise InputError(f"{path} cannot be read as a ROS 2 bag in SQLite: {error}") from None
        self._topics = {
            number: Topic(_word(name), _word(kind), _word(encoding)) for number, name, kind, encoding in rows
        }
        self._index()
        self.topics = list(self._topics.values())
        if path.with_name(path.name + "-wal").is_file():
            self.loss = self.loss or f"{path}-wal holds messages that were never merged: `ros2 bag reindex` does that"

    def expect(self, topic: Topic, is_head: bool) -> None:
        """Do nothing: a file on a disk needs no prefetching."""

    def read(self, topic: Topic, k: int, limit: int | None = None) -> bytes:
        """Bytes of message `k` of `topic`; with `limit`, at least its first `limit` bytes."""
        row = int(topic.where[k, 0])
        try:
            with self._lock, self._db.blobopen("messages", "data", row, readonly=True) as blob:
                return blob.read(-1 if limit is None else limit)
        except sqlite3.Error as error:
            raise InputError(f"{self.path}: message {k} of {topic.name} is damaged: {error}") from None

    def _index(self) -> None:
        """Read stamps and row numbers of all messages; the data itself stays on disk."""
        found: dict[int, list[tuple[int, int]]] = {number: [] for number in self._topics}
        try:
            for row, topic, stamp in self._db.execute("SELECT id, topic_id, timestamp FROM messages ORDER BY id"):
                if topic in found and isinstance(stamp, int) and isinstance(row, int):
                    found[topic].append((stamp, row))
        except sqlite3.Error as error:
            self.loss = (
                f"{self.path} is damaged ({error}): {sum(map(len, found.values()))} messages up to there are read"
            )
        size, stated = self._sizes()
        if size < stated:
            self.loss = (
                f"{self.path} is cut off: it has {size} of {stated} bytes, {(stated - size) / stated:.1%} are lost; "
                f"{sum(map(len, found.values()))} messages are listed, those that reach beyond the cut cannot be read"
            )
        for number, entries in found.items():
            table = np.array(sorted(entries), np.int64).reshape(-1, 2)
            self._topics[number].stamps_ns = table[:, 0].copy()
            self._topics[number].where = np.column_stack([table[:, 1], np.zeros(len(table), np.int64)])

    def _sizes(self) -> tuple[int, int]:
        """Size of the file and the size that its header states, bytes (SQLite's file format, 1.3)."""
        with self._on_disk.open("rb") as file:
            header = file.read(100)
        page, pages = int.from_bytes(header[16:18], "big"), int.from_bytes(header[28:32], "big")
        return self._on_disk.stat().st_size, pages * (65536 if page == 1 else page)


def _word(value: object) -> str:
    """Text of a column; empty if it holds something else."""
    return value if isinstance(value, str) else ""
