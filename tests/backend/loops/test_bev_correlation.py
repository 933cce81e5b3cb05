"""Places from above: cells, columns and cover against a slow reference, and correlations against the sums that they are."""

from __future__ import annotations

import numpy as np
import pytest

from lslam.backend.kernels import bev
from lslam.backend.loops.level_submap import (
    CELL_M,
    MOST_VOXELS,
    BestShifts,
    BevGrid,
    correlate,
    peaks,
    spectra,
)
from lslam.core.geometry import se2

RASTER = BevGrid(16)


def clouds() -> list[np.ndarray]:
    rng = np.random.default_rng(4)
    return [rng.uniform(-9, 9, (count, 3)) * [CELL_M, CELL_M, 1.0] for count in (1000, 30)]


def cell(point: np.ndarray, edge: float = CELL_M) -> tuple[int, int] | None:
    """Row and column, the origin in the corner between the four cells of the middle."""
    r, c = (int(np.floor(v / edge)) + 8 for v in point[:2])
    return (r, c) if 0 <= r < 16 and 0 <= c < 16 else None


@pytest.mark.parametrize("edge", [CELL_M, 1.1])
def test_columns_count_up_to_the_tallest_and_what_lies_outside_does_not(edge: float) -> None:
    points, ground = clouds()
    expected = np.zeros((16, 16))
    for point in points:
        if at := cell(point, edge):
            expected[at] += 1
    assert expected.max() > MOST_VOXELS
    assert expected.sum() < len(points)
    heights, squares, _ = BevGrid(16, edge).view(points, ground)
    np.testing.assert_array_equal(heights, np.minimum(expected, MOST_VOXELS))
    np.testing.assert_array_equal(squares, heights**2)


def test_a_view_is_of_the_points_turned() -> None:
    points, ground = clouds()
    R = se2.rotation(0.6)
    np.testing.assert_allclose(R @ [1.0, 0.0], [np.cos(0.6), np.sin(0.6)])
    turned = [np.column_stack([p[:, :2] @ R.T, p[:, 2]]) for p in (points, ground)]
    np.testing.assert_array_equal(RASTER.view(points, ground, R), RASTER.view(*turned))


def test_cover_is_what_was_seen_and_one_cell_round_it() -> None:
    _, points = clouds()
    expected = np.zeros((18, 18))
    for point in points:
        if at := cell(point):
            expected[at[0] : at[0] + 3, at[1] : at[1] + 3] = 1
    np.testing.assert_array_equal(RASTER.view(points[:10], points[10:])[2], expected[1:-1, 1:-1])
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
    a, b = rng.uniform(0, 1, (2, 3, 16, 16)).astype(np.float32)
    found, shifts = correlate(spectra(a), spectra(b)), RASTER.shifts(np.arange(256))
    for at in (0, 48, 13, 149):
        moved = np.roll(b, np.round(shifts[at] / CELL_M).astype(int), axis=(1, 2))
        assert found.reshape(3, -1)[:, at] == pytest.approx((a * moved).sum(axis=(1, 2)), rel=1e-4)
    assert (shifts.min(), shifts.max()) == (-8 * CELL_M, 7 * CELL_M)


def test_scores_are_normalised_and_of_the_best_heading() -> None:
    rng = np.random.default_rng(6)
    a, b, c = rng.uniform(1, 3, (3, 16, 16)).astype(np.float32)
    ones = np.ones_like(a)
    best = BestShifts(np.array([0, 5, 100]))
    for heading, image in enumerate((b, c, a)):
        sums = correlate(spectra(np.stack([a, ones, a**2])), spectra(np.stack([image, image**2, ones])))
        best.observe(sums, 1.0, heading)
        best.observe(sums, float((image**2).sum()) + 1.0, 9)  # too little of it was observed
    expected = [
        [
            (a * np.roll(image, divmod(k, 16), axis=(0, 1))).sum() / np.sqrt((a**2).sum() * (image**2).sum())
            for k in best.cells
        ]
        for image in (b, c, a)
    ]
    assert best.score == pytest.approx(np.max(expected, axis=0), rel=1e-4)
    assert best.heading.tolist() == np.argmax(expected, axis=0).tolist()
    assert best.score[0] == pytest.approx(1.0)
    assert best.heading[0] == 2


def test_two_searches_merge_cell_by_cell() -> None:
    one, other = BestShifts(np.arange(3)), BestShifts(np.arange(3))
    one.score[:], one.heading[:] = (0.2, 0.8, 0.5), 1
    other.score[:], other.heading[:] = (0.6, 0.4, 0.1), (4, 5, 6)
    one.merge(other, np.array([1, 0, 2]))
    assert one.score == pytest.approx([0.4, 0.8, 0.5])
    assert one.heading.tolist() == [5, 1, 1]


def test_a_structure_is_fitted_where_it_lies_in_an_image() -> None:
    rng = np.random.default_rng(7)
    image = rng.uniform(-1, 1, (20, 20)).astype(np.float32)
    image[:, 12] = np.nan
    cells = np.argwhere(np.ones((6, 6)))
    own = image[5:11, 8:14].ravel()
    is_seen = np.isfinite(own)
    structure = np.where(is_seen, own, np.float32(7.0))
    least = float((own[is_seen] ** 2).sum())
    assert bev.fit(image, cells, structure, 0.99 * least, 4, 7, 1) == pytest.approx((1.0, 1, 1))
    assert bev.fit(image, cells, structure, 0.99 * least, 4, 8, 1)[1:] == (1, 0)
    # One farther, and where more of it must be observed than is.
    assert bev.fit(image, cells, structure, 0.99 * least, 3, 7, 1)[0] < 0.9
    assert bev.fit(image, cells, structure, 1e6, 4, 7, 1) == (0.0, 0, 0)
    assert bev.fit(image, cells, structure, 0.0, -15, 7, 1)[0] == pytest.approx(0.0)


def test_peaks_lie_apart_fit_nearly_as_well_and_are_few() -> None:
    shifts = np.column_stack([np.arange(-20.0, 20.0, 0.5), np.zeros(80)])

    def starts(*tops: tuple[float, float]) -> list[float]:
        score = np.zeros(len(shifts), np.float32)
        for x, height in tops:
            score[np.searchsorted(shifts[:, 0], x)] = height
        return [float(shifts[k, 0]) for k in peaks(shifts, score, 4.0, 5, 0.7)]

    assert starts((0.0, 1.0), (3.5, 0.9), (-4.0, 0.8)) == [0.0, -4.0]
    assert starts((0.0, 1.0), (5.0, 0.72), (-5.0, 0.68)) == [0.0, 5.0]
    assert starts(*[(6.0 * k, 1.0 - 0.01 * k) for k in range(-3, 4)]) == [-18.0, -12.0, -6.0, 0.0, 6.0]
    assert starts() == []
