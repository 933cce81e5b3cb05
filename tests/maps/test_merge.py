"""The merged map."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.errors import ConfigError, InputError
from lslam.core.geometry import se3, so3
from lslam.maps.merge import MapMerger, MergedMap, warm_up

Scans = list[tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float32]]]


def make_scans(count: int = 6, points: int = 3000, offset: float = 0.0) -> Scans:
    rng = np.random.default_rng(11)
    scans = []
    for i in range(count):
        cloud = rng.normal(0, 10, (points, 3)).astype(np.float32)
        T = se3.make(so3.exp(np.array([0.0, 0.0, 0.3 * i])), np.array([offset + 1.5 * i, -offset, 0.2 * i]))
        scans.append((cloud, T, rng.uniform(0, 255, points).astype(np.float32)))
    return scans


def merge(scans: Scans, voxel: float = 0.5, near: float = 2.0, far: float = 30.0) -> MergedMap:
    merger = MapMerger(voxel, near, far)
    for cloud, T, intensity in scans:
        merger.add(cloud, T, intensity)
    return merger.result()


def reference(scans: Scans, voxel: float, near: float, far: float) -> tuple[NDArray[Any], ...]:
    world, values = [], []
    for cloud, T, intensity in scans:
        keep = (np.linalg.norm(cloud, axis=1) >= near) & (np.linalg.norm(cloud, axis=1) <= far)
        world.append(se3.apply(T, cloud[keep]))
        values.append(intensity[keep].astype(np.float64))
    xyz, value = np.concatenate(world), np.concatenate(values)
    _, inverse, counts = np.unique(np.floor(xyz / voxel), axis=0, return_inverse=True, return_counts=True)
    columns = [np.bincount(inverse.reshape(-1), v) / counts for v in (*xyz.T, value)]
    return np.stack(columns[:3], axis=1), columns[3], counts


def test_result_equals_numpy() -> None:
    scans = make_scans()
    result = merge(scans)
    points, intensity, counts = reference(scans, 0.5, 2.0, 30.0)
    assert np.array_equal(result.counts, counts)
    np.testing.assert_allclose(result.points, points, atol=1e-6)
    assert result.intensity is not None
    np.testing.assert_allclose(result.intensity, intensity, rtol=1e-6, atol=1e-6)


def test_order_of_points_and_scans_does_not_matter() -> None:
    scans = make_scans()
    rng = np.random.default_rng(0)
    # The first scan fixes the range of voxels, not their grid.
    shuffled = [(c[o], T, i[o]) for c, T, i in scans[::-1] for o in [rng.permutation(len(c))]]
    a, b = merge(scans), merge(shuffled)
    assert a.points.tobytes() == b.points.tobytes()
    assert a.counts.tobytes() == b.counts.tobytes()


def test_growth_keeps_everything() -> None:
    """More voxels than the merger starts with: rows, slots and intensities all move several times."""
    rng = np.random.default_rng(5)
    scans = [
        (rng.uniform(-70, 70, (60_000, 3)).astype(np.float32), np.eye(4), rng.random(60_000, np.float32))
        for _ in range(6)
    ]
    result = merge(scans, voxel=0.2, far=200.0)
    points, intensity, counts = reference(scans, 0.2, 2.0, 200.0)
    assert len(result) > 300_000
    assert np.array_equal(result.counts, counts)
    np.testing.assert_allclose(result.points, points, atol=1e-6)
    assert result.intensity is not None
    np.testing.assert_allclose(result.intensity, intensity, atol=1e-5)


def test_large_coordinates_lose_nothing() -> None:
    """UTM-sized positions: the shape of the map is that of the map at the origin, to a micrometre."""
    voxel = 0.5
    near = merge(make_scans(offset=0.0), voxel)
    far = merge(make_scans(offset=5_400_000.0), voxel)
    assert np.array_equal(near.counts, far.counts)
    np.testing.assert_allclose(far.points - [5_400_000.0, -5_400_000.0, 0.0], near.points, atol=2e-6)


def test_points_outside_the_voxel_range_are_counted(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logging.getLogger("lslam"), "propagate", True)
    merger = MapMerger(0.2)
    cloud = np.array([[5, 5, 5]], np.float32)
    merger.add(cloud, np.eye(4))
    merger.add(cloud, se3.make(np.eye(3), np.array([300_000.0, 0, 0])))
    with caplog.at_level(logging.WARNING, "lslam"):
        assert len(merger.result()) == 1
    assert merger.outside == 1
    assert "1 points lie more than 210 km" in caplog.text


def test_no_measurement_is_no_point() -> None:
    merger = MapMerger(0.2, 0.0, np.inf)
    merger.add(np.array([[0, 0, 0], [np.nan, 0, 0], [np.inf, 1, 1], [1, 1, 1]], np.float32), np.eye(4))
    assert merger.gated == 3
    np.testing.assert_allclose(merger.result().points, [[1, 1, 1]])


def test_empty_map_and_empty_scan() -> None:
    merger = MapMerger()
    assert merger.result().points.shape == (0, 3)
    merger.add(np.zeros((0, 3), np.float32), np.eye(4))
    assert (merger.scans, len(merger.result()), merger.result().intensity) == (1, 0, None)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e300])
def test_a_pose_that_is_no_pose_is_refused(bad: float) -> None:
    merger = MapMerger()
    T = np.eye(4)
    T[0, 3] = bad
    merger.add(np.array([[5, 5, 5]], np.float32), T)
    assert (merger.refused, merger.scans, len(merger.result())) == (1, 0, 0)


def test_intensity_missing_once_is_missing_in_the_map() -> None:
    cloud, T, intensity = make_scans(1)[0]
    merger = MapMerger()
    merger.add(cloud, T, intensity)
    merger.add(cloud, T, None)
    result = merger.result()
    assert result.intensity is None
    assert result.counts.sum() == 2 * (len(cloud) - merger.gated // 2)
    # And the other way round: intensities that come later are not started in the middle.
    merger = MapMerger()
    merger.add(cloud, T, None)
    merger.add(cloud, T, intensity)
    assert merger.result().intensity is None


def test_intensity_that_is_not_finite_counts_as_zero() -> None:
    merger = MapMerger(1.0, 0.0)
    merger.add(np.full((2, 3), 0.5, np.float32), np.eye(4), np.array([np.nan, 8.0], np.float32))
    intensity = merger.result().intensity
    assert intensity is not None
    assert intensity.tolist() == [4.0]


def test_wrong_arguments_say_what_is_wrong() -> None:
    with pytest.raises(ConfigError, match=r"map\.voxel = 0"):
        MapMerger(voxel=0)
    with pytest.raises(ConfigError, match="no point lies between"):
        MapMerger(range_min=5, range_max=5)
    with pytest.raises(InputError, match="2 points but 3 intensities"):
        MapMerger().add(np.ones((2, 3), np.float32), np.eye(4), np.ones(3, np.float32))


def test_other_layouts_and_types_are_accepted() -> None:
    cloud, T, _ = make_scans(1)[0]
    plain, odd = MapMerger(), MapMerger()
    plain.add(cloud, T)
    odd.add(np.asfortranarray(cloud.astype(np.float64)), np.asfortranarray(T))
    assert plain.result().points.tobytes() == odd.result().points.tobytes()


def test_warm_up_compiles_all_that_a_run_needs() -> None:
    from lslam.maps.kernels.cells import add_rows, enter, sum_up

    warm_up()
    scans = make_scans(2, 200_000)
    kernels = sum_up, add_rows, enter
    assert [len(kernel.signatures) for kernel in kernels] == [1, 1, 1]  # type: ignore[attr-defined]
    merge(scans, voxel=0.1)
    assert [len(kernel.signatures) for kernel in kernels] == [1, 1, 1]  # type: ignore[attr-defined]
