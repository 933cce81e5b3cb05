"""Bags of ROS 1 and ROS 2, written without ROS."""

from __future__ import annotations

import contextlib
import os
import shutil
import sqlite3
from pathlib import Path
from types import TracebackType
from typing import Any

from lslam.core.errors import OutputError, UsageError, cause, output_errors
from lslam.io.formats.bag_files import INFO_TOPIC, typestore

# What belongs to the whole of a run.
MAP_TOPIC, PATH_TOPIC = "/map", "/path"
LATCHED = ("/tf_static", INFO_TOPIC, MAP_TOPIC, PATH_TOPIC)


class BagWriter:
    """Writes a bag, whole or not at all: a ROS 1 `.bag`, or a ROS 2 folder, or a single file when `path` ends in .mcap or .db3.

    Raises OutputError when it cannot be written, UsageError for a compression the kind does not have.
    """

    def __init__(self, path: Path, kind: str, is_zstd: bool = False) -> None:
        if is_zstd and kind == "bag":
            raise UsageError("--zstd is for mcap and sqlite: ROS 1 does not know it")
        self.path, self.kind = path, kind
        self.store = typestore("ros1" if kind == "bag" else "cdr")
        self._part = path.with_name(path.name + ".part")
        self._connections: dict[str, Any] = {}
        with output_errors(path):
            shutil.rmtree(self._part, ignore_errors=True)
            self._part.mkdir(parents=True)
            self._writer = _writer(self._part / path.name, kind, is_zstd)

    def __enter__(self) -> BagWriter:
        return self

    def write(self, topic: str, stamp_ns: int, message: Any) -> None:
        """Write a message, an object of `store.types`. Raises OutputError for a full disk or a time before 1970."""
        if stamp_ns < 0:
            raise OutputError(f"{self.path} cannot hold the time {stamp_ns} ns: times of bags begin in 1970")
        kind = message.__msgtype__
        try:
            if topic not in self._connections:
                more = _latched(self.kind) if topic in LATCHED else {}
                self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self.store, **more)
            serialise = self.store.serialize_ros1 if self.kind == "bag" else self.store.serialize_cdr
            self._writer.write(self._connections[topic], stamp_ns, serialise(message, kind))
        except (OSError, sqlite3.Error) as error:
            raise OutputError(f"{self.path} cannot be written: {cause(error)}") from None

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is not None:
                with contextlib.suppress(Exception):
                    self._writer.abort()
                return
            self._writer.close()
            made = self._part / self.path.name
            if made.is_dir() and self.path.suffix in (".mcap", ".db3"):
                made = next(p for p in made.iterdir() if p.suffix == self.path.suffix)
            os.replace(made, self.path)
        except (OSError, sqlite3.Error) as failure:
            raise OutputError(f"{self.path} cannot be written: {cause(failure)}") from None
        finally:
            shutil.rmtree(self._part, ignore_errors=True)


def _writer(path: Path, kind: str, is_zstd: bool) -> Any:
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2

    writer: Any = Writer1(path)
    if kind != "bag":
        # The newest metadata with the notation of QoS that ROS 2 had before Jazzy.
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer = Writer2(path, version=8, storage_plugin=plugin)
        if is_zstd:
            mode = CompressionMode.STORAGE if kind == "mcap" else CompressionMode.MESSAGE
            writer.set_compression(mode, CompressionFormat.ZSTD)
    writer.open()
    return writer


def _latched(kind: str) -> dict[str, Any]:
    """Quality of service by which late subscribers get the last message of a topic."""
    if kind == "bag":
        return {"latching": 1}
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    never = QosTime(2147483647, 4294967295)
    quality = Qos(
        QosHistory.KEEP_LAST,
        1,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL,
        never,
        never,
        QosLiveliness.AUTOMATIC,
        never,
        False,
    )
    return {"offered_qos_profiles": [quality]}
