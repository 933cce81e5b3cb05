"""Places from above: cells, columns and cover against a slow reference, and correlations against the sum that they are."""

from __future__ import annotations

import numpy as np
import pytest

from lslam.backend.loops.bev_correlation import CELL_M, MOST_VOXELS, BevGrid, correlate, spectrum

RASTER = BevGrid(16)


def clouds() -> list[np.ndarray]:
    rng = np.random.default_rng(4)
    return [rng.uniform(-9, 9, (count, 3)) * [CELL_M, CELL_M, 1.0] for count in (1000, 30)]


def cell(point: np.ndarray) -> tuple[int, int] | None:
    """Row and column, the origin in the corner between the four cells of the middle."""
    r, c = (int(np.floor(v / CELL_M)) + 8 for v in point[:2])
    return (r, c) if 0 <= r < 16 and 0 <= c < 16 else None


def test_columns_count_up_to_the_tallest_and_what_lies_outside_does_not() -> None:
    points, _ = clouds()
    expected = np.zeros((16, 16))
    for point in points:
        if at := cell(point):
            expected[at] += 1
    assert expected.max() > MOST_VOXELS
    assert expected.sum() < len(points)
    np.testing.assert_array_equal(RASTER.heights(points), np.minimum(expected, MOST_VOXELS))


def test_cover_is_what_was_seen_and_one_cell_round_it() -> None:
    _, points = clouds()
    expected = np.zeros((18, 18))
    for point in points:
        if at := cell(point):
            expected[at[0] : at[0] + 3, at[1] : at[1] + 3] = 1
    np.testing.assert_array_equal(RASTER.cover(points[:10], points[10:]), expected[1:-1, 1:-1])
    assert 0 < expected.mean() < 1


def test_the_lowest_of_a_cell() -> None:
    points, _ = clouds()
    expected = np.full((16, 16), np.inf)
    for point in points:
        if at := cell(point):
            expected[at] = min(expected[at], point[2])
    np.testing.assert_array_equal(RASTER.lowest(points), expected.ravel())


def test_a_correlation_is_the_sum_over_cells_at_every_shift() -> None:
    rng = np.random.default_rng(5)
    a, b = rng.uniform(0, 1, (2, 16, 16)).astype(np.float32)
    found, shifts = correlate(spectrum(a), spectrum(b), 16), RASTER.shifts()
    for r, c in ((0, 0), (3, 0), (0, 13), (9, 5)):
        moved = np.roll(b, (round(shifts[r] / CELL_M), round(shifts[c] / CELL_M)), axis=(0, 1))
        assert found[r, c] == pytest.approx(float((a * moved).sum()), rel=1e-4)
    assert (shifts.min(), shifts.max()) == (-8 * CELL_M, 7 * CELL_M)
