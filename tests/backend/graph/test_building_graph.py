"""Buildings along a fixed trajectory: an independent least squares, free directions left free, the common shift, outliers."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.backend.graph.building_graph import SUPPORT, BuildingSolution, MapPrior, agreeing, solve_buildings
from lslam.core.geometry import se2
from lslam.core.types.building import BuildingMatch

Floats = NDArray[np.float64]

MAP_PRIOR = MapPrior(np.zeros(2), np.full(2, 3.0), np.array([1.0, 1.0, np.radians(2.0)]))
FULL = np.diag([1 / 0.3**2, 1 / 0.3**2, 1 / 0.03**2])


def match(keyframe: int, building: int, pose: Floats, information: Floats = FULL) -> BuildingMatch:
    rank = int(np.linalg.matrix_rank(information))
    return BuildingMatch(keyframe, building, pose, information, rank, "edges" if rank == 3 else "lines",
                         50.0, 0.5, 0.05, np.zeros((1, 2), np.int64))  # fmt: skip


def seen_from(keyframe: Floats, middle: Floats, displacement: Floats) -> Floats:
    """What a perfect match says of a building that is really displaced so."""
    real = np.array([middle[0] + displacement[0], middle[1] + displacement[1], displacement[2]])
    return np.asarray(se2.relative(keyframe, real))


def across(n: Floats, keyframe: Floats, with_angle: bool = True) -> Floats:
    """Information of one wall with the normal `n` (2,), in the axes of the keyframe."""
    own = se2.rotation(-keyframe[2]) @ n
    information = np.zeros((3, 3))
    information[:2, :2] = np.outer(own, own) / 0.3**2
    information[2, 2] = 1 / 0.03**2 if with_angle else 0.0
    return information


def town(seed: int, count: int = 12) -> tuple[Floats, dict[int, Floats], Floats]:
    """Middles, keyframes on a bent street, and displacements about a common shift."""
    rng = np.random.default_rng(seed)
    middles = np.column_stack([15.0 * np.arange(count), rng.uniform(8, 14, count) * rng.choice([-1, 1], count)])
    poses = {3 * k: np.array([7.0 * k, np.sin(k), 0.2 * np.cos(k)]) for k in range(2 * count)}
    shift = rng.normal(0, 1.5, 2)
    return middles, poses, np.column_stack([shift + rng.normal(0, 0.8, (count, 2)), rng.normal(0, 0.03, count)])


def near(poses: dict[int, Floats], middle: Floats, reach: float = 20.0) -> list[int]:
    return [k for k, pose in poses.items() if np.linalg.norm(pose[:2] - middle) < reach]


@pytest.mark.parametrize("seed", range(4))
def test_the_solution_is_that_of_all_rows_in_one_least_squares_problem(seed: int) -> None:
    rng = np.random.default_rng(50 + seed)
    middles, poses, _ = town(seed, 5)
    map_prior = MapPrior(np.array([0.4, -0.7]), np.array([2.0, 1.0]), MAP_PRIOR.sigma)
    matches = []
    for b, middle in enumerate(middles[:4]):
        for k in near(poses, middle):
            root = rng.normal(0, 2, (int(rng.integers(1, 4)), 3))
            matches.append(match(k, b, seen_from(poses[k], middle, rng.normal(0, 0.1, 3)), root.T @ root))
    found = solve_buildings(middles, matches, poses, map_prior)
    assert found.inliers.all()
    rows, values = [], []
    for m in matches:
        turn = np.eye(3)
        turn[:2, :2] = se2.rotation(poses[m.keyframe][2])
        values_, axes = np.linalg.eigh(turn @ m.information @ turn.T)
        root = np.sqrt(np.maximum(values_, 0))[:, None] * axes.T
        row = np.zeros((3, 17))
        row[:, 3 * m.building : 3 * m.building + 3] = root
        rows.append(row)
        values.append(root @ m.displacement(poses[m.keyframe], middles[m.building]))
    for b in range(5):
        row = np.zeros((3, 17))
        row[:, 3 * b : 3 * b + 3] = np.diag(1 / map_prior.sigma)
        row[:2, 15:] = -np.diag(1 / map_prior.sigma[:2])
        rows.append(row)
        values.append(np.zeros(3))
    row = np.zeros((2, 17))
    row[:, 15:] = np.diag(1 / map_prior.shift_sigma)
    rows.append(row)
    values.append(map_prior.shift / map_prior.shift_sigma)
    A = np.concatenate(rows)
    answer = np.linalg.lstsq(A, np.concatenate(values), rcond=None)[0]
    counts = np.bincount([m.building for m in matches])
    shared = np.repeat([counts[m.building] ** -0.5 for m in matches] + [1.0] * 6, [3] * (len(matches) + 5) + [2])
    covariance = np.linalg.inv((shared[:, None] * A).T @ (shared[:, None] * A))
    np.testing.assert_allclose(found.displacements.ravel(), answer[:15], atol=1e-9)
    np.testing.assert_allclose(found.shift, answer[15:], atol=1e-9)
    for b in range(5):
        np.testing.assert_allclose(found.covariances[b], covariance[3 * b : 3 * b + 3, 3 * b : 3 * b + 3], atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_buildings_seen_from_two_sides_end_where_they_are(seed: int) -> None:
    rng = np.random.default_rng(seed)
    middles, poses, truth = town(seed)
    matches = []
    for b, middle in enumerate(middles):
        for k in near(poses, middle):
            matches.append(match(k, b, seen_from(poses[k], middle, truth[b] + rng.normal(0, [0.1, 0.1, 0.01]))))
    found = solve_buildings(middles, matches, poses, MAP_PRIOR)
    away = found.displacements - truth
    assert np.linalg.norm(away[:, :2], axis=1).max() < 0.25
    assert np.abs(away[:, 2]).max() < np.radians(1.2)
    assert np.linalg.norm(found.shift - truth[:, :2].mean(axis=0)) < 0.25
    nees = np.array([a @ np.linalg.solve(c, a) for a, c in zip(away, found.covariances, strict=True)])
    assert nees.max() < 6


def test_a_lone_wall_moves_its_building_across_and_not_along() -> None:
    middles, poses, truth = town(1)
    n = np.array([np.sin(0.4), np.cos(0.4)])
    matches = [
        match(k, 5, seen_from(poses[k], middles[5], truth[5]), across(n, poses[k])) for k in near(poses, middles[5])
    ]
    sure = MapPrior(np.array([1.0, -2.0]), np.full(2, 1e-4), MAP_PRIOR.sigma)
    found = solve_buildings(middles, matches, poses, sure)
    along = np.array([n[1], -n[0]])
    assert found.displacements[5, :2] @ n == pytest.approx(truth[5, :2] @ n, abs=0.12)
    assert found.displacements[5, :2] @ along == pytest.approx(sure.shift @ along, abs=1e-3)
    spread = found.covariances[5, :2, :2]
    assert along @ spread @ along == pytest.approx(1.0, rel=0.01)
    assert n @ spread @ n < 0.1
    np.testing.assert_allclose(found.displacements[0], [1.0, -2.0, 0.0], atol=1e-3)


def test_unseen_buildings_take_the_common_shift() -> None:
    middles, poses, _ = town(2)
    shift = np.array([2.0, -1.0, 0.0])
    matches = [match(k, b, seen_from(poses[k], middles[b], shift)) for b in range(11) for k in near(poses, middles[b])]
    found = solve_buildings(middles, matches, poses, MAP_PRIOR)
    np.testing.assert_allclose(found.displacements[11], shift, atol=0.05)
    assert found.covariances[11, 0, 0] > 1.0
    empty = solve_buildings(middles, [], poses, MAP_PRIOR)
    np.testing.assert_array_equal(empty.displacements, np.zeros((12, 3)))
    assert empty.covariances[0, 0, 0] == pytest.approx(10.0)


def test_matches_with_the_wrong_wall_are_rejected() -> None:
    middles, poses, truth = town(3)
    good = [match(k, b, seen_from(poses[k], middles[b], truth[b])) for b in range(12) for k in near(poses, middles[b])]
    wrong = [match(k, b, seen_from(poses[k], middles[b], truth[b] + [3.0, -2.0, 0.2])) for b in range(12)
             for k in near(poses, middles[b])[:1]]  # fmt: skip
    found = solve_buildings(middles, good + wrong, poses, MAP_PRIOR)
    assert found.inliers[: len(good)].all()
    assert not found.inliers[len(good) :].any()
    expected: BuildingSolution = solve_buildings(middles, good, poses, MAP_PRIOR)
    np.testing.assert_allclose(found.displacements, expected.displacements, atol=1e-9)


@pytest.mark.parametrize("metres", [2.5, 6.0])
@pytest.mark.parametrize("seed", range(4))
def test_two_agreeing_wrong_matches_of_five_are_rejected(seed: int, metres: float) -> None:
    """They pull the first solution so far that right ones do not fit it: nothing may be decided there.

    Nor at the second, when they are far off: decided is what counts in full or not at all.
    """
    rng = np.random.default_rng(seed)
    middles, poses, truth = town(seed)
    wrong = rng.normal(0, 1, 2)
    matches, is_wrong = [], []
    for b, middle in enumerate(middles):
        for n, k in enumerate(near(poses, middle, 40.0)[:5]):
            is_wrong.append(n < 2)
            off = np.array([*metres * wrong / np.linalg.norm(wrong), 0.1]) * (n < 2)
            matches.append(match(k, b, seen_from(poses[k], middle, truth[b] + off)))
    found = solve_buildings(middles, matches, poses, MAP_PRIOR)
    assert found.inliers.tolist() == [not w for w in is_wrong]
    right = solve_buildings(middles, [m for m, w in zip(matches, is_wrong, strict=True) if not w], poses, MAP_PRIOR)
    np.testing.assert_allclose(found.displacements, right.displacements, atol=1e-9)


@pytest.mark.parametrize(("share", "knows"), [(0.04, False), (0.06, True)])
def test_a_match_with_a_twentieth_of_the_information_may_support(share: float, knows: bool) -> None:
    middles, poses, truth = town(4)
    keyframes = near(poses, middles[5], 40.0)[:3]
    said = [seen_from(poses[k], middles[5], truth[5]) for k in keyframes]
    three = [
        match(k, 5, pose, FULL * (share if n else 1.0)) for n, (k, pose) in enumerate(zip(keyframes, said, strict=True))
    ]
    assert agreeing(middles, three, poses)[0] == knows


def test_a_match_that_no_other_supports_is_rejected() -> None:
    middles, poses, truth = town(4)
    keyframes = near(poses, middles[5], 40.0)
    n = np.array([0.0, 1.0])
    lone = np.array([3.0, 0.0, 0.0])
    walls = [match(k, 5, seen_from(poses[k], middles[5], truth[5]), across(n, poses[k])) for k in keyframes[1:]]
    along = match(keyframes[0], 5, seen_from(poses[keyframes[0]], middles[5], truth[5] + lone))
    other = [match(k, 4, seen_from(poses[k], middles[4], truth[4] + lone)) for k in keyframes[:SUPPORT]]
    assert agreeing(middles, [*walls, along, *other], poses).tolist() == [True] * len(walls) + [False] * (1 + SUPPORT)
    corners = [match(k, 5, seen_from(poses[k], middles[5], truth[5])) for k in keyframes[: SUPPORT + 1]]
    assert agreeing(middles, [*walls, *corners], poses).all()
    assert not agreeing(middles, corners[:SUPPORT], poses).any()
    # Walls that lie as they should say nothing for what it claims along them.
    assert agreeing(middles, [*walls, corners[0]], poses).tolist() == [True] * len(walls) + [False]
    assert agreeing(middles, [], poses).shape == (0,)
