"""Which way is up: found of a tilted world, and the turned keyframes are the same keyframes."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from known_town import keyframes_of, pose, round_the_square, seen, town

from lslam.backend.loops.level_submap import find_up, level_keyframes, make_level_submap
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.geometry import se3, so3


@pytest.mark.parametrize("tilt", [(0, 0), (25, 0), (-15, 30)])
def test_finds_up_in_a_tilted_world(tilt: tuple[float, float]) -> None:
    R = pose(0, 0, roll_deg=tilt[0], pitch_deg=tilt[1])[:3, :3]
    world, rng = town(), np.random.default_rng(0)
    clouds = [seen(world, pose(x, -45), rng) for x in (-20.0, 15.0)]
    maps = [make_level_submap((cloud @ R.T).astype(np.float32), RegistrationConfig()).fine for cloud in clouds]
    assert np.rad2deg(np.arccos(find_up(maps) @ R[:, 2])) < 1.0


@pytest.mark.parametrize(("slope_deg", "up_deg"), [(12.0, 4.0), (21.0, 7.0), (24.0, 0.0)])
def test_up_is_the_mean_of_what_is_level_to_fifteen_degrees(slope_deg: float, up_deg: float) -> None:
    """Two thirds of the ground are flat: the mean normal of all leans over by a third of what the other third slopes."""
    tilts = np.deg2rad([0.0, 0.0, slope_deg])
    planes = np.zeros((3, 8))
    planes[:, 3], planes[:, 5] = np.sin(tilts), np.cos(tilts)
    planes[1, 3:6] *= -1  # which side of a plane was seen says nothing
    walls = np.zeros((2, 8))
    walls[:, 3] = 1.0
    up = find_up([SimpleNamespace(planes=np.concatenate([planes, walls]))])  # type: ignore[list-item]
    assert np.rad2deg(np.arctan2(up[0], up[2])) == pytest.approx(up_deg, abs=0.1)


def test_up_stays_z_where_nothing_is_level() -> None:
    assert (find_up([]) == (0, 0, 1)).all()
    empty = make_level_submap(np.zeros((0, 3), np.float32), RegistrationConfig()).fine
    assert (find_up([empty]) == (0, 0, 1)).all()


def test_levelled_keyframes_have_the_same_relative_poses_and_turned_covariances() -> None:
    keyframes = [replace(k, covariance=np.diag([1.0, 2, 3, 4, 5, 6])) for k in
                 keyframes_of(np.array([round_the_square(d) for d in (0.0, 30.0, 120.0)]))]  # fmt: skip
    up = so3.exp(np.array([0.3, -0.2, 0.0]))[:, 2]
    turned = level_keyframes(keyframes, up)
    for before, after in zip(keyframes, turned, strict=True):
        relative = se3.relative(turned[0].T_world_lidar, after.T_world_lidar)
        assert np.allclose(relative, se3.relative(keyframes[0].T_world_lidar, before.T_world_lidar))
        R = after.T_world_lidar[:3, :3] @ before.T_world_lidar[:3, :3].T
        assert np.allclose(R @ up, [0, 0, 1])
        assert after.covariance is not None
        assert np.allclose(after.covariance[:3, :3], R @ np.diag([1.0, 2, 3]) @ R.T)
        assert np.allclose(after.covariance[3:, 3:], R @ np.diag([4.0, 5, 6]) @ R.T)
