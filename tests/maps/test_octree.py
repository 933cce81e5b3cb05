"""Octree of a map: every point once, within its cube, at half the spacing a level, in little memory, the same bytes again."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lslam.core.errors import InterruptedRunError
from lslam.core.types.cloud import ArrayCloud, CloudBlock
from lslam.maps import octree
from lslam.maps.octree import CELLS, DEEPEST, FEW, QUANTA, cube_of, points_of, write_octree


def made(cloud: Any, folder: Path, **more: Any) -> tuple[dict[str, Any], bytes]:
    stream = io.BytesIO()
    return write_octree(stream, folder, cloud, (0.0, 100.0), **more), stream.getvalue()


def nodes(tree: Mapping[str, Any], data: bytes) -> Iterator[tuple[str, Any, dict[str, Any]]]:
    """Name, points (n, 3) and columns of each node."""
    for name, (begin, count) in tree["nodes"].items():
        points = points_of(name, data[begin : begin + 6 * count], tree)
        at, columns = begin + 6 * count, {}
        for column, size in tree["columns"].items():
            columns[column] = np.frombuffer(data, np.uint8, size * count, at).reshape(count, size)
            at += size * count
        yield name, points, columns


@pytest.fixture
def cloud() -> ArrayCloud:
    """A floor of 300 m by 120 m with a tower on it; each point knows its number by its colour."""
    rng = np.random.default_rng(1)
    count = 100_000
    points = np.column_stack([rng.uniform(-20, 280, count), rng.uniform(0, 120, count), rng.normal(0, 0.1, count)])
    points[:20_000] = rng.uniform((40, 40, 0), (50, 50, 90), (20_000, 3))
    number = np.arange(count)
    colours = {
        name: (number >> shift & 255).astype(np.uint8) for name, shift in (("red", 16), ("green", 8), ("blue", 0))
    }
    return ArrayCloud(points, (number % 101).astype(np.float32), {**colours, "class": (number % 7).astype(np.uint16)})


@pytest.mark.parametrize("held", [1 << 22, 20_000])
def test_every_point_is_in_one_node_and_in_its_cube(cloud: ArrayCloud, tmp_path: Path, held: int) -> None:
    tree, data = made(cloud, tmp_path, most_points=held)
    assert tree["points"] == len(cloud) == sum(count for _, count in tree["nodes"].values())
    assert not list(tmp_path.iterdir()), "what does not fit into memory is gone again"
    seen = np.zeros(len(cloud), int)
    for name, points, columns in nodes(tree, data):
        low, edge = cube_of(name, np.array(tree["low"]), tree["edge"])
        assert (points >= low - 1e-9).all()
        assert (points <= low + edge + 1e-9).all()
        number = columns["rgb"].astype(int) @ [65536, 256, 1]
        seen[number] += 1
        # Half a step of the node, and the rounding of 32 bits.
        np.testing.assert_allclose(points, cloud.points[number], atol=0.5 * edge / QUANTA + 4e-5)
        np.testing.assert_array_equal(columns["class"][:, 0], number % 7)
        np.testing.assert_allclose(columns["intensity"][:, 0], 2.55 * (number % 101), atol=0.51)
    assert (seen == 1).all()


def test_a_level_halves_the_spacing_and_parents_are_there(
    cloud: ArrayCloud, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(octree, "BLOCK", 10_000)  # a cell has one point of all blocks
    tree, data = made(cloud, tmp_path)
    assert max(map(len, tree["nodes"])) >= 3
    for name, points, _ in nodes(tree, data):
        assert name == "r" or name[:-1] in tree["nodes"]
        low, edge = cube_of(name, np.array(tree["low"]), tree["edge"])
        assert edge == pytest.approx(tree["edge"] / 2 ** (len(name) - 1))
        if any(f"{name}{k}" in tree["nodes"] for k in range(8)):
            cells = np.floor((points - low) / edge * CELLS * (1 - 1e-4)).astype(int)
            # One point a cell, but for those that rounding put beyond a border.
            assert len(np.unique(cells, axis=0)) > 0.97 * len(points)
        else:
            assert len(points) <= FEW


def test_points_on_one_place_end_at_the_deepest_level(tmp_path: Path) -> None:
    points = np.repeat([[1.0, 2.0, 3.0], [900.0, 2.0, 3.0]], [FEW + 100, 1], axis=0)
    tree, _ = made(ArrayCloud.of(points), tmp_path)
    assert tree["points"] == len(points)
    assert max(map(len, tree["nodes"])) == DEEPEST + 1


def test_the_same_bytes_again_and_with_little_memory(cloud: ArrayCloud, tmp_path: Path) -> None:
    whole = made(cloud, tmp_path)
    assert made(cloud, tmp_path) == whole
    # Points that do not fit into memory come out in the same nodes and order.
    assert made(cloud, tmp_path, most_points=1000) == whole


def test_what_is_not_finite_is_left_out_and_nothing_is_a_tree_too(tmp_path: Path) -> None:
    tree, _ = made(ArrayCloud.of([[np.nan, 0, 0], [1, 2, 3], [np.inf, 0, 0]]), tmp_path)
    assert (tree["points"], tree["columns"]) == (1, {})
    tree, data = made(ArrayCloud.of([]), tmp_path)
    assert (tree["points"], tree["nodes"], data) == (0, {"r": (0, 0)}, b"")


class Endless:
    """A floor, in blocks that nobody holds."""

    has_intensity, column_types = False, {}

    def __init__(self, blocks: int) -> None:
        self.count = blocks

    def __len__(self) -> int:
        return self.count << 16

    def blocks(self) -> Iterator[CloudBlock]:
        for k in range(self.count):
            rng = np.random.default_rng(k)
            yield CloudBlock(rng.uniform(0, (100, 100, 0.1), (1 << 16, 3)))


def test_memory_does_not_grow_with_the_map(tmp_path: Path) -> None:
    import tracemalloc

    peaks = []
    for blocks in (4, 16):
        tracemalloc.start()
        with (tmp_path / "nodes").open("wb") as stream:
            tree = write_octree(stream, tmp_path, Endless(blocks), (0, 1), most_points=1 << 15)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert tree["points"] == blocks << 16
    assert peaks[1] < 1.3 * peaks[0]


def test_it_can_be_stopped(cloud: ArrayCloud, tmp_path: Path) -> None:
    shares: list[float] = []

    def on_share(share: float) -> None:
        shares.append(share)
        if share > 0.5:
            raise InterruptedRunError("stopped")

    with pytest.raises(InterruptedRunError):
        made(cloud, tmp_path, on_share=on_share)
    assert shares == sorted(shares)
