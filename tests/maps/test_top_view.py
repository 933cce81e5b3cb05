"""The density image of a map."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator

import numpy as np
import pytest

from lslam.core.types.cloud import CloudBlock, thin_out
from lslam.maps.floor_plan import top_view


def test_every_point_is_counted_in_its_pixel() -> None:
    points = np.random.default_rng(1).uniform([-20, 5, 0], [10, 25, 3], (5000, 3))
    view = top_view(points, pixel=0.5, trim=0.0)
    image, (x0, x1, y0, y1) = view.image, view.extent
    height, width = image.shape
    assert image.sum() == 5000
    assert (x1 - x0) / width == pytest.approx(0.5)
    assert (y1 - y0) / height == pytest.approx(0.5)
    expected, _, _ = np.histogram2d(
        points[:, 1], points[:, 0], (height, width), ((y0, y0 + height * 0.5), (x0, x0 + width * 0.5))
    )
    assert np.array_equal(image, expected[::-1])
    heights, _, _ = np.histogram2d(
        points[:, 1],
        points[:, 0],
        (height, width),
        ((y0, y0 + height * 0.5), (x0, x0 + width * 0.5)),
        weights=points[:, 2],
    )
    seen = image > 0
    np.testing.assert_allclose(view.heights[seen], heights[::-1][seen] / image[seen], rtol=1e-5)
    assert np.isnan(view.heights[~seen]).all()


def test_row_zero_is_north_and_column_zero_west() -> None:
    points = np.array([[0, 0, 0], [0, 10, 0], [0, 10, 1], [20, 10, 0]], float)
    view = top_view(points, pixel=1.0, trim=0.0)
    image, extent = view.image, view.extent
    assert image.shape == (11, 21)
    assert (image[0, 0], image[0, 20], image[10, 0], image.sum()) == (2, 1, 1, 4)
    assert extent == (0.0, 21.0, 0.0, 11.0)


@pytest.mark.parametrize("shape", [(5000.0, 300.0), (300.0, 5000.0), (4000.0, 4000.0)])
def test_long_side_is_bounded(shape: tuple[float, float]) -> None:
    points = np.random.default_rng(2).uniform(0, 1, (20_000, 3)) * [*shape, 1]
    image = top_view(points, trim=0.0).image
    assert 1500 < max(image.shape) <= 1600
    assert image.sum() == 20_000


def test_stray_points_do_not_shrink_the_map() -> None:
    points = np.random.default_rng(3).uniform(0, 100, (10_000, 3))
    points[:5] = 1e6
    x0, x1, _, _ = top_view(points).extent
    assert x0 > -1
    assert x1 < 101


def test_large_coordinates_keep_their_pixels() -> None:
    points = np.random.default_rng(4).uniform(0, 50, (3000, 3))
    near = top_view(points, pixel=0.25).image
    far = top_view(points + np.array([5e6, 5e6, 0]), pixel=0.25).image
    assert near.shape == far.shape
    assert np.abs(near - far).sum() < 10  # a point on an edge may round to the other side


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.full((4, 3), np.nan)])
def test_nothing_to_see(points: np.ndarray) -> None:
    view = top_view(points)
    assert view.image.tolist() == [[0.0]]
    assert np.isnan(view.heights).all()
    assert view.extent == (0.0, 1.0, 0.0, 1.0)


def test_one_point_and_points_that_are_not_finite() -> None:
    view = top_view(np.array([[3.0, 4.0, 0.0], [np.nan, 1.0, 1.0], [np.inf, 1.0, 1.0]]))
    x0, x1, _, _ = view.extent
    assert view.image.tolist() == [[1.0]]
    assert x0 == pytest.approx(3.0)
    assert x1 - x0 == pytest.approx(0.2)


class Stream:
    """A cloud of `count` blocks, each made when it is asked for."""

    SIZE, has_intensity = 1 << 16, False

    def __init__(self, count: int) -> None:
        self.count = count

    def __len__(self) -> int:
        return self.count * self.SIZE

    def blocks(self) -> Iterator[CloudBlock]:
        for k in range(self.count):
            yield CloudBlock(np.random.default_rng(k).uniform(-100, 100, (self.SIZE, 3)), None)


def test_a_map_of_any_size_is_seen_in_the_memory_of_a_few_blocks() -> None:
    block = Stream.SIZE * 3 * 8
    for look in (lambda cloud: top_view(cloud, longest=100), lambda cloud: thin_out(cloud, 1000)):
        tracemalloc.start()
        look(Stream(24))
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < 10 * block, "24 blocks are not held"


def test_pixels_hold_whole_columns_of_voxels_however_wide_the_map() -> None:
    """A floor of one point a voxel has one density: pixels of one column and of two would draw stripes."""
    x, y = np.meshgrid(np.arange(2300), np.arange(40), indexing="ij")
    points = 0.2 * np.column_stack([x.ravel() + 0.5, y.ravel() + 0.5, np.zeros(x.size)]) - [31.4, 7.0, 0]
    view = top_view(points, pixel=0.2, longest=1600, trim=0.0)
    assert max(view.image.shape) <= 1600
    inner = view.image[2:-2, 2:-2]
    assert inner.min() == inner.max() == 4
