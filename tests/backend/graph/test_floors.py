"""When the floors seen on the way may be taken for one plane."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lslam.backend.graph.problem import FloorPlane
from lslam.backend.levelling import on_one_plane
from lslam.core.config.backend import GraphConfig
from lslam.core.geometry import se3, so3

WAY = 2.0 * np.arange(60)


def drive(height: np.ndarray, seed: int) -> tuple[list[FloorPlane], np.ndarray]:
    """A car on a road of `height` (K,) m over its way, whose floor is the road under it, seen with noise; its poses."""
    rng = np.random.default_rng(seed)
    pitch = -np.arctan(np.gradient(height, WAY))
    poses = se3.make(
        so3.from_euler_rpy(np.column_stack([0 * WAY, pitch, 0 * WAY])), np.column_stack([WAY, 0 * WAY, height])
    )
    tilts = so3.exp(np.deg2rad(0.1) * rng.normal(size=(len(WAY), 3)))
    return [
        FloorPlane(k, tilts[k, :, 2], 1.7 + 0.01 * rng.normal(), np.deg2rad(1.0), 0.1) for k in range(len(WAY))
    ], poses


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_flat_floor_is_one_plane_though_odometry_drifts(seed: int) -> None:
    """0.7 % upwards and 0.35 deg/100 m of pitch, under what `graph.drift_*` allow; a roof and a ramp are left out."""
    floors, poses = drive(np.zeros(len(WAY)), seed)
    bent = so3.exp(np.column_stack([0 * WAY, np.deg2rad(0.35) / 100 * WAY, 0 * WAY]))
    poses = se3.make(bent, poses[:, :3, 3] + np.column_stack([0 * WAY, 0 * WAY, 0.007 * WAY]))
    floors[20] = replace(floors[20], offset=floors[20].offset + 3.0)
    floors[40] = replace(floors[40], normal=so3.exp(np.array([0.1, 0, 0])) @ floors[40].normal)
    kept = on_one_plane(floors, poses, WAY, GraphConfig())
    assert [f.keyframe for f in kept] == [k for k in range(len(WAY)) if k not in (20, 40)]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_hills_are_not(seed: int) -> None:
    """A metre up and down, as flat as 4 deg at its steepest."""
    assert on_one_plane(*drive(0.5 * np.sin(2 * np.pi * WAY / 60), seed), WAY, GraphConfig()) == []


def test_two_storeys_are_not() -> None:
    """Level floors, half of them three metres up: a plane between would fit neither."""
    assert on_one_plane(*drive(np.where(WAY > 60, 3.0, 0.0), 0), WAY, GraphConfig()) == []


def test_no_floors_are_no_plane() -> None:
    assert on_one_plane([], np.zeros((0, 4, 4)), np.zeros(0), GraphConfig()) == []
