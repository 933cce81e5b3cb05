"""Other drives through one town: the town stays to the byte, what moves and what is measured does not."""

from __future__ import annotations

import numpy as np
import pytest

from lslam.core.errors import UsageError
from lslam.simulation.routes import FIRST_VISIT, Visit
from lslam.simulation.scenarios import SimulatedDrive, simulate

SHARES_TOWNS = True


def drive(visit: Visit = FIRST_VISIT) -> SimulatedDrive:
    return simulate("block", seed=3, count=12, visit=visit)


def test_the_town_is_the_same_and_the_noise_another() -> None:
    first, other = drive(), drive(Visit(1))
    assert first.city.mesh.vertices.tobytes() == other.city.mesh.vertices.tobytes()
    a, b = first.scan(5).points, other.scan(5).points
    assert a.shape != b.shape or not np.array_equal(a, b)


def test_the_same_visit_gives_the_same_bytes() -> None:
    assert np.array_equal(drive(Visit(2)).scan(3).points, drive(Visit(2)).scan(3).points)


def test_the_first_visit_is_the_drive_without_one() -> None:
    assert np.array_equal(drive().scan(4).points, simulate("block", seed=3, count=12).scan(4).points)


def test_reversed_drives_look_the_other_way() -> None:
    first, back = drive(), drive(Visit(1, is_reversed=True))
    place = first.city_poses[:, :2, 3]
    for T in back.city_poses:
        k = int(np.linalg.norm(place - T[:2, 3], axis=1).argmin())
        assert float(first.city_poses[k, :2, 0] @ T[:2, 0]) < 0.5 or np.linalg.norm(place[k] - T[:2, 3]) > 5.0


def test_a_drive_begins_so_far_along_the_line() -> None:
    first = simulate("block", seed=3, count=80)
    shifted = drive(Visit(1, shift=40.0))
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(first.city_poses[:, :3, 3], axis=0), axis=1))])
    k = int(np.linalg.norm(first.city_poses[:, :2, 3] - shifted.city_poses[0, :2, 3], axis=1).argmin())
    assert travelled[k] == pytest.approx(40.0, abs=1.5)


@pytest.mark.parametrize("shift", [-1.0, 1e6])
def test_a_start_beyond_the_line_is_refused(shift: float) -> None:
    with pytest.raises(UsageError, match="--from"):
        drive(Visit(1, shift=shift))


def test_a_flight_is_visited_as_it_is() -> None:
    with pytest.raises(UsageError, match="leave out --reverse"):
        simulate("quadrotor", count=5, visit=Visit(1, is_reversed=True))
