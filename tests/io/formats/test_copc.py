"""COPC files: laws of their octree, and laspy's reader as the judge."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pytest
from laspy.copc import Bounds, CopcReader

from lslam.core.types import cloud as cloud_module
from lslam.core.types.cloud import ArrayCloud
from lslam.io.formats import copc_files
from lslam.io.formats.copc_files import octree
from lslam.io.formats.point_files import read_cloud, write_cloud

MOST = 300


def street(count: int = 20_000) -> ArrayCloud:
    """A plane with a wall, near the origin of no CRS, its points in random order."""
    rng = np.random.default_rng(12)
    points = rng.uniform([456_000, 5_427_000, 110], [456_060, 5_427_040, 110.2], (count, 3))
    points[::4, 1:] = rng.uniform([5_427_010, 110], [5_427_010.1, 125], (len(points[::4]), 2))
    columns = {
        "time_ns": 1_700_000_000_000_000_000 + 1000 * np.arange(count),
        "ring": np.arange(count).astype(np.uint16),
    }
    return ArrayCloud(points, rng.random(count).astype(np.float32), columns)


@pytest.fixture(autouse=True)
def _small_nodes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(copc_files, "_MOST", MOST)
    monkeypatch.setattr(copc_files, "_CELLS", 8)


def test_nodes_hold_the_points_of_their_cubes_and_have_parents() -> None:
    steps = np.rint((street().points - [456_000, 5_427_000, 110]) * 1000).astype(np.int32)
    edge = int(steps.max())
    keys, node_of = octree(list(steps.T), edge)
    known = {*map(tuple, keys.tolist())}
    assert len(known) == len(keys)
    sizes = edge / 2.0 ** keys[:, 0]
    corner = (keys[:, 1:] * sizes[:, None])[node_of]
    assert ((steps >= corner) & (steps <= corner + sizes[node_of][:, None])).all()
    parents = {(level - 1, x // 2, y // 2, z // 2) for level, x, y, z in known}
    assert parents - {(-1, 0, 0, 0)} <= known
    # A node that is divided has one point in each of its cells that is not empty, the others have all that is left.
    for node, key in enumerate(map(tuple, keys.tolist())):
        own = node_of == node
        if key not in parents:
            assert own.sum() <= MOST
            continue
        boxes = np.minimum((steps / sizes[node]).astype(int), 2 ** key[0] - 1)
        here = (boxes == keys[node, 1:]).all(1) & (keys[node_of, 0] >= key[0])
        cells = np.minimum((steps / (sizes[node] / 8)).astype(int), 2 ** key[0] * 8 - 1)
        assert len(np.unique(cells[own], axis=0)) == own.sum()
        assert len(np.unique(cells[here], axis=0)) == own.sum()
    assert len(parents) > 5


def test_points_that_share_a_place_end_somewhere() -> None:
    keys, node_of = octree([np.array([0] * 2000 + [500], np.int32)] * 3, 500)
    assert keys[:, 0].max() <= np.log2(500 / 8) + 1
    assert len(node_of) == 2001


def test_laspy_finds_every_point_and_those_of_a_box(tmp_path: Path) -> None:
    path, cloud = tmp_path / "a.copc.laz", street()
    write_cloud(path, cloud)
    with CopcReader.open(str(path)) as reader:
        whole = reader.query()
        order, again = np.argsort(cloud.columns["ring"]), np.argsort(np.array(whole["ring"]))
        np.testing.assert_allclose(np.column_stack([whole.x, whole.y, whole.z])[again], cloud.points[order], atol=6e-4)
        low, high = np.array([456_010.0, 5_427_005, 100]), np.array([456_030.0, 5_427_020, 130])
        some = reader.query(bounds=Bounds(low, high))
        rounded = np.round(cloud.points, 3)
        assert len(some) == np.count_nonzero(((rounded >= low) & (rounded <= high)).all(1))
        levels = [len(reader.query(level=level)) for level in range(5)]
        assert 0 < levels[0] < levels[1]
        info = reader.copc_info
        assert info.gps_min == np.array(whole.gps_time).min()
        assert info.gps_max == np.array(whole.gps_time).max()
        np.testing.assert_allclose(reader.header.mins, rounded.min(0), atol=1e-6)
        np.testing.assert_allclose(reader.header.maxs, rounded.max(0), atol=1e-6)
    # As any LAZ: by laspy's other way, and by ours, which checks the chunks.
    assert len(laspy.read(path).points) == len(read_cloud(path)) == len(cloud)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_points(count: int, tmp_path: Path) -> None:
    path = tmp_path / "a.copc.laz"
    points = np.array([[1.0, 2, 3], [4, 5, 6]])[:count]
    write_cloud(path, ArrayCloud.of(points))
    np.testing.assert_allclose(read_cloud(path).points, points)
    with CopcReader.open(str(path)) as reader:
        assert reader.header.point_count == count


def test_the_same_points_in_blocks_give_the_same_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_cloud(tmp_path / "a.copc.laz", street())
    monkeypatch.setattr(cloud_module, "BLOCK", 700)
    write_cloud(tmp_path / "b.copc.laz", street())
    assert (tmp_path / "a.copc.laz").read_bytes() == (tmp_path / "b.copc.laz").read_bytes()
