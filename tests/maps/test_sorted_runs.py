"""Maps that do not fit into memory: the same bytes, flat memory, nothing left behind."""

from __future__ import annotations

import gc
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from resident import resident_mb

from lslam.core.errors import OutputError
from lslam.core.geometry import se3
from lslam.core.types.cloud import bounds
from lslam.maps import sorted_runs
from lslam.maps.merge import MapMerger, MergedMap
from lslam.maps.sorted_runs import SortedRuns, StoredRows

Scan = tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float32]]


def drive(scans: int, points: int = 4000) -> list[Scan]:
    rng = np.random.default_rng(8)
    return [
        (
            rng.uniform(-15, 15, (points, 3)).astype(np.float32),
            se3.make(np.eye(3), np.array([2.0 * i, 0, 0])),
            rng.uniform(0, 1, points).astype(np.float32),
        )
        for i in range(scans)
    ]


def merged(scans: list[Scan], **settings: object) -> MergedMap:
    merger = MapMerger(0.5, 0.0, 50.0, **settings)  # type: ignore[arg-type]
    for points, T, intensity in scans:
        merger.add(points, T, intensity)
    return merger.result()


@pytest.mark.parametrize("part", [1 << 10, 1 << 20])
def test_a_map_of_many_runs_is_the_map_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: int) -> None:
    monkeypatch.setattr(sorted_runs, "PART", part)
    monkeypatch.setattr(sorted_runs, "_SAMPLE", 64)
    scans = drive(20)
    near = merged(scans)
    far = merged(scans, most=9000, spool=tmp_path)
    assert list(tmp_path.iterdir()), "nothing was spilled"
    assert near.points.tobytes() == far.points.tobytes()
    assert near.counts.tobytes() == far.counts.tobytes()
    assert near.intensity is not None
    assert far.intensity is not None
    assert near.intensity.tobytes() == far.intensity.tobytes()
    assert [b.tolist() for b in bounds(near)] == [b.tolist() for b in bounds(far)]
    del far
    gc.collect()
    assert not list(tmp_path.iterdir()), "the temporary folder outlived the map"


def test_runs_of_other_width_lose_the_column_all_have_not(tmp_path: Path) -> None:
    """A scan without intensity after a spill: the map has none, its points are all there."""
    scans = drive(6)
    merger = MapMerger(0.5, 0.0, 50.0, most=9000, spool=tmp_path)
    for k, (points, T, intensity) in enumerate(scans):
        merger.add(points, T, None if k == 5 else intensity)
    result = merger.result()
    assert result.intensity is None
    assert result.points.tobytes() == merged(scans).points.tobytes()


def test_equal_keys_keep_the_order_of_the_runs(tmp_path: Path) -> None:
    runs = SortedRuns(tmp_path)
    for k in range(5):
        runs.add(np.array([[key, k] for key in range(k, 40, 3)], np.int64))
    seen: list[list[int]] = []

    def keep(rows: NDArray[np.int64]) -> NDArray[np.int64]:
        seen.extend(rows.tolist())
        return rows[:1]

    runs.merge(keep)
    assert seen == sorted([[key, k] for k in range(5) for key in range(k, 40, 3)])


def test_rows_are_divided_into_parts_that_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sorted_runs, "PART", 1000)
    monkeypatch.setattr(sorted_runs, "_SAMPLE", 50)
    rng = np.random.default_rng(0)
    runs = SortedRuns(tmp_path)
    for _ in range(10):
        runs.add(np.sort(rng.integers(0, 10**9, 3000))[:, None].repeat(2, axis=1))
    sizes: list[int] = []

    def count(rows: NDArray[np.int64]) -> NDArray[np.int64]:
        sizes.append(len(rows))
        return rows

    whole = runs.merge(count)
    assert len(whole) == sum(sizes) == 30_000
    assert max(sizes) < 2500
    keys = whole.read(0, len(whole))[:, 0]
    assert np.all(np.diff(keys) >= 0)


def test_memory_does_not_grow_with_the_map(tmp_path: Path) -> None:
    """Twenty times the voxels that are kept in memory, written out block by block."""

    rng = np.random.default_rng(1)
    merger = MapMerger(0.1, 0.0, 100.0, most=200_000, spool=tmp_path)
    highest = []
    for i in range(60):
        merger.add(rng.uniform(-30, 30, (60_000, 3)).astype(np.float32), se3.make(np.eye(3), np.array([5.0 * i, 0, 0])))
        highest.append(resident_mb())
    result = merger.result()
    assert len(result) > 3_000_000
    total = 0
    for block in result.blocks():
        total += len(block)
        highest.append(resident_mb())
    assert total == len(result)
    # All rows are 150 MB and the points of the map 80 MB more; a part being combined takes about 130.
    assert max(highest[30:60]) - highest[10] < 20
    assert max(highest[60:]) - highest[10] < 150


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot be written"):
        SortedRuns(tmp_path / "absent")
    with pytest.raises(OutputError, match=r"run-0 cannot be written"):
        StoredRows(tmp_path / "absent" / "run-0", 2, None).append(np.zeros((1, 2), np.int64))


def test_crop_keeps_what_is_inside() -> None:
    scans = drive(3)
    cropped = merged(scans, crop=(-5, 5, -2, 8, 0, 1))
    whole = np.concatenate([se3.apply(T, points) for points, T, _ in scans])
    inside = ((whole >= [-5, -2, 0]) & (whole <= [5, 8, 1])).all(1)
    assert cropped.counts.sum() == inside.sum() > 0
    assert (cropped.points >= [-5, -2, 0]).all()
    assert (cropped.points <= [5, 8, 1]).all()
