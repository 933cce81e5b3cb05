"""What a point of the scans in a folder consists of, where its files do not say: stated, or decided on several files together."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np

from lslam.errors import InputError
from lslam.formats.point_files import read_array, read_bytes, record_of
from lslam.formats.point_records import KITTI, PointRecord, name_columns, parse_record
from lslam.formats.sequence_toml import SequenceInfo
from lslam.readers.ground_truth import Voice

_LOOKED_AT = 3


def scan_record(files: list[Path], info: SequenceInfo, voice: Voice) -> PointRecord | None:
    """The record of `.bin` files and plain NumPy arrays; None where files name their fields.

    Raises InputError when no record fits the values, or several do.
    """
    suffix = files[0].suffix.lower()
    if suffix not in (".bin", ".npy"):
        return None
    if info.bin_record is not None:
        record = parse_record(info.bin_record)
        if suffix == ".bin" or not _is_structured(files[0]):
            voice.notes.append(f"points of {len(record.names)} columns, {record}, as stated")
            return record
        return None
    some = [files[k] for k in np.unique(np.linspace(0, len(files) - 1, min(len(files), _LOOKED_AT)).astype(int))]
    return _of_bins(some, voice) if suffix == ".bin" else _of_arrays(some, voice)


def _of_bins(files: list[Path], voice: Voice) -> PointRecord:
    raw = {}
    for path in files:
        with suppress(InputError):
            raw[path] = read_bytes(path)
    record, reason = record_of(raw)
    if record != KITTI:
        _say(f"points of {record.size} bytes, {record}, by their values: {reason}", record, voice)
    return record


def _of_arrays(files: list[Path], voice: Voice) -> PointRecord | None:
    tables = []
    for path in files:
        with suppress(InputError):
            table = read_array(path)
            if not table.dtype.names and len(table):
                tables.append(table)
    if not tables or len({table.shape[1] for table in tables}) > 1 or tables[0].shape[1] < 4:
        return None
    names = name_columns(tables)
    record = PointRecord(names, (tables[0].dtype.str,) * len(names))
    if names != KITTI.names:
        _say(f"points of {len(names)} columns, {' '.join(names)}, by their values", record, voice)
    return record


def _say(sentence: str, record: PointRecord, voice: Voice) -> None:
    unread = record.unread()
    voice.notes.append(sentence + (f"; {unread}, nothing says what they are" if unread else ""))


def _is_structured(path: Path) -> bool:
    try:
        return read_array(path).dtype.names is not None
    except InputError:
        return False
