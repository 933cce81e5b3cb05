"""Named arrays in one .npz file: same arrays, same bytes; read without ever running what the file holds."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError, cause
from lslam.formats.atomic import atomic_write
from lslam.untrusted import MISFIT

# What zipfile and NumPy raise; no memory, for arrays that are said to be larger than any machine; a flag of encryption.
DAMAGE = (*MISFIT, EOFError, SyntaxError, MemoryError, RuntimeError, zipfile.BadZipFile, zlib.error, struct.error)


def write_npz(path: Path, arrays: Mapping[str, NDArray[Any]], level: int = 1) -> None:
    """Write the arrays atomically; `level` 0 stores them, 1 (fast) to 9 (small) deflates. Raises OutputError."""
    with atomic_write(path) as stream:
        pack_npz(stream, arrays, level)


def pack_npz(stream: BinaryIO, arrays: Mapping[str, NDArray[Any]], level: int = 1) -> None:
    """As `write_npz`, into an open stream."""
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
    return np.asarray(np.lib.format.read_array(io.BytesIO(member), allow_pickle=False))


def _name(source: Path | BinaryIO) -> str:
    return str(source) if isinstance(source, Path) else "an archive"
