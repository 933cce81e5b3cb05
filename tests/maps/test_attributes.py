"""Attributes of map points: of the nearest observation in a voxel, of every point without voxels."""

from __future__ import annotations

import gc
from pathlib import Path

import numpy as np
import pytest
from resident import resident_mb

from lslam.core.errors import InputError
from lslam.core.geometry import se3
from lslam.core.types.cloud import CloudBlock, in_memory
from lslam.core.types.scan import NO_RING, Scan
from lslam.maps import every_point, sorted_runs
from lslam.maps.every_point import EveryPointMap, PointCollector
from lslam.maps.merge import MapMerger, MergedMap
from lslam.maps.observations import Observations

NAMES = ("time", "scan", "ring", "range", "observations", "class")
VOXEL = 0.5
Drive = list[tuple[Scan, np.ndarray]]


def drive(scans: int = 12, points: int = 3000, first: int = 0) -> Drive:
    rng = np.random.default_rng(9)
    return [
        (
            Scan(
                rng.uniform(-15, 15, (points, 3)).astype(np.float32),
                1_700_000_000_000_000_000 + 100_000_000 * k,
                first + k,
                rng.random(points).astype(np.float32),
                rng.uniform(0, 0.1, points).astype(np.float32),
                rng.integers(0, 16, points).astype(np.uint16),
                labels=rng.integers(0, 300, points).astype(np.uint16),
            ),
            se3.make(np.eye(3), np.array([1.5 * k, 0, 0])),
        )
        for k in range(scans)
    ]


def add(merger: MapMerger | PointCollector, scans: Drive) -> None:
    for scan, T in scans:
        merger.add(scan.points, T, scan.intensity, Observations.of(scan))


def merged(scans: Drive, **settings: object) -> MergedMap:
    merger = MapMerger(VOXEL, 0.0, 50.0, attributes=NAMES, **settings)  # type: ignore[arg-type]
    add(merger, scans)
    return merger.result()


def collected(scans: Drive, **settings: object) -> EveryPointMap:
    collector = PointCollector(2.0, 14.0, attributes=NAMES, **settings)  # type: ignore[arg-type]
    add(collector, scans)
    return collector.result()


def bytes_of(cloud: MergedMap | EveryPointMap) -> list[bytes]:
    whole = in_memory(cloud)
    assert whole.intensity is not None
    return [whole.points.tobytes(), whole.intensity.tobytes(), *(v.tobytes() for v in whole.columns.values())]


def test_a_voxel_has_the_attributes_of_its_nearest_observation() -> None:
    scans = drive()
    near: dict[tuple[int, ...], tuple[float, ...]] = {}
    counts: dict[tuple[int, ...], int] = {}
    for scan, T in scans:
        assert scan.times is not None
        assert scan.rings is not None
        assert scan.labels is not None
        world = scan.points.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
        ranges = np.linalg.norm(scan.points.astype(np.float64), axis=1).astype(np.float32)
        for k, cell in enumerate(map(tuple, np.floor(world / VOXEL).astype(int).tolist())):
            time_ns = scan.stamp_ns + round(1e9 * float(scan.times[k]))
            own = (float(ranges[k]), scan.index, time_ns, int(scan.rings[k]), int(scan.labels[k]))
            near[cell] = min(near.get(cell, own), own)
            counts[cell] = counts.get(cell, 0) + 1
    whole = in_memory(merged(scans))
    cells = list(map(tuple, np.floor(whole.points / VOXEL).astype(int).tolist()))
    assert sorted(cells) == sorted(near)
    columns = whole.columns
    for k, cell in enumerate(cells):
        own = tuple(columns[name][k].item() for name in ("range", "scan", "time_ns", "ring", "class"))
        assert own == near[cell]
        assert columns["observations"][k] == counts[cell]


def test_the_order_of_scans_and_spills_to_disk_change_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sorted_runs, "_SAMPLE", 64)
    scans = drive()
    one = merged(scans)
    many = merged(scans, most=7000, spool=tmp_path)
    assert list(tmp_path.iterdir()), "nothing was spilled"
    assert bytes_of(one) == bytes_of(many) == bytes_of(merged([scans[0], *scans[:0:-1]]))


def test_points_and_intensities_are_those_of_a_map_without_attributes() -> None:
    scans, plain = drive(), MapMerger(VOXEL, 0.0, 50.0)
    for scan, T in scans:
        plain.add(scan.points, T, scan.intensity)
    without, with_them = in_memory(plain.result()), in_memory(merged(scans))
    assert without.columns == {}
    assert without.points.tobytes() == with_them.points.tobytes()
    assert without.intensity is not None
    assert with_them.intensity is not None
    assert without.intensity.tobytes() == with_them.intensity.tobytes()


def test_numbers_of_scans_are_as_wide_as_the_largest() -> None:
    assert merged(drive(2)).column_types["scan"] == np.uint16
    whole = in_memory(merged(drive(2, first=70_000)))
    assert whole.columns["scan"].dtype == np.uint32
    assert set(whole.columns["scan"].tolist()) == {70_000, 70_001}


