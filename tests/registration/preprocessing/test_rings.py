"""Rings that are taken away and found again; clouds that have none are refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from lslam.core.config import load_config
from lslam.core.errors import ConfigError, InputError, UsageError
from lslam.core.types.scan import Scan
from lslam.io.readers import open_sequence
from lslam.registration.preprocessing.rings import (
    RingRule,
    decide_rings,
    elevation_borders,
    elevations,
    organised_rows,
    ring_gap,
    rings_by_order,
)
from lslam.simulation.scenarios import simulate


@cache
def scans(scenario: str, lidar: str) -> list[Scan]:
    drive = simulate(scenario, seed=1, count=6, lidar=lidar)
    return [drive.scan(i) for i in (0, 2, 5)]


def bare(scan: Scan) -> Scan:
    return replace(scan, rings=None)


def agreement(found: NDArray[Any], truth: NDArray[Any]) -> float:
    """Share of points in the ring they belong to, under the best relabelling one to one."""
    table = np.zeros((int(found.max()) + 1, int(truth.max()) + 1), int)
    np.add.at(table, (found, truth), 1)
    rows, columns = linear_sum_assignment(-table)
    return float(table[rows, columns].sum() / len(truth))


CASES = [
    ("street", "hdl64", "order", 64),
    ("street", "hdl64-kitti", "order", 64),
    ("block", "sample", "order", 16),
    ("street", "os1-32", "elevation", 32),
    ("walk", "os1-64", "elevation", 64),
    ("street", "vlp16", "elevation", 16),
]


@pytest.mark.parametrize(("scenario", "lidar", "kind", "count"), CASES)
def test_rings_are_found_again(scenario: str, lidar: str, kind: str, count: int) -> None:
    known = scans(scenario, lidar)
    rule = decide_rings([bare(s) for s in known])
    assert (rule.kind, rule.count) == (kind, count)
    for scan in known:
        assert scan.rings is not None
        found = rule.rings_of(bare(scan))
        assert found.dtype == np.uint16
        assert agreement(found, scan.rings) >= 0.995
        # From the top: where labels are all there, they are the simulated ones.
        assert np.mean(found == scan.rings) > 0.995 or found.max() < count - 1


@pytest.mark.parametrize("rows", [16, 48, 64])
def test_a_scan_whose_points_could_be_rows_does_not_make_the_recording_organised(rows: int) -> None:
    """Ring after ring, cut into as many equal parts: each has an elevation of its own, more or less."""
    first, *others = map(bare, scans("street", "hdl64"))
    cut = first.select(np.arange(len(first) // rows * rows))
    assert organised_rows(cut, rows) is not None
    rule = decide_rings([cut, *others])
    assert (rule.kind, rule.count) == ("order", 64)


@pytest.mark.parametrize(("scenario", "lidar"), [("street", "hdl64"), ("street", "vlp16"), ("walk", "os1-64")])
def test_a_shuffled_spinning_scan_still_has_its_beams(scenario: str, lidar: str) -> None:
    scan = scans(scenario, lidar)[1]
    assert scan.rings is not None
    mixed = np.random.default_rng(0).permutation(len(scan))
    rule = decide_rings([bare(scan).select(mixed)])
    assert rule.kind == "elevation"
    assert agreement(rule.rings_of(scan.select(mixed)), scan.rings[mixed]) >= 0.995


def test_a_file_in_ring_order_may_turn_either_way_start_anywhere_and_hold_empty_points() -> None:
    scan = scans("street", "hdl64")[0]
    assert scan.rings is not None
    for mirrored, turn in ((False, 1.0), (True, 0.0), (True, -2.5)):
        c, s = np.cos(turn), np.sin(turn)
        points = scan.points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]], np.float32)
        if mirrored:
            points = points * np.array([1, -1, 1], np.float32)
        points[::50] = 0
        points[25::50] = np.nan
        good = np.isfinite(points).all(1) & (points != 0).any(1)
        found = rings_by_order(points)
        assert found is not None
        assert agreement(found[good], scan.rings[good]) >= 0.995


def test_the_seam_is_found_where_all_rings_begin_though_the_first_one_begins_late() -> None:
    scan = scans("street", "hdl64")[0]
    assert scan.rings is not None
    azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0]) % (2 * np.pi)
    late = scan.select(~((scan.rings < 2) & (azimuth < 2.0)))
    assert late.rings is not None
    found = rings_by_order(late.points)
    assert found is not None
    assert agreement(found, late.rings) >= 0.995


def test_organised_clouds_keep_their_rows_whichever_way_they_are_stored() -> None:
    rng = np.random.default_rng(3)
    rows, cols = 32, 600
    azimuth, elevation = 2 * np.pi * np.arange(cols) / cols, np.radians(np.linspace(12, -25, rows))
    e, a = np.broadcast_arrays(elevation[:, None], azimuth)
    grid = rng.uniform(3, 40, (rows, cols, 1)) * np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1)
    grid[rng.random((rows, cols)) < 0.3] = 0
    ring = np.broadcast_to(np.arange(rows)[:, None], (rows, cols))
    for axes, columns in (((0, 1), False), ((1, 0), True)):
        cloud = grid.transpose(*axes, 2).reshape(-1, 3).astype(np.float32)
        rule = decide_rings([Scan(cloud, 0, 0)])
        assert rule == RingRule("rows", rows, columns)
        np.testing.assert_array_equal(rule.rings_of(Scan(cloud, 0, 0)), ring.transpose(axes).ravel())
        with pytest.raises(InputError, match="not 32 rows"):
            rule.rings_of(Scan(cloud[:-1], 0, 7))


def test_beams_may_be_uneven_and_hold_few_points_or_strays() -> None:
    rng = np.random.default_rng(0)
    beams = np.radians([-25.0, -15.6, -8.8, -5.0, -3.0, -2.0, -1.33, -1.0, -0.67, -0.33, 0.0, 1.33, 4.7, 15.0])
    counts = np.array([1500, 1800, 1800, 1800, 1800, 900, 1700, 1800, 1800, 1800, 1800, 1200, 600, 200])
    cloud = np.repeat(beams, counts) + np.radians(rng.normal(0, 0.02, counts.sum()))
    borders = elevation_borders(np.concatenate([cloud, np.radians([8.0, 9.0, -20.0])]))
    assert borders is not None
    np.testing.assert_array_equal(np.searchsorted(borders, beams), np.arange(len(beams)))
    assert elevation_borders(rng.uniform(-0.4, 0.3, 50_000)) is None


def test_the_angle_between_rings_is_read_from_the_points() -> None:
    azimuth, beams = np.linspace(0, 2 * np.pi, 300), np.radians(np.linspace(-15, 15, 16))
    a, e = (x.ravel() for x in np.meshgrid(azimuth, beams))
    way = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1)
    points = (np.random.default_rng(0).uniform(5, 80, (len(way), 1)) * way).astype(np.float32)
    assert ring_gap(points) == pytest.approx(np.radians(2.0), rel=0.02)
    assert ring_gap(np.random.default_rng(0).normal(0, 10, (20_000, 3)).astype(np.float32)) == 0.0
    assert ring_gap(np.zeros((0, 3), np.float32)) == 0.0


@pytest.mark.parametrize("wanted", ["auto", "field", "order", "rows", "rows:64", "elevation"])
def test_clouds_without_rings_are_refused_with_the_way_out(wanted: str) -> None:
    livox = bare(scans("street", "livox")[0])
    blob = Scan(np.random.default_rng(0).normal(0, 10, (20_000, 3)).astype(np.float32), 0, 0)
    for scan in (livox, blob):
        with pytest.raises(
            InputError, match=f"--rings {wanted.split(':')[0]}: the scans .* --method loam-livox or icp"
        ):
            decide_rings([scan], wanted)


def test_a_ring_field_is_taken_unless_it_says_nothing() -> None:
    scan = scans("street", "vlp16")[0]
    assert decide_rings([scan]).kind == "field"
    assert decide_rings([scan], "elevation:16").kind == "elevation"
    constant = replace(scan, rings=np.zeros(len(scan), np.uint16))
    assert decide_rings([constant]).kind == "elevation"
    with pytest.raises(InputError, match="no ring field"):
        RingRule("field", 16).rings_of(bare(scan))


def test_what_rings_may_be_is_checked_at_the_door() -> None:
    with pytest.raises(ConfigError, match=r"input.rings = 'colums'.*elevation\[:N\]"):
        load_config(None, ["input.rings=colums"], {})
    with pytest.raises(UsageError, match="--rings rows:0"):
        decide_rings(scans("block", "sample"), "rows:0")


def spreads(points: NDArray[Any], rings: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Elevation of each ring far away and how far half of its points lie from it, deg, of points beyond 8 m.

    Lasers start up to 0.2 m above or below the origin, which adds a share of the inverse range to their elevations.
    """
    ranges = np.linalg.norm(points, axis=1)
    e = np.degrees(elevations(points).astype(np.float64))
    beams, spread = [], []
    for k in np.unique(rings):
        mine = (rings == k) & (ranges > 8)
        if mine.sum() > 30:
            A = np.column_stack([np.ones(mine.sum()), 1 / ranges[mine]])
            x = np.linalg.lstsq(A, e[mine], rcond=None)[0]
            beams.append(np.median(e[mine]))
            spread.append(np.median(np.abs(A @ x - e[mine])))
    return np.array(beams), np.array(spread)


@pytest.mark.parametrize(
    ("name", "folder", "kind"),
    [
        ("kitti_raw_0005", "2011_09_26/2011_09_26_drive_0005_sync", "order"),
        ("mcd_kth_day_06", "mcd_kth_day_06", "rows"),
    ],
)
def test_recordings_have_sixty_four_rings_one_below_the_other(
    recordings: Callable[[str], Path], name: str, folder: str, kind: str
) -> None:
    sequence = open_sequence(recordings(name) / folder)
    some = [sequence.scan(i) for i in (0, len(sequence) // 2, len(sequence) - 1)]
    rule = decide_rings(some)
    assert (rule.kind, rule.count) == (kind, 64)
    for scan in some:
        middles, spread = spreads(scan.points, rule.rings_of(scan))
        assert len(middles) >= 40
        assert (np.diff(middles) < 0).all()
        assert np.median(spread) < 0.3 * np.median(-np.diff(middles))
