"""The voxel kernels against NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.maps.kernels.cells import AXIS_BITS, add_rows, enter, sum_up, unpack

NO_INTENSITY, NO_TAGS = np.zeros(0, np.float32), np.zeros((0, 3), np.int64)
ORIGIN = np.zeros(3, np.int64)
ALL = np.array([-np.inf, np.inf] * 3)


def run(
    points: NDArray[np.float32],
    T: NDArray[np.float64],
    voxel: float,
    near: float = 0.0,
    far: float = 1e6,
    slots: int = 0,
) -> tuple[NDArray[np.int64], NDArray[np.int32], int, int]:
    size = slots or 1 << int(np.ceil(np.log2(2 * len(points) + 2)))
    table = np.full(size, -1, np.int32)
    rows = np.empty((len(points) + 1, 5), np.int64)
    runs = np.empty_like(rows)
    count, gated, outside = sum_up(points, NO_INTENSITY, NO_TAGS, T, near, far, voxel, ALL, ORIGIN, runs)
    used = add_rows(runs[:count], False, table, rows, 0)
    return rows[:used], table, gated, outside


def reference(
    points: NDArray[np.float32], T: NDArray[np.float64], voxel: float
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Means and counts per voxel, sorted by voxel."""
    world = points.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    _, inverse, counts = np.unique(np.floor(world / voxel), axis=0, return_inverse=True, return_counts=True)
    inverse = inverse.reshape(-1)
    means = np.stack([np.bincount(inverse, world[:, axis]) / counts for axis in range(3)], axis=1)
    return means, counts


@pytest.fixture
def cloud() -> NDArray[np.float32]:
    return np.random.default_rng(3).normal(0, 4, (20_000, 3)).astype(np.float32)


def pose() -> NDArray[np.float64]:
    T = np.eye(4)
    c, s = np.cos(0.7), np.sin(0.7)
    T[:2, :2] = [[c, -s], [s, c]]
    T[:3, 3] = 12.34, -56.78, 9.1
    return T


@pytest.mark.parametrize("voxel", [0.17, 0.9, 5.0])
def test_means_and_counts_equal_numpy(cloud: NDArray[np.float32], voxel: float) -> None:
    rows, *_ = run(cloud, pose(), voxel)
    rows = rows[np.argsort(rows[:, 0])]
    means, counts = reference(cloud, pose(), voxel)
    assert np.array_equal(rows[:, 4], counts)
    np.testing.assert_allclose(unpack(rows, ORIGIN, voxel), means, atol=1e-6 * voxel)


def test_a_crowded_table_gives_the_same_rows(cloud: NDArray[np.float32]) -> None:
    few = cloud[:4000]
    roomy, *_ = run(few, pose(), 0.5)
    crowded, *_ = run(few, pose(), 0.5, slots=4096)
    assert np.array_equal(roomy, crowded)


def test_enter_finds_every_row_again(cloud: NDArray[np.float32]) -> None:
    rows, _, *_ = run(cloud, pose(), 0.5)
    slots = np.full(1 << 16, -1, np.int32)
    enter(slots, rows, len(rows))
    assert np.array_equal(np.sort(slots[slots >= 0]), np.arange(len(rows)))
    # Adding the same scan to the rebuilt table opens no new row and doubles every sum.
    room = np.concatenate([rows, np.empty((len(cloud), 5), np.int64)])
    runs = np.empty((len(cloud), 5), np.int64)
    count, *_ = sum_up(cloud, NO_INTENSITY, NO_TAGS, pose(), 0.0, 1e6, 0.5, ALL, ORIGIN, runs)
    used = add_rows(runs[:count], False, slots, room, len(rows))
    assert used == len(rows)
    assert np.array_equal(room[:used, 1:], 2 * rows[:, 1:])


def test_gate_counts_what_it_refuses() -> None:
    points = np.array(
        [[0, 0, 0], [np.nan, 1, 1], [np.inf, 0, 0], [-np.inf, 0, 0], [1, 0, 0], [3, 4, 0], [6, 8, 0], [2, 0, 0]],
        np.float32,
    )
    rows, _, gated, outside = run(points, np.eye(4), 1.0, near=2.0, far=5.0)
    assert (len(rows), gated, outside) == (2, 6, 0)  # the gate's own borders belong to it


def test_keys_end_at_the_range_of_their_bits() -> None:
    half = 2 ** (AXIS_BITS - 1)
    points = np.array([[half - 1, 1, 1], [half, 1, 1], [-half, 1, 1], [-half - 1, 1, 1], [1, 1, 3 * half]], np.float32)
    rows, _, gated, outside = run(points + np.float32(0.25), np.eye(4), 1.0, far=1e12)
    assert (len(rows), gated, outside) == (2, 0, 3)
    np.testing.assert_allclose(np.sort(unpack(rows, ORIGIN, 1.0)[:, 0]), [0.25 - half, half - 0.75])
