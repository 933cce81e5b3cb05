"""Points in the air against points on surfaces: an independent reference, a scanned street in snow, thinned scans."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam import Registration
from lslam.core.config.input import PreprocessConfig
from lslam.core.geometry import se3
from lslam.core.kernels import voxel
from lslam.registration.preprocessing.prepare import (
    FIELD_OF_VIEW_SR,
    MOST_REMOVED_SHARE,
    NO_TIMES,
    SPARSE_CELLS_SHARE,
    WIDE_CELL_M,
    on_surfaces,
    prepare_points,
)
from lslam.simulation.scenarios import simulate

Points = NDArray[np.float32]

LEAF = PreprocessConfig().map_leaf
LINE = PreprocessConfig().least_line


def scanned_street(beams: int, columns: int, up_deg: float, down_deg: float) -> Points:
    """What a spinning scanner 1.7 m above the ground sees between fronts 8 and 11 m beside it, 10 m high."""
    up, around = np.meshgrid(np.deg2rad(np.linspace(down_deg, up_deg, beams)), np.linspace(-np.pi, np.pi, columns))
    d = np.column_stack(
        [(np.cos(up) * np.cos(around)).ravel(), (np.cos(up) * np.sin(around)).ravel(), np.sin(up).ravel()]
    )
    with np.errstate(divide="ignore"):
        ground = np.where(d[:, 2] < 0, -1.7 / d[:, 2], np.inf)
        front = np.where(d[:, 1] > 0, 8.0, -11.0) / d[:, 1]
    ranges = np.minimum(ground, np.where(front * d[:, 2] < 8.3, front, np.inf))
    seen = ranges < 80.0
    noise = np.random.default_rng(0).normal(0, 0.02, seen.sum())
    return np.asarray(d[seen] * (ranges[seen] + noise)[:, None], np.float32)


def snow(count: int, seed: int) -> Points:
    """Drops spread evenly in the volume up to 20 m away, as far as they are seen."""
    rng = np.random.default_rng(seed)
    return rng.uniform((-20, -20, -1.5), (20, 20, 8), (count, 3)).astype(np.float32)


def kept_of(points: Points, least_line: float = LINE) -> tuple[Points, Points]:
    """The centroids of a cloud, and those among them that surfaces may have made."""
    made, _, _, counts = voxel.centroids(points, NO_TIMES, LEAF)
    return made, made[on_surfaces(made, counts, LEAF, least_line)]


@pytest.mark.parametrize("seed", range(3))
def test_cells_are_judged_as_numpy_judges_them(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = (rng.normal(0, 12, (4000, 3)) * (1, 1, 0.1)).astype(np.float32)
    made, kept = kept_of(points)
    counts = voxel.centroids(points, NO_TIMES, LEAF)[3]
    ranges = np.linalg.norm(made.astype(np.float64), axis=1)
    line = LINE / np.sqrt(FIELD_OF_VIEW_SR / len(points))
    filled = counts * ranges >= LEAF * line
    _, cell = np.unique(np.floor(made / WIDE_CELL_M), axis=0, return_inverse=True)
    around = np.bincount(cell.ravel(), counts * filled)[cell.ravel()]
    expected = filled & (around * ranges >= WIDE_CELL_M * line)
    np.testing.assert_array_equal(kept, made[expected])
    assert (~filled).sum() > 0
    assert (filled & ~expected).sum() > 0
    assert (~expected).mean() > SPARSE_CELLS_SHARE
    assert counts[expected].sum() > MOST_REMOVED_SHARE * len(points)


@pytest.mark.parametrize("sensor", [(64, 2000, 2.0, -24.8), (64, 1024, 22.5, -22.5), (16, 1800, 15.0, -15.0)])
@pytest.mark.parametrize("share", [0.1, 0.2])
def test_snow_goes_and_the_street_stays(sensor: tuple[int, int, float, float], share: float) -> None:
    street = scanned_street(*sensor)
    drops = snow(int(share * len(street)), seed=1)
    of_street, clear = kept_of(street)
    np.testing.assert_array_equal(of_street, clear)
    _, kept = kept_of(np.concatenate([street, drops]))
    is_street = (kept[:, 2] < -1.3) | (abs(kept[:, 1] - 8) < 0.4) | (abs(kept[:, 1] + 11) < 0.4)
    # Drops within the reach of a surface cannot be told from it, nor do they harm.
    assert (~is_street).sum() < 0.15 * len(drops)
    assert is_street.sum() > 0.75 * len(of_street)


@pytest.mark.parametrize("grid", [0.2, 0.5, 1.0])
def test_scans_that_were_thinned_before_keep_their_points(grid: float) -> None:
    street = scanned_street(64, 2000, 2.0, -24.8)
    made, kept = kept_of(street[voxel.first_points(street, grid)])
    np.testing.assert_array_equal(made, kept)


def test_where_most_would_go_and_with_zero_all_are_kept() -> None:
    drops = snow(30_000, seed=2)
    made, kept = kept_of(drops)
    np.testing.assert_array_equal(made, kept)
    made, kept = kept_of(scanned_street(16, 1800, 15.0, -15.0), least_line=0)
    np.testing.assert_array_equal(made, kept)
    assert len(prepare_points(np.zeros((0, 3)), PreprocessConfig()).map_points) == 0


def test_mean_times_stay_with_their_points() -> None:
    street = np.concatenate([scanned_street(16, 1800, 15.0, -15.0), snow(2000, seed=3)])
    turned = np.arctan2(street[:, 1], street[:, 0]).astype(np.float32)
    out = prepare_points(street, PreprocessConfig(), times=turned)
    assert out.map_times is not None
    assert len(out.map_times) == len(out.map_points)
    near_the_seam = abs(turned).max() - 0.5
    angles = np.arctan2(out.map_points[:, 1], out.map_points[:, 0])
    inside = abs(angles) < near_the_seam
    np.testing.assert_allclose(out.map_times[inside], angles[inside], atol=0.2)


@pytest.mark.parametrize("seed", range(2))
def test_a_street_is_driven_in_snow(seed: int) -> None:
    # Every drop fills a cell of its own, most returns of a surface share one: a fifth of the returns is most of the cells.
    drive = simulate("urban", seed=seed, lidar="vlp16", motion_compensated=True)
    registration = Registration()
    for i in range(4):
        points = drive.scan(i).points
        points = np.concatenate([points, snow(len(points) // 5, 100 * seed + i)])
        truth = se3.relative(drive.ground_truth.poses[0], drive.ground_truth.poses[i])
        result = registration.register(points)
        assert result.ok
        assert np.linalg.norm(result.T_world_lidar[:3, 3] - truth[:3, 3]) < 0.05
