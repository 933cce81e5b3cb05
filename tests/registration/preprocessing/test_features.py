"""LOAM's features: against a plain reference, and on scenes whose edges and planes are known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from numpy_labels import reference_labels
from scipy.spatial import cKDTree

from lslam.core.config.config import load_config
from lslam.core.config.input import PreprocessConfig
from lslam.core.config.odometry import LoamConfig
from lslam.core.errors import ConfigError, InputError
from lslam.core.geometry import so3
from lslam.core.types.scan import Scan
from lslam.registration.preprocessing import features
from lslam.registration.preprocessing.features import extract_features, walk_rings
from lslam.simulation.scenarios import simulate

GATE = PreprocessConfig()


def scan_of(points: NDArray[Any], rings: NDArray[Any], times: NDArray[Any] | None = None) -> Scan:
    return Scan(
        points.astype(np.float32),
        0,
        0,
        None,
        None if times is None else times.astype(np.float32),
        rings.astype(np.uint16),
    )


def bumpy(seed: int) -> Scan:
    """Rings of random ranges with jumps, slopes and missing returns, column after column."""
    rng = np.random.default_rng(seed)
    rows, columns = 6, 900
    azimuth = np.radians(0.4) * np.arange(columns)
    elevation = np.radians(np.linspace(-10, 4, rows))
    r = 8 + 3 * np.cumsum(rng.normal(0, 0.02, (columns, rows)), axis=0)
    r += np.cumsum((rng.random((columns, rows)) < 0.02) * rng.normal(0, 4, (columns, rows)), axis=0)
    r = np.abs(r) + 1.5 + rng.normal(0, 0.01, (columns, rows))
    a, e = np.broadcast_arrays(azimuth[:, None], elevation)
    points = r[..., None] * np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1)
    keep = rng.random((columns, rows)) > 0.03
    keep[200:230, 2] = False
    rings = np.broadcast_to(np.arange(rows), (columns, rows))
    return scan_of(points[keep], rings[keep], np.broadcast_to(azimuth[:, None], r.shape)[keep])


def picks_of_reference(scan: Scan, config: LoamConfig) -> NDArray[np.int64]:
    walk = walk_rings(scan, GATE)
    parts = [walk.points[a:b] for a, b in zip(walk.starts[:-1], walk.starts[1:], strict=True)]
    labels = np.zeros(len(scan), np.int64)
    labels[walk.order] = np.concatenate([np.array(x, np.int64) for x in reference_labels(parts, walk.step, config)])
    return labels


@pytest.mark.parametrize(
    ("config", "numbers"),
    [
        (LoamConfig(), {}),
        (
            LoamConfig(regions=4, max_edge_points=1, max_less_edge_points=3, max_planar_points=9),
            {"OCCLUSION_M": 0.5},
        ),
        (
            LoamConfig(regions=1),
            {"EDGE_CURVATURE": 0.5, "PLANAR_CURVATURE": 0.2, "RARE_SIGMAS": 2.0, "PARALLEL_DEG": 60.0},
        ),
    ],
)
def test_the_kernels_pick_what_the_plain_reference_picks(
    config: LoamConfig, numbers: dict[str, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in numbers.items():
        monkeypatch.setattr(features, name, value)
    for scan in (bumpy(0), bumpy(1), simulate("block", seed=2, count=2).scan(1)):
        expected = picks_of_reference(scan, config)
        got = extract_features(scan, config, GATE).labels
        np.testing.assert_array_equal(got, expected)
        assert {-2, -1, 0, 1, 2} <= set(got.tolist()) or config.max_less_edge_points == 3


def test_scans_without_rings_or_with_lines_that_skip_about_are_refused() -> None:
    scan = simulate("block", seed=0, count=2, lidar="livox").scan(0)
    with pytest.raises(InputError, match="neighbours on a ring"):
        extract_features(scan)
    with pytest.raises(InputError, match="--rings"):
        extract_features(replace(scan, rings=None))


def test_more_sharp_edges_than_edges_are_refused() -> None:
    with pytest.raises(ConfigError, match="max_less_edge_points = 1"):
        load_config(None, ["loam.max_less_edge_points=1"], {})


STEP = np.radians(0.2)
BOX = np.array([[9.0, 0.5], [12.0, -3.0], [15.5, 0.0], [12.5, 3.5]])  # seen from above, its nearest corner first


def yard(noise: float, seed: int = 0) -> tuple[Scan, NDArray[np.int64]]:
    """Twelve rings on a box in front of a wide wall at x = 25 and beside a wall nearly parallel to the beams; and what each
    point is on: 0, 1 the faces of the box, 2 the wide wall, 3 the parallel wall."""
    segments = [(BOX[0], BOX[1]), (BOX[3], BOX[0]), (np.array([25.0, -14.0]), np.array([25.0, 14.0])),
                (np.array([4.0, -3.0]), np.array([9.0, -5.6]))]  # fmt: skip
    azimuth = np.arange(-np.radians(40), np.radians(40), STEP)
    beam = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    flat = np.full(len(azimuth), np.inf)
    on = np.full(len(azimuth), -1)
    for k, (a, b) in enumerate(segments):
        along, out = b - a, np.array([b[1] - a[1], a[0] - b[0]])
        t = (a @ out) / (beam @ out)
        share = ((beam * t[:, None]) - a) @ along / (along @ along)
        nearer = (t > 0) & (share >= 0) & (share <= 1) & (t < flat)
        flat[nearer], on[nearer] = t[nearer], k
    seen = np.isfinite(flat)
    elevation = np.radians(np.linspace(-2.5, 4, 12))
    e, f = np.broadcast_arrays(elevation[:, None], flat[seen])
    r = f / np.cos(e) + np.random.default_rng(seed).normal(0, noise, f.shape)
    a = np.broadcast_to(azimuth[seen], f.shape)
    points = r[..., None] * np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1)
    rings = np.broadcast_to(np.arange(12)[:, None], f.shape)
    return scan_of(points.reshape(-1, 3), rings.ravel()), np.tile(on[seen], 12)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_edges_stand_on_the_corners_of_a_box_and_planes_on_faces_away_from_shadows(noise: float) -> None:
    scan, on = yard(noise)
    found = extract_features(scan, LoamConfig(grid_step=0))
    azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0])
    corners = np.arctan2(BOX[[0, 1, 3], 1], BOX[[0, 1, 3], 0])
    edge = found.labels > 0
    from_corner = np.abs(azimuth[edge, None] - corners).min(axis=1)
    assert (from_corner < 4 * STEP).all()
    # Every ring sees all three; a corner's edge is on the box and not on the wall in its shadow.
    assert (on[edge] < 2).all()
    for corner in corners:
        at = edge & (np.abs(azimuth - corner) < 4 * STEP)
        assert set(scan.rings[at].tolist()) == set(range(12))  # type: ignore[index]
    sharp = found.labels == 2
    for corner in corners:
        assert len(set(scan.rings[sharp & (np.abs(azimuth - corner) < 4 * STEP)].tolist())) >= 10  # type: ignore[index]
    flat = found.labels < 0
    assert not (flat | edge)[on == 3].any()
    assert {0, 1, 2} == set(on[found.labels == -2].tolist())
    assert (np.abs(azimuth[flat, None] - corners).min(axis=1) > 2 * STEP).all()
    np.testing.assert_array_equal(
        np.sort(found.less_planes.points[:, 0]), np.sort(scan.points[flat, 0].astype(np.float64))
    )


def test_missing_returns_make_neither_edges_nor_planes_that_are_not_there() -> None:
    scan, _ = yard(0.0)
    azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0])
    hole = (azimuth > np.radians(-24)) & (azimuth < np.radians(-22))  # a window in the wide wall
    with_hole = scan.select(~hole)
    labels = extract_features(with_hole).labels
    beside = np.abs(azimuth[~hole] - np.radians(-23)) < np.radians(1) + 4 * STEP
    assert beside.sum() > 80
    assert (labels[beside] == 0).all()
    single = scan.select(np.arange(len(scan)) % 9 != 4)
    corners = np.arctan2(BOX[[0, 1, 3], 1], BOX[[0, 1, 3], 0])
    at = np.arctan2(single.points[:, 1], single.points[:, 0])[extract_features(single).labels > 0]
    assert (np.abs(at[:, None] - corners).min(axis=1) < 4 * STEP).all()


def test_less_planar_points_are_thinned_along_each_ring_and_keep_ring_and_time() -> None:
    scan = bumpy(3)
    assert scan.times is not None
    assert scan.rings is not None
    every = extract_features(scan, LoamConfig(grid_step=0)).less_planes
    some = extract_features(scan, LoamConfig(grid_step=0.5)).less_planes
    assert len(every) == (extract_features(scan).labels < 0).sum()
    assert 0.02 * len(every) < len(some) < 0.5 * len(every)
    assert every.times is not None
    assert some.times is not None
    assert (np.diff(some.rings.astype(int)) >= 0).all()
    for ring in np.unique(some.rings):
        mine, all_of_it = some.rings == ring, every.rings == ring
        # Centroids stay among the points they stand for, in place and time.
        near = np.linalg.norm(some.points[mine][:, None] - every.points[all_of_it], axis=2)
        assert near.min(axis=1).max() < 0.5
        late = np.abs(some.times[mine] - every.times[all_of_it][near.argmin(axis=1)])
        assert late.max() < np.radians(0.4) * 40


def test_what_is_no_feature_is_kept_near_by_for_each_point_of_it() -> None:
    scan = bumpy(3)
    assert scan.times is not None
    found = extract_features(scan)
    rest = np.flatnonzero(found.labels == 0)
    kept = found.neither
    assert kept.times is not None
    assert 0.02 * len(rest) < len(kept) < 0.8 * len(rest)
    away, nearest = cKDTree(kept.points).query(scan.points[rest])
    assert away.max() < 0.2 * np.sqrt(3)
    assert np.abs(kept.times[nearest] - scan.times[rest]).max() < np.radians(0.4) * 40


def test_the_order_of_points_in_the_file_does_not_matter() -> None:
    scan = simulate("block", seed=1, count=2).scan(0)
    mixed = np.random.default_rng(5).permutation(len(scan))
    here, there = extract_features(scan), extract_features(scan.select(mixed))
    # Only where a ring begins differs: regions are cut there.
    assert np.mean(there.labels == here.labels[mixed]) > 0.9
    assert len(there.edges) == pytest.approx(len(here.edges), rel=0.1)


@pytest.mark.parametrize("rpy_deg", [(0, 90, 0), (90, 0, 0), (180, 0, 0), (0, 60, 0)])
@pytest.mark.parametrize("is_shuffled", [False, True])
def test_rings_about_any_axis_give_the_features_of_those_about_z(
    rpy_deg: tuple[int, int, int], is_shuffled: bool
) -> None:
    scan = bumpy(4)
    assert scan.rings is not None
    order = np.random.default_rng(0).permutation(len(scan)) if is_shuffled else np.arange(len(scan))
    turned = scan.points @ so3.from_euler_rpy(np.deg2rad(rpy_deg))
    expected = extract_features(scan).labels[order]
    labels = extract_features(scan_of(turned[order], scan.rings[order])).labels
    assert (expected != 0).mean() > 0.3
    assert (labels == expected).mean() > 0.95, "the seam of the walk lies elsewhere"


def test_scans_of_nothing_give_no_features() -> None:
    for n in (0, 1, 7):
        scan = scan_of(np.full((n, 3), 5.0), np.zeros(n))
        found = extract_features(scan)
        assert [len(p) for p in (found.edges, found.less_edges, found.planes, found.less_planes)] == [0, 0, 0, 0]
        assert found.edges.points.shape == (0, 3)
