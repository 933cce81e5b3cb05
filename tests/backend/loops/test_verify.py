"""Verification: known transforms are found over large offsets, and other places are rejected."""

from __future__ import annotations

import numpy as np
import pytest
from known_town import NOISE, box, pose, seen, terrace, town
from numpy.typing import NDArray

from lslam.backend.loops import verify
from lslam.backend.loops.level_submap import LevelSubmap, VisibleCells, make_level_submap
from lslam.backend.loops.verify import (
    LARGE,
    NARROWEST,
    SHARED_SHARE,
    WIDEST,
    SubmapRegistration,
    Verification,
    Verifier,
    _grid,
    find_initial_guesses,
)
from lslam.core.config.backend import LoopsConfig
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.geometry import se3, so3
from lslam.registration.alignment import solve
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.preprocessing.prepare import PreparedPoints
from lslam.registration.result import RegistrationResult

Floats = NDArray[np.float64]
YAWS = np.deg2rad(np.arange(-10, 11, 2.0))


def place(world: Floats, at: Floats, seed: int, reach: float = 40.0) -> LevelSubmap:
    """What is seen from a pose, in level axes with the heading kept: the yaw is what registration has to find."""
    return make_level_submap(seen(world, at, np.random.default_rng(seed), reach), RegistrationConfig())


def compare(a: LevelSubmap, b: LevelSubmap, expected: Floats, reach: float, **settings: float) -> Verification:
    config = LoopsConfig.model_validate(settings)
    return Verifier(config, RegistrationConfig()).verify(a, b, expected, reach, YAWS)


@pytest.mark.parametrize(("dx", "dy", "yaw_deg", "climb"), [(0, 0, 0, 0), (5, -3, 7, 0.5), (-8, 2, -9, -1.5)])
def test_finds_a_known_transform_from_afar(dx: float, dy: float, yaw_deg: float, climb: float) -> None:
    world = town()
    T_a, T_b = pose(5, -45), pose(5 + dx, -45 + dy, yaw_deg)
    T_b[2, 3] += climb
    found = compare(place(world, T_a, 1), place(world, T_b, 2), np.zeros(3), 12.0)
    assert found.reason == ""
    assert found.T_a_b is not None
    assert found.covariance is not None
    error = se3.log(found.T_a_b @ se3.inverse(se3.relative(T_a, T_b)))
    assert np.linalg.norm(error[:3]) < 0.03
    assert np.rad2deg(np.linalg.norm(error[3:])) < 0.05
    assert error @ np.linalg.solve(found.covariance, error) / 6 < 4
    assert found.rmse < 0.1
    assert found.overlap > 0.5


def test_refuses_another_place() -> None:
    found = compare(place(town(0), pose(0, -45), 1), place(town(7), pose(0, -45), 2), np.zeros(3), 8.0)
    assert found.reason
    assert found.stage in ("overlap", "registration", "ambiguity", "agreement")


def test_refuses_what_hardly_overlaps() -> None:
    world = town()
    a, b = place(world, pose(-25, -45), 1, reach=25), place(world, pose(10, -45), 2, reach=25)
    found = compare(a, b, np.array([35.0, 0.0, 0.0]), 3.0)
    assert found.stage == "overlap"
    assert found.reason


def test_a_terrace_is_ambiguous_unless_odometry_resolves_it() -> None:
    world = terrace()
    T_a, T_b = pose(70, 0), pose(73, 0.5)
    a, b = place(world, T_a, 1), place(world, T_b, 2)
    lost = compare(a, b, np.zeros(3), 25.0)
    assert lost.stage == "ambiguity"
    assert lost.reason
    sure = compare(a, b, np.array([3.5, 0.0, 0.0]), 5.0)
    assert sure.reason == ""
    assert sure.T_a_b is not None
    assert np.linalg.norm(sure.T_a_b[:3, 3] - [3, 0.5, 0]) < 0.03


def test_a_corridor_without_features_along_it_is_rejected() -> None:
    x, up = np.arange(-60, 60, 0.2), np.arange(0, 3, 0.2)
    line = np.stack(np.meshgrid(x, up), axis=-1).reshape(-1, 2)
    walls = [np.column_stack([line[:, 0], np.full(len(line), y), line[:, 1]]) for y in (-3.0, 3.0)]
    ground = np.stack(np.meshgrid(x, np.arange(-3, 3, 0.2)), axis=-1).reshape(-1, 2)
    world = np.concatenate([*walls, np.column_stack([ground, np.zeros(len(ground))])])
    found = compare(place(world, pose(0, 0), 1), place(world, pose(4, 0), 2), np.array([3.0, 0, 0]), 6.0)
    assert found.reason
    assert found.stage in ("registration", "ambiguity", "agreement")


