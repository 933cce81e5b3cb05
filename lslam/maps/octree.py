"""Octree of a map of any size, for pages that load nodes as they need them: a file of nodes and a small index.

A node is a cube. It has the first point of each of its cells, and its eight children have the others, at half the spacing; a node
of few points is not divided. So every point lies in one node, as in Potree's octrees.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.errors import output_errors
from lslam.core.types.cloud import BLOCK, Cloud, CloudBlock, bounds

# Cells of a node along each axis; points of a node that is not divided; points that are held in memory; levels, at most.
CELLS, FEW, HELD, DEEPEST = 128, 1 << 14, 1 << 22, 20
QUANTA = 65535
COLOURS = ("red", "green", "blue")
Records = NDArray[Any]


def write_octree(
    stream: BinaryIO,
    spool: Path,
    cloud: Cloud,
    shades: tuple[float, float],
    on_share: Callable[[float], None] = lambda share: None,
    most_points: int = HELD,
) -> dict[str, Any]:
    """Write the nodes of the finite points of a cloud one after the other, and return the index.

    Of a node of n points: int16 (n, 3), coordinates in steps of its edge / 65535, less 32768; then the bytes of each column.

    spool : folder for the points of nodes that do not fit into memory; shades : intensities that become 0 and 255
    on_share : called with the share that is written, 0 to 1; it may raise to stop
    most_points : points that are held in memory

    Raises OutputError when the disk is full.
    """
    low, high = bounds(cloud)
    if not np.isfinite(low).all():
        low, high = np.zeros(3), np.zeros(3)
    edge = max(float((high - low).max()), 1e-3) * (1 + 1e-6)
    columns = {"intensity": 1} if cloud.has_intensity else {}
    columns |= {"rgb": 3} if set(COLOURS) <= set(cloud.column_types) else {}
    columns |= {"class": 1} if "class" in cloud.column_types else {}
    kind = np.dtype([("at", "<f4", (3,)), *((name, "u1", (size,)) for name, size in columns.items())])
    builder = _Builder(stream, spool, edge, most_points, on_share)
    with output_errors(spool):
        root = spool / "r"
        with root.open("wb") as points:
            for block in cloud.blocks():
                points.write(_records(block, kind, low, shades).tobytes())
        builder.divide("r", _take_records(root, kind, most_points), np.zeros(3), edge)
    return {
        "low": low.tolist(),
        "edge": edge,
        "cells": CELLS,
        "columns": columns,
        "values": list(shades),
        "points": builder.written,
        "nodes": builder.nodes,
    }


def cube_of(name: str, low: Floats, edge: float) -> tuple[Floats, float]:
    """Lowest corner (3,) and edge of a node's cube, m, from those of the root.

    >>> cube_of("r4", np.zeros(3), 8.0)
    (array([4., 0., 0.]), 4.0)
    """
    for digit in name[1:]:
        edge /= 2
        low = low + edge * np.array([int(digit) >> 2, int(digit) >> 1 & 1, int(digit) & 1])
    return low, edge


def points_of(name: str, data: bytes, tree: Mapping[str, Any]) -> Floats:
    """Points (n, 3), m, of a node, from their int16; tree : the index."""
    low, edge = cube_of(name, np.array(tree["low"]), tree["edge"])
    steps = np.frombuffer(data, "<i2").reshape(-1, 3) + (QUANTA + 1) / 2
    return np.asarray(low + steps * (edge / QUANTA))


def _records(block: CloudBlock, kind: np.dtype[Any], low: Floats, shades: tuple[float, float]) -> Records:
    """The finite points of a block as records, coordinates relative to the lowest corner `low` (3,) of the root cube."""
    finite = np.isfinite(block.points).all(1)
    records = np.zeros(int(finite.sum()), kind)
    records["at"] = block.points[finite] - low
    if "intensity" in (kind.names or ()) and block.intensity is not None:
        share = (block.intensity[finite, None] - shades[0]) / max(shades[1] - shades[0], 1e-9)
        records["intensity"] = np.rint(255 * np.clip(np.nan_to_num(share), 0, 1))
    if "rgb" in (kind.names or ()):
        records["rgb"] = np.column_stack([block.columns[name][finite] for name in COLOURS])
    if "class" in (kind.names or ()):
        records["class"] = np.minimum(block.columns["class"][finite, None], 255)
    return records


def _take_records(path: Path, kind: np.dtype[Any], most_points: int) -> Records:
    """The records of a file, in memory where they are few, else mapped; the file is removed."""
    count = path.stat().st_size // kind.itemsize
    records: Records = np.memmap(path, kind, "r") if count > most_points else np.fromfile(path, kind)
    path.unlink()  # what is mapped stays until nobody has it
    return records


class _Builder:
    """Divides nodes and writes them, parents first; `nodes` has of each, by its name, the first byte and the number of points.

    edge : of the root, m; most_points : in memory at a time, more lie in files in `spool`
    """

    def __init__(
        self, stream: BinaryIO, spool: Path, edge: float, most_points: int, on_share: Callable[[float], None]
    ) -> None:
        self.nodes: dict[str, tuple[int, int]] = {}
        self.written = 0
        self._stream, self._spool, self._held, self._on_share = stream, spool, most_points, on_share
        self._edge, self._total = edge, 0

    def divide(self, name: str, records: Records, low: Floats, edge: float) -> None:
        """Write the node of a cube from corner `low` (3,) with side `edge`, m, and those below it.

        A child's name ends with its number, 4 x + 2 y + z, of bits 0 or 1.
        """
        self._total = self._total or len(records)
        if len(records) <= FEW or len(name) > DEEPEST:
            self._write(name, np.asarray(records), low, edge)
            return
        is_large = len(records) > self._held
        kept: list[Records] = []
        parts: list[list[Records]] = [[] for _ in range(8)]
        for first, rest, child in _sorted_out(records, low, edge):
            kept.append(first)
            for k, part in enumerate(parts):
                some = rest[child == k]
                if is_large and len(some):
                    with (self._spool / f"{name}{k}").open("ab") as stream:
                        stream.write(some.tobytes())
                elif len(some):
                    part.append(some)
        kind = records.dtype
        del records
        self._write(name, np.concatenate(kept), low, edge)
        for k in range(8):
            stored = self._spool / f"{name}{k}"
            if stored.exists():
                self.divide(f"{name}{k}", _take_records(stored, kind, self._held), *cube_of(f"r{k}", low, edge))
            elif parts[k]:
                some, parts[k] = np.concatenate(parts[k]), []
                self.divide(f"{name}{k}", some, *cube_of(f"r{k}", low, edge))

    def _write(self, name: str, records: Records, low: Floats, edge: float) -> None:
        """Append a node's `records`, shuffled, to the file; coordinates int16 within the cube from `low` with edge `edge`, m."""
        self.nodes[name] = (self._stream.tell(), len(records))
        # Any first part of them is spread over the node: while a map moves less of it is drawn.
        records = records[np.random.default_rng(0).permutation(len(records))]
        steps = np.rint((records["at"] - low) * (QUANTA / edge))
        self._stream.write((np.clip(steps, 0, QUANTA) - (QUANTA + 1) // 2).astype("<i2").tobytes())
        for column in (records.dtype.names or ())[1:]:
            self._stream.write(records[column].tobytes())
        self.written += len(records)
        self._on_share(self.written / max(self._total, 1))


def _sorted_out(records: Records, low: Floats, edge: float) -> Iterator[tuple[Records, Records, NDArray[Any]]]:
    """Divide the records of a cube (`low` (3,), `edge`, m), block by block: first of each cell, the others, and their children.

    The third array is the child number of each of the others.
    """
    is_taken = np.zeros(CELLS**3, bool)
    for begin in range(0, len(records), BLOCK):
        block = np.asarray(records[begin : begin + BLOCK])
        cell = np.clip(((block["at"] - low) * (CELLS / edge)).astype(np.int32), 0, CELLS - 1)
        number = (cell[:, 0] * CELLS + cell[:, 1]) * CELLS + cell[:, 2]
        free = np.flatnonzero(~is_taken[number])
        first = np.sort(free[np.unique(number[free], return_index=True)[1]])
        is_taken[number[first]] = True
        is_rest = np.ones(len(block), bool)
        is_rest[first] = False
        yield block[first], block[is_rest], (cell[is_rest] >= CELLS // 2) @ np.array([4, 2, 1])
