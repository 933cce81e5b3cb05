"""A cloud thinned for a page: one point of each run, whatever the blocks, with the columns that were asked for."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from lslam.core.types.cloud import ArrayCloud, Cloud, CloudBlock, thin_out


class InBlocks(ArrayCloud):
    """The same cloud in blocks of seven points."""

    def blocks(self) -> Iterator[CloudBlock]:
        for k in range(0, len(self), 7):
            some = slice(k, k + 7)
            columns = {name: values[some] for name, values in self.columns.items()}
            yield CloudBlock(self.points[some], None if self.intensity is None else self.intensity[some], columns)


@pytest.mark.parametrize("count", [1, 99, 100, 101, 5000])
def test_one_point_of_each_run_stays_with_what_belongs_to_it(count: int) -> None:
    number = np.arange(count)
    columns = {"red": (number % 251).astype(np.uint8), "scan": number.astype(np.uint16)}
    points = np.column_stack([number, -number, number % 7]).astype(float)
    whole, parts = (kind(points, number.astype(np.float32), columns) for kind in (ArrayCloud, InBlocks))
    found = thin_out(whole, 100, ("red", "blue"))
    kept = found.points[:, 0].astype(int)
    step = -(-count // 100)
    assert np.array_equal(kept // step, np.arange(-(-count // step)))
    assert found.intensity is not None
    assert np.array_equal(found.intensity, kept)
    assert list(found.columns) == ["red"]
    assert np.array_equal(found.columns["red"], kept % 251)
    again: Cloud = parts
    assert np.array_equal(thin_out(again, 100).points, found.points)


def test_a_striped_map_keeps_its_stripes_in_proportion() -> None:
    """Every tenth point is high: each tenth point of the order would be all of them, or none."""
    high = np.arange(100_000) % 10 == 0
    found = thin_out(ArrayCloud.of(np.column_stack([np.zeros(len(high)), np.zeros(len(high)), high])), 10_000)
    assert len(found) == 10_000
    assert found.points[:, 2].mean() == pytest.approx(0.1, abs=0.01)
