"""Whether every file of a run folder is a whole one: whatever lies under its final name must parse to its end."""

from __future__ import annotations

import csv
import io
import json
import struct
import tomllib
import zlib
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from g2o_reader import read_g2o

from lslam.core.config import Config
from lslam.io.formats.osm_files import read_osm
from lslam.io.formats.point_files import read_cloud
from lslam.io.formats.state_files import read_state
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.odometry.frontend.checkpoints import STATE_CLASSES

# What is appended to: a log, the lock, and rows of which a checkpoint says how many count.
GROWING = ("log.txt", ".lock", *(f"checkpoint/{part}/" for part in ("map", "occupancy", "edges", "planes")))
STATUSES = ("running", "done", "degraded", "interrupted")


def torn(folder: Path) -> list[str]:
    """Per file under a final name that is not whole, its name and why; `*.part` are none."""
    found = []
    for path in sorted(file for file in folder.rglob("*") if file.is_file()):
        name = path.relative_to(folder).as_posix()
        if name.endswith(".part") or name.startswith(GROWING):
            continue
        try:
            _reader_of(name)(path)
        except Exception as error:
            found.append(f"{name} is no whole file: {type(error).__name__}: {error}")
    return found


def _reader_of(name: str) -> Callable[[Path], object]:
    if name.startswith("checkpoint/"):
        return lambda path: read_state(path, STATE_CLASSES)
    if name == "manifest.json":
        return _manifest
    return _READERS[Path(name).suffix if name != "trajectory_kitti.txt" else name]


def _manifest(path: Path) -> None:
    assert json.loads(path.read_text())["status"] in STATUSES


def _text(path: Path) -> str:
    text = path.read_text(encoding="utf-8")
    assert text.endswith("\n"), "the last line has no end"
    return text


def _table(path: Path) -> None:
    widths = {len(row) for row in csv.reader(io.StringIO(_text(path)))}
    assert len(widths) == 1, f"rows of {sorted(widths)} cells"


def _arrays(path: Path) -> None:
    with np.load(path, allow_pickle=False) as archive:
        for name in archive.files:
            archive[name]


def _page(path: Path) -> None:
    assert _text(path).rstrip().endswith("</html>")


def _png(path: Path) -> None:
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    at, kind = 8, b""
    while at < len(data):
        (size,), kind = struct.unpack(">I", data[at : at + 4]), data[at + 4 : at + 8]
        assert struct.unpack(">I", data[at + 8 + size : at + 12 + size]) == (zlib.crc32(data[at + 4 : at + 8 + size]),)
        at += 12 + size
    assert kind == b"IEND"


def _configuration(path: Path) -> None:
    missing = set(Config.model_fields) - set(tomllib.loads(_text(path)))
    assert not missing, f"no section {', '.join(sorted(missing))}"


def _settings(path: Path) -> None:
    assert all(": " in line for line in _text(path).splitlines())


def _osm(path: Path) -> None:
    ElementTree.fromstring(_text(path))
    read_osm(path)


_READERS: dict[str, Callable[[Path], object]] = {
    "trajectory_kitti.txt": lambda path: (_text(path), read_trajectory(path)),
    ".tum": lambda path: (_text(path), read_trajectory(path)),
    ".g2o": lambda path: (_text(path), read_g2o(path)),
    ".csv": _table,
    ".npz": _arrays,
    ".ply": read_cloud,
    ".json": lambda path: json.loads(_text(path)),
    ".geojson": lambda path: json.loads(path.read_text()),
    ".toml": _configuration,
    ".yaml": _settings,
    ".html": _page,
    ".png": _png,
    ".osm": _osm,
}