def test_what_a_scan_does_not_have_is_marked() -> None:
    points = np.array([[3.0, 0, 0]], np.float32)
    one = Observations.of(Scan(points, 5_000, 0))
    assert (one.times_ns[0], one.ranges[0], one.rings[0], one.labels[0]) == (5_000, 3.0, NO_RING, 0)


def test_every_point_is_kept_in_the_order_of_the_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(every_point, "BLOCK", 1000)
    scans = drive()
    cloud = collected(scans, spool=tmp_path)
    assert sum(len(block) for block in cloud.blocks()) == len(cloud)
    whole, start = in_memory(cloud), 0
    assert whole.intensity is not None
    for scan, T in scans:
        assert scan.times is not None
        assert scan.intensity is not None
        ranges = np.linalg.norm(scan.points.astype(np.float64), axis=1).astype(np.float32)
        kept = (ranges >= 2) & (ranges <= 14)
        own = slice(start, start := start + int(kept.sum()))
        world = scan.points[kept].astype(np.float64) @ T[:3, :3].T + T[:3, 3]
        np.testing.assert_allclose(whole.points[own], world, atol=1e-9, rtol=0)
        np.testing.assert_array_equal(whole.intensity[own], scan.intensity[kept])
        np.testing.assert_array_equal(whole.columns["range"][own], ranges[kept])
        times_ns = scan.stamp_ns + np.rint(1e9 * scan.times[kept].astype(float)).astype(int)
        np.testing.assert_array_equal(whole.columns["time_ns"][own], times_ns)
        np.testing.assert_array_equal(whole.columns["ring"][own], scan.rings[kept] if scan.rings is not None else 0)
        assert (whole.columns["scan"][own] == scan.index).all()
    assert start == len(cloud)
    assert (whole.columns["observations"] == 1).all()
    del cloud
    gc.collect()
    assert not list(tmp_path.iterdir()), "the temporary folder outlived the map"


def test_points_without_a_place_and_beyond_the_crop_are_left_out() -> None:
    collector = PointCollector(0.0, 100.0, crop=[-10, 10, -10, 10, -np.inf, np.inf])
    points = np.array([[1, 2, 3], [np.nan, 0, 0], [0, 0, 0], [11, 0, 0], [9, 0, 50]], np.float32)
    collector.add(points, np.eye(4))
    cloud = collector.result()
    assert not cloud.has_intensity
    assert in_memory(cloud).points.tolist() == [[1, 2, 3], [9, 0, 50]]
    assert collector.gated == 3


def test_a_collector_goes_on_where_its_state_was_and_forgets_what_came_after(tmp_path: Path) -> None:
    scans = drive()
    before = PointCollector(2.0, 14.0, attributes=NAMES, keep=tmp_path)
    add(before, scans[:5])
    state = before.state()
    add(before, scans[5:7])  # lost with the process
    again = PointCollector(2.0, 14.0, attributes=NAMES, keep=tmp_path)
    again.restore(state)
    add(again, scans[5:])
    assert bytes_of(again.result()) == bytes_of(collected(scans))
    (tmp_path / "points").write_bytes(b"")
    with pytest.raises(InputError, match="does not hold"):
        PointCollector(2.0, 14.0, attributes=NAMES, keep=tmp_path).restore(state)


def test_a_merger_goes_on_where_its_state_was(tmp_path: Path) -> None:
    scans = drive()
    before = MapMerger(VOXEL, 0.0, 50.0, attributes=NAMES, keep=tmp_path)
    add(before, scans[:5])
    state = before.state()
    again = MapMerger(VOXEL, 0.0, 50.0, attributes=NAMES, keep=tmp_path)
    again.restore(state)
    add(again, scans[5:])
    assert bytes_of(again.result()) == bytes_of(merged(scans))


def test_blocks_of_every_point_have_what_was_asked(tmp_path: Path) -> None:
    collector = PointCollector(0.0, 100.0, attributes=("ring",), spool=tmp_path)
    add(collector, drive(1))
    block: CloudBlock = next(iter(collector.result().blocks()))
    assert list(block.columns) == ["ring"]


def test_memory_does_not_grow_with_every_point(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    collector = PointCollector(0.0, 100.0, attributes=NAMES, spool=tmp_path)
    highest = []
    for k in range(60):
        points = rng.uniform(-30, 30, (60_000, 3)).astype(np.float32)
        collector.add(points, np.eye(4), None, Observations.of(Scan(points, k, k)))
        highest.append(resident_mb())
    cloud = collector.result()
    assert len(cloud) == 3_600_000
    for _ in cloud.blocks():
        highest.append(resident_mb())
    # Together they are 187 MB, a block of them in columns some 40.
    assert max(highest[5:60]) - highest[5] < 20
    assert max(highest[60:]) - highest[5] < 90
