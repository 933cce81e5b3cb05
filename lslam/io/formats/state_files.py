"""A tree of plain values, arrays and known dataclasses in one .npz file, which is checked when read and never run.

The arrays are members of their own; `tree` is the JSON of all the rest, in which `{"array": 3}` stands for member `a3`. Many
records of one dataclass are written column by column.
"""

from __future__ import annotations

import io
import json
import struct
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from threading import RLock
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from lslam.core.errors import InputError, cause
from lslam.core.untrusted import MISFIT, parse_json
from lslam.io.formats.atomic import atomic_write

# What zipfile and NumPy raise; no memory, for arrays that are said to be larger than any machine; a flag of encryption.
DAMAGE = (*MISFIT, EOFError, SyntaxError, MemoryError, RuntimeError, zipfile.BadZipFile, zlib.error, struct.error)
# One thread at a time reads NumPy's headers: it parses them as Python, and CPython 3.11 counts the depth of its parser for all
# threads together. Where a collection of garbage lets another one in, the first ends with a SystemError (CPython issue 106905).
HEADERS = RLock()
Arrays = dict[str, NDArray[Any]]
Classes = Mapping[str, type]


def write_npz(path: Path, arrays: Mapping[str, NDArray[Any]], level: int = 1) -> None:
    """Write the arrays atomically; `level` 0 stores them, 1 (fast) to 9 (small) deflates. Raises OutputError."""
    with atomic_write(path) as stream:
        pack_npz(stream, arrays, level)


def pack_npz(stream: BinaryIO, arrays: Mapping[str, NDArray[Any]], level: int = 1) -> None:
    """Write arrays by name as .npz into an open stream; level : of compression, 0 for none. Equal arrays give equal bytes."""
    method = zipfile.ZIP_DEFLATED if level else zipfile.ZIP_STORED
    with zipfile.ZipFile(stream, "w", method, compresslevel=level or None) as archive:
        for name, array in arrays.items():
            # By its name alone a member gets the archive's level, and the date of 1980 that numpy's own writer gives.
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asanyarray(array), allow_pickle=False)


def read_npz(source: Path | BinaryIO) -> dict[str, NDArray[Any]]:
    """All arrays of a file, checked against its checksums. Raises InputError naming a file that is damaged or missing."""
    try:
        # All at once, and each array at once: small pieces take longer than unpacking.
        stream = io.BytesIO(source.read_bytes()) if isinstance(source, Path) else source
        with zipfile.ZipFile(stream) as archive:
            return {name.removesuffix(".npy"): _array(archive.read(name)) for name in archive.namelist()}
    except OSError as error:
        raise InputError(f"{_name(source)} cannot be read: {cause(error)}") from None
    except DAMAGE as error:
        raise InputError(f"{_name(source)} is damaged: {error}") from None


def _array(member: bytes) -> NDArray[Any]:
    """The array in a member of an .npz file; raises ValueError for one that would need pickle."""
    with HEADERS:
        return np.asarray(np.lib.format.read_array(io.BytesIO(member), allow_pickle=False))


def _name(source: Path | BinaryIO) -> str:
    """Name of a source in messages."""
    return str(source) if isinstance(source, Path) else "an archive"


@dataclass(frozen=True)
class Records:
    """Instances of one dataclass, to be written column by column."""

    rows: Sequence[Any]


def write_state(path: Path, value: Any, level: int = 0) -> None:
    """Write `value` atomically, not compressed unless `level` says so. Raises OutputError."""
    arrays: Arrays = {}
    tree = json.dumps(_encode(value, arrays)).encode()
    write_npz(path, {"tree": np.frombuffer(tree, np.uint8), **arrays}, level)


def read_state(path: Path, classes: Sequence[type]) -> Any:
    """Read a value that `write_state` wrote; only dataclasses among `classes` are made. Raises InputError if it is damaged."""
    arrays = read_npz(path)
    try:
        return _decode(parse_json(arrays["tree"].tobytes()), arrays, {c.__name__: c for c in classes})
    except MISFIT as error:
        raise InputError(f"{path} is damaged: {type(error).__name__} {error}") from None


