"""Maps read block by block from their files, with what colours their points."""

from __future__ import annotations

import mmap
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.errors import input_errors
from lslam.core.types.arrays import Floats
from lslam.core.types.cloud import BLOCK, Cloud, CloudBlock
from lslam.io.formats.ply_files import ply_columns
from lslam.io.formats.point_files import open_map

COLOURING = ("red", "green", "blue", "class")


class ColumnCloud:
    """A cloud of named columns (N,), which may be mapped from a file: `x`, `y`, `z`, `intensity` and those of `COLOURING`."""

    def __init__(self, columns: Mapping[str, NDArray[Any]]) -> None:
        self._columns = columns
        self.column_types = {name: columns[name].dtype for name in COLOURING if name in columns}

    def __len__(self) -> int:
        return len(self._columns["x"])

    @property
    def has_intensity(self) -> bool:
        """Whether there are intensities."""
        return "intensity" in self._columns

    def blocks(self) -> Iterator[CloudBlock]:
        """All points, as arrays of their own."""
        for begin in range(0, len(self), BLOCK):
            part = {name: np.array(column[begin : begin + BLOCK]) for name, column in self._columns.items()}
            points = np.column_stack([part[axis].astype(np.float64) for axis in "xyz"])
            intensity = part["intensity"].astype(np.float32) if self.has_intensity else None
            yield CloudBlock(points, intensity, {name: part[name] for name in self.column_types})


class MapCloud:
    """One map of one or several files of a kind, in the world that `to_world` takes their points (N, 3), m, to."""

    def __init__(self, paths: Sequence[Path], to_world: Callable[[Floats], Floats] = lambda points: points) -> None:
        self._paths, self._to_world = paths, to_world

    @cached_property
    def _parts(self) -> list[Cloud]:
        return [stored_cloud(path) for path in self._paths]

    @property
    def has_intensity(self) -> bool:
        """Whether all files have intensities."""
        return all(part.has_intensity for part in self._parts)

    @property
    def column_types(self) -> Mapping[str, np.dtype[Any]]:
        """Types of the columns that all files have."""
        known = [part.column_types for part in self._parts]
        return {name: kind for name, kind in known[0].items() if all(name in one for one in known)}

    def __len__(self) -> int:
        return sum(map(len, self._parts))

    def blocks(self) -> Iterator[CloudBlock]:
        """The blocks of one file after the other."""
        for part in self._parts:
            for block in part.blocks():
                yield CloudBlock(self._to_world(block.points), block.intensity, block.columns)


def stored_cloud(path: Path) -> Cloud:
    """A map as lslam writes it. Of PLY, LAS and LAZ no more is held than a block; PCD is read whole.

    Raises InputError naming the file when it is missing, damaged or of another kind, of LAS while its blocks are read.
    """
    if path.suffix.lower() != ".ply":
        return open_map(path, ("class",))
    with input_errors(path, ValueError, as_what="a map"), path.open("rb") as stream:
        columns = ply_columns(path, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ))
    return ColumnCloud(columns)