@pytest.mark.parametrize("points", [0, 3, 200])
def test_survives_places_without_surfaces(points: int) -> None:
    world = town()
    few = make_level_submap(
        np.random.default_rng(0).normal(0, 10, (points, 3)).astype(np.float32), RegistrationConfig()
    )
    whole = place(world, pose(0, -45), 1)
    for a, b in ((few, whole), (whole, few), (few, few)):
        assert compare(a, b, np.zeros(3), 5.0).reason


def test_starts_are_tried_with_a_quarter_of_the_points_and_the_best_refined_with_all(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Counted, since it is work that is saved: a registration of few points tells which start leads anywhere."""
    a, b = (place(town(), pose(x, -45), x) for x in (5, 7))
    used: list[int] = []

    def counting(
        levels: tuple[GaussianMap, ...], points: PreparedPoints, *given: object, **named: object
    ) -> RegistrationResult:
        used.append(len(points.source))
        return solve(levels, points, *given, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(verify, "solve", counting)
    assert compare(a, b, np.zeros(3), 5.0).reason == ""
    whole = {len(p.source.source) for p in (a, b)} | {len(b.upright.source)}
    few = [n for n in used if n not in whole]
    assert len(few) >= 2
    assert len(few) % 2 == 0
    assert np.array(few) / len(b.source.source) == pytest.approx(0.25, abs=0.01)
    assert used.count(len(b.source.source)) >= 2


def test_overlap_is_that_of_the_place_that_is_covered_less() -> None:
    """All of what is seen within 22 m lies in what is seen within 50 m; the other way round less than half does."""
    near, far = (place(town(), pose(5, -45), seed, reach) for seed, reach in ((1, 22.0), (2, 50.0)))
    for a, b in ((near, far), (far, near)):
        found = compare(a, b, np.zeros(3), 3.0, min_overlap=0.01)
        assert found.reason == ""
        assert 0.1 < found.overlap < 0.6
        assert compare(a, b, np.zeros(3), 3.0, min_overlap=0.7).stage == "overlap"


def test_gates_on_rmse_overlap_and_disagreement_apply() -> None:
    world = town()
    a, b = place(world, pose(5, -45), 1), place(world, pose(7, -45), 2)
    assert compare(a, b, np.zeros(3), 5.0, max_rmse=0.001).stage == "registration"
    assert compare(a, b, np.zeros(3), 5.0, min_overlap=0.999).stage == "overlap"
    assert compare(a, b, np.zeros(3), 5.0, max_disagreement_m=1e-6).stage == "agreement"


def test_bev_correlation_finds_shift_heading_and_climb() -> None:
    world = town()
    T_a, T_b = pose(5, -45), pose(11, -48, 8)
    T_b[2, 3] += 4.0
    a, b = place(world, T_a, 1), place(world, T_b, 2)
    start = find_initial_guesses(a, b, np.zeros(3), 12.0, YAWS)[0].T_a_b
    assert np.linalg.norm(start[:2, 3] - [6, -3]) < 1.5
    assert abs(start[2, 3] - 4.0) < 0.3
    assert np.rad2deg(np.arctan2(start[1, 0], start[0, 0])) == pytest.approx(8, abs=2.1)
    near = find_initial_guesses(a, b, np.zeros(3), 3.0, YAWS)
    assert all(np.linalg.norm(found.T_a_b[:2, 3]) <= 3.0 for found in near)


def test_starts_lie_four_metres_apart_fit_seven_tenths_as_well_and_are_five(monkeypatch: pytest.MonkeyPatch) -> None:
    limits: list[tuple[float, ...]] = []

    def peaks(shifts: Floats, score: Floats, *given: float) -> list[int]:
        limits.append((len(shifts), *given))
        return []

    monkeypatch.setattr(verify, "peaks", peaks)
    world = town()
    a, b = place(world, pose(5, -45), 1), place(world, pose(11, -48, 8), 2)
    assert find_initial_guesses(a, b, np.array([2.5, 0.0, 0.0]), 2.0, YAWS) == []
    # Cells within two metres of a place in the middle between two.
    assert limits == [(12, 4.0, 5, 0.7)]


def test_a_grid_has_room_for_the_window_at_every_shift_where_it_can() -> None:
    for far in (0.0, 23.9, 24.1, 30.0, 67.0, 200.0):
        half = _grid(far).size / 2
        assert half <= LARGE.size / 2
        assert half >= min(far + (NARROWEST if far <= 24.0 else WIDEST + 1), LARGE.size / 2)
    assert [_grid(far).size for far in (1.0, 36.0, 90.0)] == [128, 200, 256]


def test_a_submap_has_its_vertical_surfaces() -> None:
    flat = np.mgrid[-20:20:0.3, -20:20:0.3].reshape(2, -1).T
    world = np.concatenate([box(5, 5, 8, 8, 6), np.column_stack([flat, np.zeros(len(flat))])])
    at = pose(0, 0)
    made = place(world, at, 1)
    assert np.abs(made.ground[:, 2] + at[2, 3]).max() < 0.1
    upright = se3.apply(at, made.upright.source)
    assert (np.abs(upright[:, :2] - 9).max(axis=1) < 5).mean() > 0.8
    assert (upright[:, 2] > 5).any()
    # Across a wall the scatter of a voxel is the noise of a point.
    thinnest = np.sqrt(made.upright.scatter[:, [0, 3]].min(axis=1))
    assert np.median(thinnest) == pytest.approx(NOISE, rel=0.5)


@pytest.mark.parametrize(("degrees", "stands"), [(23.0, False), (27.0, True)])
def test_a_slope_of_twenty_five_degrees_is_the_steepest_ground(degrees: float, stands: bool) -> None:
    """Seen across and along it: roofs and ramps below that fit wherever one is."""
    flat = np.mgrid[-15:15:0.1, -15:15:0.1].reshape(2, -1).T
    for axis in ([1.0, 0.0, 0.0], [0.6, -0.8, 0.0]):
        plane = np.column_stack([flat, np.zeros(len(flat))]) @ so3.exp(np.deg2rad(degrees) * np.array(axis)).T
        made = make_level_submap(plane.astype(np.float32), RegistrationConfig())
        # Voxels that the plane hardly touches have no surface, and stand.
        share = len(made.non_ground) / (len(made.non_ground) + len(made.ground))
        assert share == 1.0 if stands else share < 0.4


@pytest.mark.parametrize(("metres", "support"), [(0.28, 1.0), (0.32, 0.0)])
def test_vertical_surfaces_support_a_start_within_two_kernels(metres: float, support: float) -> None:
    """A kernel ends 0.15 m wide: a wall that registration left 30 cm beside the other is not the same."""
    along, up = np.mgrid[-12:12:0.1, 0:6:0.1].reshape(2, -1)
    wall = np.column_stack([along, np.full_like(along, 8.05), up]).astype(np.float32)
    a, b = (make_level_submap(wall, RegistrationConfig()) for _ in range(2))
    cells = VisibleCells(LARGE, LARGE.view(a.non_ground, a.ground)[2].ravel() > 0, SHARED_SHARE)
    T = se3.make(np.eye(3), np.array([0.0, metres, 0.0]))
    found = SubmapRegistration(a, LoopsConfig(), RegistrationConfig()).support(b, T, cells)
    assert found == pytest.approx(support, abs=0.05)


@pytest.mark.parametrize(("metres", "support"), [(7.0, 1.0), (3.0, 0.0)])
def test_a_start_is_supported_when_a_quarter_of_its_vertical_surfaces_was_seen(metres: float, support: float) -> None:
    """Of a wall of 24 m the other place saw so many, and as far as the next cell: all that can be compared fits."""
    along, up = np.mgrid[-12:12:0.1, 0:6:0.1].reshape(2, -1)
    wall = np.column_stack([along, np.full_like(along, 8.05), up]).astype(np.float32)
    a, b = (make_level_submap(part, RegistrationConfig()) for part in (wall[along < metres - 12], wall))
    cells = VisibleCells(LARGE, LARGE.view(a.non_ground, a.ground)[2].ravel() > 0, SHARED_SHARE)
    found = SubmapRegistration(a, LoopsConfig(), RegistrationConfig()).support(b, np.eye(4), cells)
    assert found == pytest.approx(support, abs=0.2)
