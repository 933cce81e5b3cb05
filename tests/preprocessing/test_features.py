"""LOAM's features: against a plain reference, and on scenes whose edges and planes are known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.config import load_config
from lslam.config.loam import LoamConfig
from lslam.config.preprocess import PreprocessConfig
from lslam.errors import ConfigError, InputError
from lslam.preprocessing.features import extract_features, walk_rings
from lslam.simulation.scenarios import simulate
from lslam.types.scan import Scan
from tests.preprocessing.numpy_features import reference_labels

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
    "config",
    [
        LoamConfig(),
        LoamConfig(regions=4, max_edge_points=1, max_less_edge_points=3, max_planar_points=9, occlusion=0.5),
        LoamConfig(regions=1, edge_curvature=0.5, planar_curvature=0.2, edge_noise=2.0, parallel_deg=60),
    ],
)
def test_the_kernels_pick_what_the_plain_reference_picks(config: LoamConfig) -> None:
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


def test_limits_that_contradict_each_other_are_refused() -> None:
    with pytest.raises(ConfigError, match="max_less_edge_points = 1"):
        load_config(None, ["loam.max_less_edge_points=1"], {})
    with pytest.raises(ConfigError, match="planar_curvature = 2"):
        load_config(None, ["loam.planar_curvature=2"], {})
