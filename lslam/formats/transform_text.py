"""One rigid transform as people write it: on a command line or in a small file."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError, UsageError
from lslam.formats import kitti_calib
from lslam.geometry import se3, so3
from lslam.untrusted import is_file

Floats = NDArray[np.float64]


def read_transform(text: str) -> Floats:
    """(4, 4) transform of 12 or 16 numbers (rows of the matrix), of `tx,ty,tz,qx,qy,qz,qw`, or of a file with either.

    Numbers are separated by commas or spaces. A file may also be KITTI's `R:`/`T:` kind or one line `Tr: ...`.
    Raises UsageError for text that is neither numbers nor a file, InputError for a file that holds no transform.
    """
    values = _numbers(text)
    if values is not None:
        try:
            return _transform(values)
        except ValueError as error:
            raise UsageError(f"transform {text!r}: {error}") from None
    path = Path(text)
    if not is_file(path):
        raise UsageError(f"transform {text!r} is neither numbers nor a file that exists")
    return _read_file(path)


def _read_file(path: Path) -> Floats:
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (UnicodeDecodeError, OSError):
        raise InputError(f"{path} cannot be read as text: a transform of 12, 16 or 7 numbers is expected") from None
    content = "\n".join(line for line in lines if not line.lstrip().startswith("#"))
    values = _numbers(content)
    if values is None:
        entries = kitti_calib.read_entries(path)
        if "R" in entries and "T" in entries:
            return kitti_calib.read_rigid(path)
        T = kitti_calib.read_odometry_calib(path)
        if T is None:
            raise InputError(f"{path} holds no transform: 12, 16 or 7 numbers are expected")
        return T
    try:
        return _transform(values)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None


def _numbers(text: str) -> list[float] | None:
    fields = [f for f in re.split(r"[,;\s\[\]]+", text) if f]
    try:
        return [float(f) for f in fields] or None
    except ValueError:
        return None


def _transform(values: list[float]) -> Floats:
    if not np.isfinite(values).all():
        raise ValueError("NaN or infinity")
    if len(values) == 7:
        q = np.array(values[3:])
        if abs(np.linalg.norm(q) - 1) > 0.05:
            raise ValueError("the quaternion (last four numbers, x y z w) has not length 1")
        return se3.make(so3.from_quaternion(q), np.array(values[:3]))
    if len(values) not in (12, 16):
        raise ValueError(
            f"{len(values)} numbers; 12 or 16 (rows of the matrix) or 7 (tx,ty,tz,qx,qy,qz,qw) are expected"
        )
    T = np.vstack([np.reshape(values[:12], (3, 4)), [0, 0, 0, 1]])
    if len(values) == 16 and not np.allclose(values[12:], [0, 0, 0, 1]):
        raise ValueError("the last row of the 4x4 matrix is not 0 0 0 1")
    if not so3.is_rotation(T[:3, :3], 1e-2):
        raise ValueError("the 3x3 part is no rotation")
    return se3.normalise(T)
