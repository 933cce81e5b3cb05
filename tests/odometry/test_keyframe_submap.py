"""Target `submap`: the spacing of keyframes, the keyframes of the map, and a place that is seen again."""

from __future__ import annotations

import numpy as np
import pytest
from analytic_scenes import pose_at
from numpy.typing import NDArray

from lslam.registration.keyframe_submap import HULL_KEYFRAMES, NEAREST_KEYFRAMES, KeyframeSubmap, hull_of, spacing_of
from lslam.registration.preprocessing.prepare import PreparedPoints

Floats = NDArray[np.float64]


class Listed:
    """A map that notes where what lies in it was seen from, and how often it was emptied."""

    def __init__(self) -> None:
        self.held: list[tuple[float, float]] = []
        self.cleared = 0

    def insert(self, points: NDArray[np.float32], source: Floats, T: Floats) -> None:
        self.held.append((float(T[0, 3]), float(T[1, 3])))

    def clear(self) -> None:
        self.held, self.cleared = [], self.cleared + 1


def cloud(away: float) -> PreparedPoints:
    """A scan whose points are all so far away, m."""
    return PreparedPoints(np.full((1, 3), away, np.float32), np.array([[away, 0.0, 0.0]]), np.zeros((1, 6)), 1)


def entered(target: KeyframeSubmap, poses: list[Floats], away: float) -> Listed:
    listed = Listed()
    for pose in poses:
        target.enter(listed, cloud(away), pose)  # type: ignore[arg-type]
    return listed


@pytest.mark.parametrize(("away", "spacing"), [(25.0, 10.0), (15.0, 5.0), (8.0, 1.0), (3.0, 0.5)])
def test_keyframes_stand_closer_where_it_is_narrow(away: float, spacing: float) -> None:
    assert spacing_of(away) == spacing
    for way, count in ((0.9 * spacing, 1), (1.1 * spacing, 2)):
        target = KeyframeSubmap()
        entered(target, [pose_at(), pose_at((way, 0.0, 0.0))], away)
        assert len(target.poses) == count


def test_spaciousness_follows_a_door_in_a_second_and_not_at_once() -> None:
    target = KeyframeSubmap()
    entered(target, [pose_at()], 30.0)
    entered(target, [pose_at()], 2.0)
    assert target.spaciousness == pytest.approx(0.95 * 30.0 + 0.05 * 2.0)
    entered(target, [pose_at()] * 40, 2.0)
    assert target.spaciousness < 6.0


def test_a_turn_makes_a_keyframe_once() -> None:
    target = KeyframeSubmap()
    entered(target, [pose_at(yaw_deg=a) for a in (0.0, 29.0, 31.0, 62.0, 120.0)], 25.0)
    assert len(target.poses) == 2


def test_the_nearest_and_the_hulls_nearest_corners_are_the_map() -> None:
    """A long straight: its ends are the hull. A drive round a square: corners far away belong to it too."""
    target = KeyframeSubmap()
    listed = entered(target, [pose_at((6.0 * k, 0.0, 0.0)) for k in range(40)], 15.0)
    assert sorted(x for x, _ in listed.held) == [0.0, *(6.0 * k for k in range(40 - NEAREST_KEYFRAMES, 40))]
    square = [(60.0, 0.0), (60.0, 60.0), (0.0, 60.0), (0.0, 0.0)]
    ring, at = [], np.zeros(2)
    for corner in square:
        steps = np.linspace(at, corner, 11)[1:]
        ring += [pose_at((x, y, 0.0)) for x, y in steps]
        at = np.array(corner)
    listed = entered(KeyframeSubmap(), ring, 15.0)
    assert set(square) <= {(round(x, 6), round(y, 6)) for x, y in listed.held}
    assert len(listed.held) <= NEAREST_KEYFRAMES + HULL_KEYFRAMES


def test_the_map_is_rebuilt_only_when_a_keyframe_leaves_it() -> None:
    target = KeyframeSubmap()
    listed = entered(target, [pose_at((6.0 * k, 0.0, 0.0)) for k in range(NEAREST_KEYFRAMES)], 15.0)
    assert listed.cleared == 0
    way = [pose_at((6.0 * k, 0.0, 0.0)) for k in (*range(NEAREST_KEYFRAMES, 40), *range(40, -1, -1))]
    listed = entered(target, way, 15.0)
    assert listed.cleared > 0
    assert sorted(x for x, _ in listed.held)[:NEAREST_KEYFRAMES] == [6.0 * k for k in range(NEAREST_KEYFRAMES)]


@pytest.mark.parametrize("dimensions", [1, 2, 3])
def test_a_hull_is_taken_in_the_space_that_keyframes_have_an_extent_in(dimensions: int) -> None:
    rng = np.random.default_rng(dimensions)
    inner = rng.uniform(-1, 1, (50, dimensions))
    corners = 3.0 * np.array(np.meshgrid(*[[-1.0, 1.0]] * dimensions)).reshape(dimensions, -1).T
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0][:dimensions]
    positions = np.vstack([inner, corners]) @ axes + rng.normal(size=3)
    assert hull_of(positions) == tuple(range(50, 50 + 2**dimensions))


def test_a_hull_of_few_or_equal_positions_is_no_error() -> None:
    assert hull_of(np.zeros((1, 3))) == (0,)
    assert hull_of(np.zeros((5, 3))) == (0,)
    assert hull_of(np.eye(3)) == (0, 1, 2)
    assert hull_of(np.vstack([np.eye(3), np.eye(3)])) in ((0, 1, 2), (0, 1, 2, 3, 4, 5), (3, 4, 5))
