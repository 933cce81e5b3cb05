"""What a point of the scans in a folder consists of, where its files do not say: stated, or decided on several files together."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lslam.core.types.sequence import readable
from lslam.io.formats.point_files import check_size, read_array, read_bytes, record_of
from lslam.io.formats.point_records import KITTI, PointRecord, name_columns, parse_record
from lslam.io.formats.sequence_toml import SequenceInfo
from lslam.io.readers.ground_truth import Voice

_LOOKED_AT = 3


def scan_record(files: list[Path], info: SequenceInfo, voice: Voice) -> PointRecord | None:
    """The record of `.bin` files and plain arrays, None where fields have names. Raises InputError when none or several fit."""
    suffix = files[0].suffix.lower()
    if suffix not in (".bin", ".npy"):
        return None
    some = np.unique(np.linspace(0, len(files) - 1, min(len(files), _LOOKED_AT)).astype(int)).tolist()
    read = read_bytes if suffix == ".bin" else read_array
    raw = {files[k]: data for k, data in readable(some, lambda k: read(files[k]))}
    tables = [table for table in raw.values() if not table.dtype.names]
    if suffix == ".npy" and not tables:
        return None
    if info.bin_record is not None:
        record = parse_record(info.bin_record)
        misfits = [path for path, data in raw.items() if suffix == ".bin" and len(data) % record.size]
        if 2 * len(misfits) > len(raw):
            check_size(misfits[0], raw[misfits[0]], record)
        voice.notes.append(f"points of {len(record.names)} columns, {record}, as stated")
        return record
    if suffix == ".bin":
        record, reason = record_of(raw)
        sentence = f"points of {record.size} bytes, {record}, by their values: {reason}"
    else:
        if len({table.shape[1] for table in tables}) > 1 or tables[0].shape[1] < 4:
            return None
        names = name_columns(tables)
        record = PointRecord(names, (tables[0].dtype.str,) * len(names))
        sentence = f"points of {len(names)} columns, {' '.join(names)}, by their values"
    if record.names != KITTI.names or (suffix == ".bin" and record != KITTI):
        unread = record.unread()
        voice.notes.append(sentence + (f"; {unread}, nothing says what they are" if unread else ""))
    return record
