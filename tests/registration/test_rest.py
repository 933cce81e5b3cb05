"""A sensor at rest among things that move: which of two motions needs fewer of them to have moved."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.config.input import PreprocessConfig
from lslam.core.geometry import se3, so3
from lslam.registration.rest import PlanWalls, Rest, Votes

Floats = NDArray[np.float64]
Points = NDArray[np.float32]

SIGMA = 0.03
VOXEL_M = 0.8
# m, ends of walls in plan, and between which heights: the back of a truck, and what the sensor sees of two houses.
TRUCK = ((7.0, -1.3), (7.0, 1.3), -1.5, 1.8)
HOUSES = (((-36.0, 10.0), (-36.0, 13.0), -1.0, 4.0), ((-51.0, -12.0), (-51.0, -9.0), -1.0, 4.0))


def wall(
    begin: tuple[float, float], end: tuple[float, float], low: float, high: float, rng: np.random.Generator
) -> Floats:
    """Six rings on an upright wall, a point every quarter metre, with a centimetre of noise."""
    along = np.linspace(0, 1, 1 + int(np.hypot(end[0] - begin[0], end[1] - begin[1]) / 0.25))
    xy = np.array(begin) + along[:, None] * (np.array(end) - np.array(begin))
    points = np.vstack([np.column_stack([xy, np.full(len(xy), z)]) for z in np.linspace(low, high, 6)])
    return np.asarray(points + rng.normal(0, 0.01, points.shape))


def scan(truck_m: float = 0.0, sensor_m: float = 0.0, seed: int = 0) -> Points:
    """Level ground, the houses and the truck, the truck and the sensor so far ahead of where they stood."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(-60.0, 20.0), np.arange(-15.0, 16.0))
    ground = np.column_stack([x.ravel(), y.ravel(), rng.normal(-1.8, 0.01, x.size)])
    moved = wall(*TRUCK, rng) + np.array([truck_m, 0, 0])
    points = np.vstack([ground, moved, *(wall(*house, rng) for house in HOUSES)]) - [sensor_m, 0, 0]
    return points.astype(np.float32)


def ahead(metres: float) -> Floats:
    """So far along x."""
    return se3.make(np.eye(3), np.array([metres, 0.0, 0.0]))


@pytest.fixture(scope="module")
def walls() -> PlanWalls:
    """Of the scan at rest."""
    return PlanWalls(scan(), PreprocessConfig(), SIGMA, VOXEL_M)


@pytest.mark.parametrize(
    ("truck_m", "sensor_m", "claimed_m", "votes"),
    [
        # The truck leaves, and registration follows it: two houses would have to have come along.
        (0.1, 0.0, -0.1, Votes(2, 1)),
        (2.0, 0.0, -2.0, Votes(2, 1)),
        # The sensor leaves, alone or behind the truck.
        (0.0, 0.1, 0.1, Votes(0, 3)),
        (0.1, 0.1, 0.1, Votes(1, 2)),
        # What left is seen at neither pose.
        (2.0, 0.1, 0.1, Votes(0, 2)),
    ],
)
def test_each_thing_has_one_vote(
    walls: PlanWalls, truck_m: float, sensor_m: float, claimed_m: float, votes: Votes
) -> None:
    counted = walls.votes(scan(truck_m, sensor_m, seed=1), ahead(claimed_m))
    assert counted == votes
    assert counted.is_standing == (votes.stay == 2)


def test_a_motion_within_the_noise_has_no_votes(walls: PlanWalls) -> None:
    assert walls.votes(scan(seed=1), ahead(0.01)) == Votes(0, 0)
    assert not Votes(0, 0).is_standing


def test_rings_on_a_slope_and_open_ground_are_no_walls() -> None:
    """They lie where the sensor is, and would say that it stands wherever it goes."""
    rng = np.random.default_rng(0)
    angle = np.linspace(-0.4, 0.4, 80)
    ring = np.column_stack([30 * np.cos(angle), 30 * np.sin(angle), rng.normal(3.0, 0.005, 80)])
    ground = scan()[: 80 * 31]
    for cloud in (np.vstack([ground, ring]).astype(np.float32), ground, ground[:0]):
        assert PlanWalls(cloud, PreprocessConfig(), SIGMA, VOXEL_M).votes(cloud, ahead(0.5)).stay == 0


def test_a_sensor_that_is_pitched_sees_the_same_walls() -> None:
    T = se3.make(so3.exp(np.array([0.0, 0.3, 0.0])), np.zeros(3))

    def tilted(points: Points) -> Points:
        return se3.apply(T, points.astype(np.float64)).astype(np.float32)

    walls = PlanWalls(tilted(scan()), PreprocessConfig(), SIGMA, VOXEL_M)
    motion = T @ ahead(-0.1) @ se3.inverse(T)
    assert walls.votes(tilted(scan(0.1, seed=1)), motion) == Votes(2, 1)


def test_in_a_room_a_tenth_as_large_things_are_told_apart_as_in_a_street() -> None:
    walls = PlanWalls(scan() / 10, PreprocessConfig(), SIGMA, VOXEL_M / 10)
    assert walls.votes(scan(1.0, seed=1) / 10, ahead(-0.1)) == Votes(2, 1)


def test_the_spot_is_left_beyond_three_sigma_and_restored_with_its_scan() -> None:
    rest = Rest(PreprocessConfig(), SIGMA, VOXEL_M)
    for k, (metres, scans) in enumerate([(0.0, 1), (0.02, 2), (0.08, 3), (0.1, 1), (0.18, 2)]):
        rest.enter(scan(seed=k), ahead(metres), 10.0)
        assert rest.scans == scans
    # Its scans lie three centimetres about the spot: so far from it is no motion yet.
    assert rest.is_here(ahead(0.18), 10.0)
    assert not rest.is_here(ahead(0.2), 10.0)
    turned, pitched = (
        se3.make(so3.exp(np.array(turn)), np.array([0.1, 0, 0.5])) for turn in ((0, 0, 0.01), (0, 0.1, 0))
    )
    assert rest.is_here(turned, 1.0)
    assert not rest.is_here(turned, 10.0)
    assert rest.is_here(pitched, 10.0)
    again = Rest(PreprocessConfig(), SIGMA, VOXEL_M)
    again.restore(rest.state())
    moved = scan(0.1, seed=9), ahead(0.0)
    assert again.scans == 2
    assert again.votes(*moved) == rest.votes(*moved) == Votes(2, 1)
