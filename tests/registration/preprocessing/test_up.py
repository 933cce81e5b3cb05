"""Up in the frame of a sensor that hangs, lies or is pitched, against scans whose up is known."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from turned_sensor import TURNS, turn, turned_points

from lslam.core.config.input import PreprocessConfig
from lslam.core.geometry import so3
from lslam.core.types.scan import Scan
from lslam.registration.preprocessing.ground import AXIS, Z, above_ground, find_up, ground_of, ground_share, up_of
from lslam.registration.preprocessing.segments import lego_features
from lslam.simulation.scenarios import simulate

Points = NDArray[np.float32]


@cache
def scan() -> Scan:
    return simulate("block", seed=3, count=1, motion_compensated=True).scan(0)


def corridor(up: float = 2.6, below: float = 1.4, seed: int = 0) -> Points:
    """A corridor 3 m wide between a floor and a ceiling."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-20, 20, 20_000), rng.uniform(-1.5, 1.5, 20_000)
    flat = np.column_stack([x, y, np.where(np.arange(20_000) % 2, -below, up - below)])
    z, side = rng.uniform(-below, up - below, 20_000), rng.choice([-1.5, 1.5], 20_000)
    return np.concatenate([flat, np.column_stack([x, side, z])]).astype(np.float32)


def off_deg(direction: NDArray[np.float64], R: NDArray[np.float64]) -> float:
    return float(np.rad2deg(np.arccos(np.clip(direction @ R[2], -1, 1))))


@pytest.mark.parametrize(
    "rpy", [*TURNS.values(), (90.0, 0.0, 0.0), (0.0, -60.0, 0.0), (70.0, 50.0, 20.0), (180.0, 20.0, 0)]
)
def test_up_of_a_turned_sensor_is_the_normal_of_the_ground(rpy: tuple[float, float, float]) -> None:
    R = so3.from_euler_rpy(np.deg2rad(rpy))
    up = find_up(turned_points(scan().points, R))
    assert up.source == "ground"
    assert off_deg(up.direction, R) < 2.0


@pytest.mark.parametrize("rpy", [(0.0, 0.0, 0.0), (0.0, 30.0, 0.0), (-25.0, 25.0, 90.0), (0.0, 44.0, 0.0)])
def test_up_of_a_sensor_within_45_deg_is_z_to_the_bit(rpy: tuple[float, float, float]) -> None:
    R = so3.from_euler_rpy(np.deg2rad(rpy))
    assert np.array_equal(find_up(turned_points(scan().points, R)).direction, Z)
    assert np.array_equal(find_up(turned_points(scan().points, R), R[2]).direction, Z)


def test_a_wall_is_no_ground_and_neither_is_what_the_sensor_lies_in() -> None:
    rng = np.random.default_rng(0)
    wall = np.column_stack([np.full(5000, 8.0), rng.uniform(-10, 10, 5000), rng.uniform(-2, 8, 5000)]).astype(
        np.float32
    )
    assert ground_share(wall, np.array([-1.0, 0, 0]))[0] < 0.4
    assert find_up(wall) == AXIS
    through = np.column_stack([rng.uniform(-10, 10, (5000, 2)), np.full(5000, -0.1)]).astype(np.float32)
    assert ground_share(through, Z)[0] == 0.0
    assert find_up(np.zeros((0, 3), np.float32)) == AXIS


def test_gravity_tells_a_floor_from_its_ceiling() -> None:
    """Nothing but gravity does: without it z is believed."""
    R = turn("upside down")
    points = turned_points(corridor(), R)
    assert np.array_equal(find_up(points).direction, Z)
    up = find_up(points, so3.exp(np.array([0.1, 0.0, 0.0])) @ R[2])
    assert up.source == "gravity"
    assert off_deg(up.direction, R) < 1.0, "the floor is more precise than the accelerometer"


def test_gravity_of_the_wrong_sign_is_denied_by_the_ground() -> None:
    assert find_up(scan().points, -Z) == AXIS
    beam = np.array([[5.0, 0.1, 0.2]] * 9, np.float32)
    assert np.array_equal(find_up(beam, -Z).direction, -Z), "without any ground there is nothing but gravity"


@pytest.mark.parametrize("name", TURNS)
def test_ground_under_a_turned_sensor_is_that_under_the_upright_one(name: str) -> None:
    R, points = turn(name), scan().points
    config = PreprocessConfig(up=tuple(3.0 * R[2]))
    upright = np.zeros(len(points), bool)
    upright[above_ground(points)] = True
    turned = np.zeros(len(points), bool)
    turned[above_ground(turned_points(points, R), up_of(config))] = True
    assert 0.3 < upright.mean() < 0.9
    assert (turned == upright).mean() > 0.995
    blind = np.zeros(len(points), bool)
    blind[above_ground(turned_points(points, R))] = True
    assert (blind == upright).mean() < 0.9


def test_without_a_plane_the_horizon_is_that_of_up() -> None:
    assert np.allclose(ground_of(np.zeros((9, 3), np.float32), -Z).R[2], -Z)


def test_lego_loam_finds_the_ground_of_a_sensor_upside_down() -> None:
    upright = lego_features(scan())[1]
    hanging = Scan(turned_points(scan().points, turn("upside down")), 0, 0, rings=scan().rings)
    segments = lego_features(hanging, gate=PreprocessConfig(up=(0.0, 0.0, -1.0)))[1]
    assert upright.ground.mean() > 0.2
    assert (segments.ground == upright.ground).mean() > 0.98
    assert (lego_features(hanging)[1].ground == upright.ground).mean() < 0.9
