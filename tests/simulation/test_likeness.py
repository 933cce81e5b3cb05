"""Is a simulated scan like a recorded one? The urban loop beside KITTI's drive 0005 in a city, same sensor."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.readers import open_sequence
from lslam.simulation.scenarios import simulate

Floats = NDArray[np.float64]
Scans = list[NDArray[np.float32]]

ALIKE = 0.25  # the most that a mean may differ
ELEVATIONS = [-26, -20, -16, -12, -9, -6, -4, -2, 0, 3]  # deg: bands of four to nine rings
RANGES = [0, 5, 7.5, 10, 15, 20, 30, 80]  # m


@pytest.fixture(scope="module")
def recorded(recordings: Callable[[str], Path]) -> Scans:
    sequence = open_sequence(recordings("kitti_raw_0005") / "2011_09_26" / "2011_09_26_drive_0005_sync")
    return [sequence.scan(i).points for i in range(0, len(sequence), 10)]


@pytest.fixture(scope="module")
def simulated() -> Scans:
    drive = simulate("urban")
    return [drive.scan(int(i)).points for i in np.linspace(0, len(drive) - 1, 16)]


def compare(measure: Callable[[NDArray[np.float32]], Floats], real: Scans, ours: Scans) -> Floats:
    """Ratio of the means of a measure, simulated over recorded."""
    a, b = (np.mean([measure(p) for p in scans], axis=0) for scans in (real, ours))
    return np.asarray(b / a)


def shares(points: NDArray[np.float32]) -> Floats:
    """Shares of ground, of what stands tall (walls, trunks) and of clutter within 50 m, by geometry alone.

    Ground is what lies less than 0.25 m above the lowest points of its polar cell of 5 m x 10 deg; tall is a column of 0.5 m
    with more than 1.6 m from its lowest point to its highest.
    """
    p = points[np.hypot(points[:, 0], points[:, 1]) < 50].astype(np.float64)
    bearing = np.floor((np.degrees(np.arctan2(p[:, 1], p[:, 0])) + 180) / 10)
    cell = (bearing * 10 + np.floor(np.hypot(p[:, 0], p[:, 1]) / 5)).astype(int)
    low = np.full(cell.max() + 1, -1.73)
    for k in np.unique(cell):
        z = float(np.quantile(p[cell == k, 2], 0.05))
        if abs(z + 1.73) < 0.8:
            low[k] = z
    above = p[:, 2] - low[cell] >= 0.25
    column = (np.floor(p[above, 0] / 0.5) * 4096 + np.floor(p[above, 1] / 0.5)).astype(int)
    _, inverse = np.unique(column, return_inverse=True)
    top, bottom = np.full(inverse.max() + 1, -np.inf), np.full(inverse.max() + 1, np.inf)
    np.maximum.at(top, inverse, p[above, 2])
    np.minimum.at(bottom, inverse, p[above, 2])
    tall = (top - bottom)[inverse] > 1.6
    return np.array([np.sum(~above), np.sum(tall), np.sum(~tall)]) / len(p)


def test_returns_per_scan(recorded: Scans, simulated: Scans) -> None:
    ratio = compare(lambda p: np.array([len(p)], float), recorded, simulated)
    np.testing.assert_allclose(ratio, 1, atol=ALIKE)


def test_returns_per_ring(recorded: Scans, simulated: Scans) -> None:
    def bands(p: NDArray[np.float32]) -> Floats:
        elevation = np.degrees(np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1])))
        return np.histogram(elevation, ELEVATIONS)[0].astype(float)

    np.testing.assert_allclose(compare(bands, recorded, simulated), 1, atol=ALIKE)


def test_histogram_of_ranges(recorded: Scans, simulated: Scans) -> None:
    ratio = compare(lambda p: np.histogram(np.linalg.norm(p, axis=1), RANGES)[0].astype(float), recorded, simulated)
    np.testing.assert_allclose(ratio, 1, atol=ALIKE)


def test_shares_of_ground_walls_and_clutter(recorded: Scans, simulated: Scans) -> None:
    np.testing.assert_allclose(compare(shares, recorded, simulated), 1, atol=ALIKE)


def test_another_kind_of_place_is_not_alike(recorded: Scans) -> None:
    """The measures tell a corridor from a city: they can fail."""
    drive = simulate("corridor", lidar="hdl64-kitti", count=60)
    ours = [drive.scan(i).points for i in (0, 30, 59)]
    assert np.abs(compare(shares, recorded, ours) - 1).max() > 2 * ALIKE
