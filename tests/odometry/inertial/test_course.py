"""The motion within sweeps by the poses of their middles, against motions that are known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.geometry import se3, so3
from lslam.odometry.inertial.constant_velocity import Course, natural_spline

TENTH_S, TENTH_NS = 0.1, 100_000_000
KNOTS = np.linspace(0.0, TENTH_S, 33)


def turning(seconds: NDArray[np.float64]) -> NDArray[np.float64]:
    """A hand that looks about: a heading that swings by 40 deg in a second, at 1.3 m/s."""
    yaw = np.deg2rad(40.0) * np.sin(2.0 * np.pi * seconds / 2.0)
    twists = np.stack([np.zeros_like(yaw), 0.1 * yaw, yaw], axis=1)
    return np.stack(
        [se3.make(so3.exp(w), np.array([1.3 * t, 0.1 * np.sin(t), 0.0])) for t, w in zip(seconds, twists, strict=True)]
    )


def course_of(count: int, instants_ns: NDArray[np.int64] | None = None) -> Course:
    middles = np.arange(count) * TENTH_NS + TENTH_NS // 2 if instants_ns is None else instants_ns
    return Course(middles, turning(1e-9 * middles))


def most_apart(poses: NDArray[np.float64], true: NDArray[np.float64]) -> tuple[float, float]:
    """Largest distance, m, and angle, rad, of the motion since the middle."""
    off = se3.relative(*(se3.relative(some[16], some) for some in (poses, true)))
    return float(np.linalg.norm(off[:, :3, 3], axis=1).max()), float(so3.angle(off[:, :3, :3]).max())


@pytest.mark.parametrize("k", range(3, 17))
def test_a_turn_that_changes_within_sweeps_is_followed(k: int) -> None:
    stamp_ns = k * TENTH_NS
    told = course_of(20).at(stamp_ns, KNOTS)
    assert told is not None
    moved_m, turned = most_apart(told, turning(1e-9 * stamp_ns + KNOTS))
    assert moved_m < 1e-3
    assert turned < np.deg2rad(0.05)
    # What the velocity since the middle before is off by.
    before = turning(1e-9 * stamp_ns + np.array([-0.05, 0.05]))
    chord = before[1] @ se3.exp((KNOTS - 0.05)[:, None] / TENTH_S * se3.log(se3.relative(before[0], before[1])))
    if abs(np.cos(np.pi * (1e-9 * stamp_ns + 0.05))) < 0.9:  # but where it is steady
        assert turned < 0.1 * most_apart(chord, turning(1e-9 * stamp_ns + KNOTS))[1]


def test_the_first_half_sweep_goes_on_as_the_course_begins() -> None:
    told = course_of(6).at(0, KNOTS)
    assert told is not None
    steps = se3.log(se3.relative(told[:16], told[1:17]))
    np.testing.assert_allclose(steps, np.broadcast_to(steps[0], steps.shape), atol=1e-12)


def test_a_course_is_told_by_three_middles_one_of_them_within_the_sweep() -> None:
    course = course_of(3)
    assert course.at(TENTH_NS, KNOTS) is not None
    assert course.at(3 * TENTH_NS, KNOTS) is None, "no middle lies within"
    assert course_of(2).at(0, KNOTS) is None
    assert course.at(TENTH_NS, KNOTS[:1]) is None, "a sweep that takes no time"


def test_where_scans_are_missing_the_course_goes_through_those_that_are_there() -> None:
    kept = np.array([0, 1, 2, 4, 5, 6, 7]) * TENTH_NS + TENTH_NS // 2
    told = course_of(0, kept).at(2 * TENTH_NS, KNOTS)
    assert told is not None
    assert most_apart(told, turning(0.2 + KNOTS))[1] < np.deg2rad(0.3)


def test_a_middle_that_is_no_later_than_one_before_it_is_left_out() -> None:
    middles = np.arange(7) * TENTH_NS + TENTH_NS // 2
    twice = np.insert(middles, [4, 5], [middles[3] - 5_000_000, middles[4]])
    poses = turning(1e-9 * twice)
    poses[[4, 6]] = se3.make(np.eye(3), np.full(3, 9.0))
    told, expected = (
        course.at(3 * TENTH_NS, KNOTS) for course in (Course(twice, poses), Course(middles, turning(1e-9 * middles)))
    )
    assert told is not None
    assert expected is not None
    np.testing.assert_allclose(told, expected, atol=1e-12)


def test_the_spline_is_the_natural_one() -> None:
    """Its second derivative vanishes at both ends, and is continuous in between."""
    rng = np.random.default_rng(3)
    nodes = np.cumsum(rng.uniform(0.05, 0.2, 6))
    values = rng.normal(size=(6, 2))
    np.testing.assert_allclose(natural_spline(nodes, values, nodes), values, atol=1e-12)
    h = 1e-4

    def bend(at: float) -> NDArray[np.float64]:
        before, here, after = natural_spline(nodes, values, at + np.array([-h, 0.0, h]))
        return np.asarray((before - 2 * here + after) / h**2)

    scale = max(float(np.abs(bend(float(t))).max()) for t in np.linspace(nodes[0] + 2 * h, nodes[-1] - 2 * h, 50))
    for end in (nodes[0] + h, nodes[-1] - h):
        assert np.abs(bend(float(end))).max() < 0.01 * scale
    for node in nodes[1:-1]:
        np.testing.assert_allclose(bend(float(node - 2 * h)), bend(float(node + 2 * h)), atol=0.05 * scale)
    outside = natural_spline(nodes, values, nodes[-1] + np.array([0.0, 0.1, 0.2]))
    np.testing.assert_allclose(np.diff(outside, axis=0)[0], np.diff(outside, axis=0)[1], atol=1e-12)