def _encode(value: Any, arrays: Arrays) -> Any:
    """JSON tree of a value, with its arrays moved to `arrays`; raises TypeError for an unsupported type."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray | np.generic):
        arrays[f"a{len(arrays)}"] = np.asarray(value)
        return {"array": len(arrays) - 1}
    if isinstance(value, list | tuple):
        return {type(value).__name__: [_encode(item, arrays) for item in value]}
    if isinstance(value, dict):
        return {"dict": {str(key): _encode(item, arrays) for key, item in value.items()}}
    if isinstance(value, Records):
        return {"records": _encode_records(value.rows, arrays)}
    if is_dataclass(value):
        return {
            "class": type(value).__name__,
            "fields": {f.name: _encode(getattr(value, f.name), arrays) for f in fields(value)},
        }
    raise TypeError(f"a {type(value).__name__} cannot be written as state")


def _decode(tree: Any, arrays: Arrays, classes: Classes) -> Any:
    """The value that `_encode` turned into `tree` and `arrays`; classes : dataclasses by name."""
    if not isinstance(tree, dict):
        return tree
    if "class" in tree:
        made = classes[tree["class"]]
        return made(**{name: _decode(item, arrays, classes) for name, item in tree["fields"].items()})
    ((kind, inside),) = tree.items()
    if kind == "array":
        return arrays[f"a{inside}"]
    if kind == "dict":
        return {name: _decode(item, arrays, classes) for name, item in inside.items()}
    if kind == "records":
        return _decode_records(inside, arrays, classes)
    items = [_decode(item, arrays, classes) for item in inside]
    return tuple(items) if kind == "tuple" else items


def _encode_records(rows: Sequence[Any], arrays: Arrays) -> Any:
    """JSON tree of instances of one dataclass, column by column, with their arrays moved to `arrays`."""
    if not rows:
        return {"class": "", "count": 0, "columns": {}}
    columns = {f.name: _encode_column([getattr(row, f.name) for row in rows], arrays) for f in fields(rows[0])}
    return {"class": type(rows[0]).__name__, "count": len(rows), "columns": columns}


def _decode_records(tree: Any, arrays: Arrays, classes: Classes) -> list[Any]:
    """The instances that `_encode_records` turned into `tree` and `arrays`; classes : dataclasses by name."""
    if not tree["count"]:
        return []
    columns = {name: _decode_column(column, arrays, classes) for name, column in tree["columns"].items()}
    made = classes[tree["class"]]
    return [made(**dict(zip(columns, row, strict=True))) for row in zip(*columns.values(), strict=True)]


def _encode_column(values: list[Any], arrays: Arrays) -> Any:
    """Encode one field of all records; the value may be None in some."""
    known = [value for value in values if value is not None]
    inside: Any
    if not known:
        kind, inside = "plain", []
    elif isinstance(known[0], np.ndarray):
        # Along the first axis, however long each is there.
        kind, inside = "arrays", [np.concatenate(known), np.array([len(value) for value in known])]
    elif isinstance(known[0], tuple):
        kind, inside = "tuples", np.array(known)
    elif isinstance(known[0], dict):
        orders = sorted({tuple(value) for value in known})
        which = [orders.index(tuple(value)) for value in known]
        kind, inside = "dicts", [orders, which, np.array([item for value in known for item in value.values()])]
    elif is_dataclass(known[0]):
        kind, inside = "records", Records(known)
    elif isinstance(known[0], str):
        kind, inside = "plain", known
    else:
        kind, inside = "numbers", np.array(known)
    present = np.array([value is not None for value in values])
    return {"kind": kind, "present": _encode(present, arrays), "inside": _encode(inside, arrays)}


def _decode_column(tree: Any, arrays: Arrays, classes: Classes) -> list[Any]:
    """The values of one field of all records, by `_encode_column`."""
    inside = _decode(tree["inside"], arrays, classes)
    kind, present = tree["kind"], _decode(tree["present"], arrays, classes)
    known: list[Any]
    if kind == "arrays":
        known = [part.copy() for part in np.split(inside[0], np.cumsum(inside[1])[:-1])]
    elif kind == "tuples":
        known = [tuple(row) for row in inside.tolist()]
    elif kind == "dicts":
        orders, which, numbers = inside
        values = iter(numbers.tolist())
        known = [{name: next(values) for name in orders[k]} for k in which]
    else:
        known = inside.tolist() if kind == "numbers" else inside
    left = iter(known)
    return [next(left) if here else None for here in present]
