"""The violent flight: as fast, as hard and as long as it says, inside its hall."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from lslam.core.errors import ConfigError, UsageError
from lslam.simulation.imu import GRAVITY, specific_force
from lslam.simulation.kinematics import Kinematics
from lslam.simulation.path import HOVER, VIOLENT
from lslam.simulation.routes import WayPoints
from lslam.simulation.scenario_files import find_scenario
from lslam.simulation.scenarios import SimulatedDrive, simulate

SEEDS = (0, 2)


@cache
def flight(seed: int, *settings: str) -> SimulatedDrive:
    return simulate("quadrotor", seed=seed, lidar="vlp16", settings=settings)


def motion(drive: SimulatedDrive) -> Kinematics:
    return drive.vehicle.at(np.arange(0, drive.end, 0.005))


@pytest.mark.parametrize("seed", SEEDS)
def test_it_turns_at_500_degrees_per_second_and_feels_5_g_for_10_s(seed: int) -> None:
    felt = motion(flight(seed))
    rate = np.degrees(np.linalg.norm(felt.rate, axis=1))
    force = np.linalg.norm(specific_force(felt), axis=1) / GRAVITY
    assert rate.max() == pytest.approx(500, rel=0.1)
    assert force.max() == pytest.approx(5.0, rel=0.08)
    assert np.linalg.norm(felt.velocity, axis=1).max() == pytest.approx(19.3, rel=0.05)
    hovering, violent = slice(0, int(HOVER / 0.005)), slice(-int(VIOLENT / 0.005), None)
    assert force[hovering].max() < 1.1
    assert np.linalg.norm(felt.velocity[hovering], axis=1).max() < 0.5
    seconds = force[violent].reshape(10, -1)
    assert (seconds.max(axis=1) > 3.5).all(), "it never rests"
    assert len(flight(seed)) == 145


@pytest.mark.parametrize("seed", SEEDS)
def test_the_thrust_is_along_the_sensors_z_axis(seed: int) -> None:
    """As a quadrotor's must be, but for the wind that shakes it."""
    felt = motion(flight(seed, "path.swing=0"))
    force = specific_force(felt)
    assert np.abs(force[:, :2]).max() < 0.05 * GRAVITY
    assert force[:, 2].min() > 0.5 * GRAVITY


@pytest.mark.parametrize("seed", SEEDS)
def test_it_stays_clear_of_the_hall_and_sees_it_all_the_time(seed: int) -> None:
    drive = flight(seed)
    places = drive.vehicle.poses(np.arange(0, drive.end, 0.01))[:, :3, 3].astype(np.float32)
    rng = np.random.default_rng(0)
    rays = rng.standard_normal((400, 3))
    rays = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)
    for place in places[::50]:
        far, face = drive.scene.cast(np.tile(place, (400, 1)), rays)
        assert (face >= 0).all(), "the hall is closed"
        assert far.min() > 0.7


def test_a_lower_speed_is_a_gentler_flight_and_a_higher_one_is_refused() -> None:
    gentle = simulate("quadrotor", speed=8.0, lidar="vlp16")
    assert np.degrees(np.linalg.norm(motion(gentle).rate, axis=1)).max() < 200
    with pytest.raises(UsageError, match="use a lower --speed"):
        simulate("quadrotor", speed=25.0)


def test_it_has_a_line_and_a_place_of_its_own() -> None:
    line = WayPoints(np.array([[0.0, 0.0], [20.0, 0.0], [40.0, 5.0]]))
    with pytest.raises(UsageError, match="leave out --path"):
        simulate("quadrotor", way_points=line)
    with pytest.raises(ConfigError, match="expected 'eights' there"):
        find_scenario("quadrotor", ["path.shape=straight"])
    with pytest.raises(ConfigError, match="expected 'hall' there"):
        find_scenario("street", ["path.shape=eights"])
