"""The merged map of a real recording, against NumPy; `tests/benchmarks/waits.py` has what it takes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.core.geometry import se3
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.maps.floor_plan import top_view
from lslam.maps.merge import MapMerger


def pack(cells: NDArray[np.float64]) -> NDArray[np.int64]:
    """One key per voxel index (N, 3)."""
    x, y, z = (cells.astype(np.int64) + 100_000).T
    return np.asarray((x << 40) | (y << 20) | z)


def test_a_recording_merges_as_in_numpy(recordings: Callable[[str], Path]) -> None:
    drive = recordings("kitti_raw_0048") / "2011_09_26" / "2011_09_26_drive_0048_sync"
    poses = read_trajectory(drive / "reference_lidar.tum").poses
    files = sorted((drive / "velodyne_points" / "data").glob("*.bin"))
    scans = [np.fromfile(file, np.float32).reshape(-1, 4) for file in files]
    assert len(scans) == len(poses) == 22

    merger = MapMerger(0.2, 2.0, 80.0)
    world = []
    for scan, T in zip(scans, poses, strict=True):
        points, intensity = np.ascontiguousarray(scan[:, :3]), np.ascontiguousarray(scan[:, 3])
        merger.add(points, T, intensity)
        distance = np.linalg.norm(points.astype(np.float64), axis=1)
        world.append(se3.apply(T, points[(distance >= 2.0) & (distance <= 80.0)]))
    merged = merger.result()

    xyz = np.concatenate(world)
    cells, inverse, counts = np.unique(np.floor(xyz / 0.2), axis=0, return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(inverse.reshape(-1), column) / counts for column in xyz.T], axis=1)
    # A coordinate that falls on a voxel's border to the last bit may round to either side: a handful at most.
    assert merged.counts.sum() == len(xyz)
    _, ours, theirs = np.intersect1d(pack(np.floor(merged.points / 0.2)), pack(cells), return_indices=True)
    same = merged.counts[ours] == counts[theirs]
    assert max(len(merged), len(cells)) - same.sum() <= 5
    np.testing.assert_allclose(merged.points[ours][same], means[theirs][same], atol=1e-6)
    assert merged.intensity is not None
    assert 0.0 <= merged.intensity.min() <= merged.intensity.max() <= 1.0

    view = top_view(merged.points)
    x0, x1, y0, y1 = view.extent
    assert x0 < poses[0, 0, 3] < x1
    assert y0 < poses[0, 1, 3] < y1
    assert view.image.sum() > 0.98 * len(merged)
