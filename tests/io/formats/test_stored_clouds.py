"""Maps read from their files block by block: what was written, colours and classes too, and only as much as is asked for."""

from __future__ import annotations

import resource
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from lslam.core.errors import InputError
from lslam.core.types.cloud import BLOCK, ArrayCloud, in_memory
from lslam.io.formats.point_files import MapCloud, open_map, write_cloud


def coloured(count: int = 1000) -> ArrayCloud:
    rng = np.random.default_rng(2)
    colours = {name: rng.integers(0, 256, count, np.uint8) for name in ("red", "green", "blue")}
    points, values = rng.uniform(-50, 50, (count, 3)), rng.integers(0, 65536, count).astype(np.float32)
    return ArrayCloud(points, values, {**colours, "class": rng.integers(0, 260, count, np.uint16)})


@pytest.mark.parametrize("name", ["map.ply", "map.las", "map.laz", "map.copc.laz", "map.pcd"])
def test_a_map_comes_back(tmp_path: Path, name: str) -> None:
    cloud = coloured()
    write_cloud(tmp_path / name, cloud)
    stored = open_map(tmp_path / name, ("class",))
    read = in_memory(stored)
    assert (len(stored), stored.has_intensity) == (len(cloud), True)
    _, own = cKDTree(cloud.points).query(read.points)  # COPC has them in an order of its own
    assert len(np.unique(own)) == len(cloud)
    np.testing.assert_allclose(read.points, cloud.points[own], atol=0.0006)
    for column in ("red", "green", "blue", "class"):
        np.testing.assert_array_equal(read.columns[column], cloud.columns[column][own])


def test_several_files_are_one_map_in_the_world(tmp_path: Path) -> None:
    paths = []
    for k in range(2):
        cloud = coloured(10 + k)
        cloud = cloud if k else ArrayCloud(cloud.points, cloud.intensity)
        write_cloud(tmp_path / f"tile_{k}_0.ply", cloud)
        paths.append(tmp_path / f"tile_{k}_0.ply")
    both = MapCloud(paths, ("class",), lambda points: points + 100)
    read = in_memory(both)
    assert (len(both), len(read), dict(both.column_types)) == (21, 21, {}), "columns that one lacks are left out"
    np.testing.assert_allclose(read.points[:10], coloured(10).points + 100, atol=1e-5)


def test_blocks_of_a_ply_are_read_when_they_are_asked_for(tmp_path: Path) -> None:
    write_cloud(tmp_path / "map.ply", ArrayCloud.of(np.random.default_rng(0).uniform(0, 1, (3 * BLOCK, 3))))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    blocks = open_map(tmp_path / "map.ply", ()).blocks()
    first = next(blocks)
    assert len(first) == BLOCK
    assert first.points.base is None or first.points.flags.owndata
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 60_000


def test_of_many_files_one_is_held(tmp_path: Path) -> None:
    """Nor is one open: a map may have more tiles than a process may have files."""
    paths = [tmp_path / f"tile_{k}_0.ply" for k in range(40)]
    for path in paths:
        write_cloud(path, ArrayCloud.of(np.random.default_rng(0).uniform(0, 1, (50_000, 3))))
    before = len(list(Path("/proc/self/fd").iterdir()))
    tracemalloc.start()
    cloud, count = MapCloud(paths, (), lambda points: points), 0
    for block in cloud.blocks():
        count += len(block)
        assert len(list(Path("/proc/self/fd").iterdir())) <= before + 2
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert count == len(cloud) == 40 * 50_000
    assert peak < 5 * 50_000 * 3 * 8


def test_damage_is_named(tmp_path: Path) -> None:
    (tmp_path / "empty.ply").touch()
    (tmp_path / "other.ply").write_text("nothing")
    for name in ("empty.ply", "other.ply", "none.ply", "none.laz"):
        with pytest.raises(InputError, match=name):
            open_map(tmp_path / name, ())
