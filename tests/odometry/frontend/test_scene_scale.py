"""Lengths that follow the scene: by the median range of a few scans, unless they are set."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stub_sequences import Stub

import lslam
from lslam.core.config import Config
from lslam.core.types.scan import Scan
from lslam.odometry.frontend.scene_scale import scene_scale, with_ring_gap, with_scene_scale


def ball(range_m: float, index: int = 0) -> Scan:
    """Points in all directions, half of them within this range, and some that measured nothing."""
    rng = np.random.default_rng(index)
    directions = rng.normal(size=(999, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    points = directions * np.linspace(0.5, 1.5, 999)[:, None] * range_m
    return Scan(
        np.concatenate([points, np.zeros((50, 3)), np.full((50, 3), np.nan)]).astype(np.float32), index * 10**8, index
    )


def test_lengths_are_in_proportion_to_the_range_of_half_of_the_points() -> None:
    room = Stub([ball(2.0, i) for i in range(3)])
    config = with_scene_scale(Config(), room)
    assert (config.registration.voxel_size, config.preprocess.map_leaf, config.preprocess.range_min) == (
        0.2,
        0.075,
        0.25,
    )
    assert (config.loam.feature_map_voxel, config.registration.sigma) == (0.25, Config().registration.sigma)
    assert room.notes[-1] == "a small scene: the voxels of the local map are 0.2 m wide"


def rings(range_m: float) -> Scan:
    """Sixteen rings two degrees apart."""
    azimuth, elevation = np.meshgrid(np.linspace(-np.pi, np.pi, 400), np.deg2rad(np.arange(-15.0, 16.0, 2.0)))
    points = range_m * np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
    )
    return Scan(points.reshape(-1, 3).astype(np.float32), 0, 0)


def test_a_voxel_spans_several_rings() -> None:
    """Rings two degrees apart, 3 m away: five of them are 0.52 m apart, where a tenth of the range is 0.3 m."""
    sparse = Stub([rings(3.0)])
    np.testing.assert_allclose(
        with_scene_scale(Config(), sparse).registration.voxel_size, 5 * 3 * np.deg2rad(2), atol=2e-3
    )


def test_the_first_scan_tells_the_gap_between_rings_unless_it_is_set_or_no_rings_show() -> None:
    found = with_ring_gap(Config(), Stub(["cut short", rings(9.0)]))
    assert found.preprocess.ring_gap_deg == pytest.approx(2.0, rel=0.02)
    given = Config.model_validate({"preprocess": {"ring_gap_deg": 0}})
    assert with_ring_gap(given, Stub([rings(9.0)])) is given
    assert with_ring_gap(Config(), Stub([ball(9.0)])) == Config()
    assert with_ring_gap(Config(), Stub(["cut short"])) == Config()


def test_lengths_that_are_set_are_kept() -> None:
    given = Config.model_validate({"registration": {"voxel_size": 0.8}, "preprocess": {"map_leaf": 0.1}})
    config = with_scene_scale(given, Stub([ball(2.0)]))
    assert (config.registration.voxel_size, config.preprocess.map_leaf, config.preprocess.range_min) == (0.8, 0.1, 0.25)


def test_streets_keep_the_configuration() -> None:
    street = Stub([ball(9.0, i) for i in range(3)], notes=[])
    config = Config()
    assert with_scene_scale(config, street) is config
    assert (street.notes, street.reads) == ([], [0])


def test_a_covered_or_unreadable_scan_decides_nothing() -> None:
    scans: list[Scan | str] = [ball(0.2), "cut short", ball(9.0, 2)]
    assert scene_scale(Stub(scans)) == 1.0
    assert with_scene_scale(Config(), Stub(["cut short"])) == Config()
    assert with_scene_scale(Config(), Stub([Scan(np.zeros((5, 3), np.float32), 0, 0)])) == Config()


def test_a_sensor_that_stands_on_a_desk_registers_all_scans(recordings: Any, tmp_path: Path) -> None:
    """Half of the points lie nearer than 0.9 m, with gaps of up to 0.8 s."""
    outcome = lslam.run(recordings("robosense_helios") / "robosense_helios", out=tmp_path / "run")
    assert [result.status for result in outcome.record.results] == ["ok"] * 8
    positions = outcome.record.trajectory.poses[:, :3, 3]
    assert np.linalg.norm(positions, axis=1).max() < 0.05
    assert np.linalg.norm(np.diff(positions, axis=0), axis=1).sum() < 0.1
