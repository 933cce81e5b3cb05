"""Extrinsics of the Multi-Campus Dataset (`*_calib.yaml`), read line by line: YAML itself is not needed for four rows."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError, cause
from lslam.geometry import so3

_ROW = re.compile(r"-\s*\[(.*)\]\s*$")


def read_mcd_extrinsics(path: Path, sensor: str = "os_sensor") -> NDArray[np.float64] | None:
    """(4, 4) T_body_sensor of `sensor`, None when the file does not name it.

    Raises InputError naming file and line when the block below the name is not a rigid 4x4 `T`.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read: {cause(error)}") from None
    begin = next((k for k, line in enumerate(lines) if line.strip() == f"{sensor}:"), None)
    if begin is None:
        return None
    rows: list[list[float]] = []
    if lines[begin + 1 : begin + 2] and lines[begin + 1].strip() == "T:":
        for line in lines[begin + 2 : begin + 6]:
            match = _ROW.search(line)
            try:
                rows.append([float(w) for w in match.group(1).split(",")] if match else [])
            except ValueError:
                rows.append([])
    if len(rows) != 4 or any(len(row) != 4 for row in rows):
        raise InputError(f"{path}, line {begin + 1}: {sensor} is not followed by 'T:' and four rows of four numbers")
    T = np.array(rows)
    if not so3.is_rotation(T[:3, :3], 1e-3) or not np.isfinite(T).all():
        raise InputError(f"{path}, line {begin + 1}: T of {sensor} is no rigid transform")
    return T
