"""Is a simulated scan like a recorded one? The urban loop beside KITTI's drives 0005 and 0048 in a city, same sensor.

What a scan sees is chance: the mean over two towns of `urban` (two seeds) stands beside the mean of a drive. KITTI's scans
carry no ring, but keep their order: one ring after the other, from the top, each once round. Where the azimuth starts anew a
ring ends, so all 64 are told apart exactly, however uneven their elevations, and compared one by one.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.types.scan import Scan
from lslam.io.readers import open_sequence
from lslam.simulation.lidar_models import LIDARS
from lslam.simulation.scenarios import simulate

Floats = NDArray[np.float64]
Scans = list[Scan]

SHARES_TOWNS = True
ALIKE = 0.25  # the most that a mean may differ
ROUGHLY = 0.4  # from the drive that nothing was made to resemble
RANGES = [0, 5, 7.5, 10, 15, 20, 30, 80]  # m


@pytest.fixture(scope="module")
def recorded(recordings: Callable[[str], Path]) -> Scans:
    sequence = open_sequence(recordings("kitti_raw_0005") / "2011_09_26" / "2011_09_26_drive_0005_sync")
    return [sequence.scan(i) for i in range(0, len(sequence), 10)]


@pytest.fixture(scope="module")
def other(recordings: Callable[[str], Path]) -> Scans:
    sequence = open_sequence(recordings("kitti_raw_0048") / "2011_09_26" / "2011_09_26_drive_0048_sync")
    return [sequence.scan(i) for i in range(0, len(sequence), 3)]


@pytest.fixture(scope="module")
def simulated() -> Scans:
    drives = [simulate("urban", seed=seed) for seed in (0, 1)]
    return [drive.scan(int(i)) for drive in drives for i in np.linspace(0, len(drive) - 1, 9)]


def in_order(points: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    """The rings of a recorded scan, from the top, by its order: each starts where the azimuth starts anew."""
    azimuth = np.arctan2(points[:, 1], points[:, 0]) % np.float32(2 * np.pi)
    rings = np.split(points, np.flatnonzero(np.diff(azimuth) < -np.pi) + 1)
    # A recording ends with a point at the origin of the azimuth that belongs to no ring.
    return [ring for ring in rings if len(ring) > 1]


def per_ring(scan: Scan) -> Floats:
    """Returns of each of the 64 rings."""
    if scan.rings is not None:
        return np.bincount(scan.rings, minlength=64).astype(float)
    return np.array([len(ring) for ring in in_order(scan.points)], float)


def per_range(scan: Scan) -> Floats:
    """Returns in each bin of `RANGES`."""
    return np.histogram(np.linalg.norm(scan.points, axis=1), RANGES)[0].astype(float)


def compare(measure: Callable[[Scan], Floats], real: Scans, ours: Scans) -> Floats:
    """Ratio of the means of a measure, simulated over recorded."""
    a, b = (np.mean([measure(scan) for scan in scans], axis=0) for scans in (real, ours))
    return np.asarray(b / a)


def shares(scan: Scan) -> Floats:
    """Shares of ground, of what stands tall (walls, trunks) and of clutter within 50 m, by geometry alone.

    Ground is what lies less than 0.25 m above the lowest points of its polar cell of 5 m x 10 deg; tall is a column of 0.5 m
    with more than 1.6 m from its lowest point to its highest.
    """
    p = scan.points[np.hypot(scan.points[:, 0], scan.points[:, 1]) < 50].astype(np.float64)
    bearing = np.floor((np.degrees(np.arctan2(p[:, 1], p[:, 0])) + 180) / 10)
    cell = (bearing * 10 + np.floor(np.hypot(p[:, 0], p[:, 1]) / 5)).astype(int)
    low = np.full(cell.max() + 1, -1.73)
    order = np.argsort(cell, kind="stable")
    cells, first = np.unique(cell[order], return_index=True)
    for k, heights in zip(cells, np.split(p[order, 2], first[1:]), strict=True):
        z = float(np.quantile(heights, 0.05))
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


def ground_brightness(scan: Scan) -> Floats:
    """Mean intensity of what lies on the ground, at 4 to 7 and 7 to 12 m."""
    assert scan.intensity is not None
    away, ground = np.hypot(scan.points[:, 0], scan.points[:, 1]), np.abs(scan.points[:, 2] + 1.73) < 0.15
    return np.array([scan.intensity[ground & (away > a) & (away < b)].mean() for a, b in ((4, 7), (7, 12))], float)


def test_rings_of_a_recording_are_told_apart_by_its_order(recorded: Scans, other: Scans) -> None:
    """64 of them in every scan; nearly all points lie on their ring as seen from the height of its laser."""
    model = LIDARS["hdl64-kitti"]
    for scan in (recorded[3], other[3]):
        rings = in_order(scan.points)
        assert len(rings) == 64
        for ring, elevation, height in zip(rings, model.elevations_deg, model.ring_heights, strict=True):
            seen = np.degrees(np.arctan2(ring[:, 2] - height, np.hypot(ring[:, 0], ring[:, 1])))
            assert abs(float(np.median(seen)) - elevation) < 0.1
            assert np.mean(np.abs(seen - elevation) < 0.15) > 0.9


def test_returns_per_scan(recorded: Scans, other: Scans, simulated: Scans) -> None:
    def count(scan: Scan) -> Floats:
        return np.array([len(scan)], float)

    for real in (recorded, other):
        np.testing.assert_allclose(compare(count, real, simulated), 1, atol=ALIKE)


def test_returns_of_every_single_ring(recorded: Scans, other: Scans, simulated: Scans) -> None:
    np.testing.assert_allclose(compare(per_ring, recorded, simulated), 1, atol=ALIKE)
    np.testing.assert_allclose(compare(per_ring, other, simulated), 1, atol=ROUGHLY)


def test_histogram_of_ranges(recorded: Scans, other: Scans, simulated: Scans) -> None:
    np.testing.assert_allclose(compare(per_range, recorded, simulated), 1, atol=ALIKE)
    # Drive 0048 is a narrower street, in which nothing is far away.
    np.testing.assert_allclose(compare(per_range, other, simulated)[:5], 1, atol=ROUGHLY)


def test_shares_of_ground_walls_and_clutter(recorded: Scans, other: Scans, simulated: Scans) -> None:
    np.testing.assert_allclose(compare(shares, recorded, simulated), 1, atol=ALIKE)
    np.testing.assert_allclose(compare(shares, other, simulated), 1, atol=ROUGHLY)


def test_roads_are_as_bright_as_recorded_ones(recorded: Scans, other: Scans, simulated: Scans) -> None:
    """Grazing rays included: a road that followed the cosine of incidence would have a third of it."""
    for real in (recorded, other):
        np.testing.assert_allclose(compare(ground_brightness, real, simulated), 1, atol=ROUGHLY)


def test_another_kind_of_place_is_not_alike(recorded: Scans) -> None:
    """The measures tell a corridor from a city: they can fail."""
    drive = simulate("corridor", lidar="hdl64-kitti", count=60)
    ours = [drive.scan(i) for i in (0, 30, 59)]
    assert np.abs(compare(shares, recorded, ours) - 1).max() > 2 * ALIKE
    assert np.abs(compare(per_ring, recorded, ours) - 1).max() > 2 * ALIKE
