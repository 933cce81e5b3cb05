"""Colours of map points: walls of known colours, what hides them, what passes before them, and exposures."""

from __future__ import annotations

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.geometry import se3
from lslam.core.types.camera import Image, Lens
from lslam.core.types.cloud import ArrayCloud
from lslam.maps.colour import GREY, VIEWS, ColouredCloud, MapColourer, image_gains

LENS = Lens("pinhole", (200, 160), (120.0, 120.0, 99.5, 79.5))
SPACING = 0.2
RED, BLUE, GREEN = (200, 40, 40), (40, 60, 200), (60, 190, 70)
# The camera looks along x of the world, its x is -y, its y is -z.
LOOKS_AHEAD = se3.make(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))


def wall(x: float, y: tuple[float, float], z: tuple[float, float]) -> Floats:
    ys, zs = np.meshgrid(np.arange(*y, SPACING), np.arange(*z, SPACING))
    return np.column_stack([np.full(ys.size, x), ys.ravel(), zs.ravel()])


def floor(x: tuple[float, float], y: tuple[float, float], z: float) -> Floats:
    xs, ys = np.meshgrid(np.arange(*x, SPACING), np.arange(*y, SPACING))
    return np.column_stack([xs.ravel(), ys.ravel(), np.full(xs.size, z)])


def plain(colour: tuple[int, int, int], gain: float = 1.0) -> Image:
    return np.broadcast_to(np.rint(gain * np.array(colour)).astype(np.uint8), (160, 200, 3)).copy()


def at(x: float, y: float = 0.0, z: float = 0.0) -> Floats:
    T = LOOKS_AHEAD.copy()
    T[:3, 3] = x, y, z
    return T


def coloured(points: Floats, views: list[tuple[Image, Floats]]) -> tuple[ColouredCloud, MapColourer]:
    colourer = MapColourer(ArrayCloud.of(points), SPACING, 50.0)
    for image, T in views:
        colourer.add(image, LENS, T)
    return colourer.result(), colourer


def test_a_wall_in_front_has_the_colours_of_its_pixels_and_hides_the_one_behind() -> None:
    near, far = wall(8, (-2, 2), (-2, 2)), wall(12, (-6, 6), (-3, 3))
    image = plain(BLUE)
    half = 120 * 2.1 / 8  # the near wall in pixels, and half a splat about it
    image[int(79.5 - half) : int(81.5 + half), int(99.5 - half) : int(101.5 + half)] = RED
    cloud, colourer = coloured(np.concatenate([near, far]), [(image, at(0))])
    assert (cloud.colours[: len(near)] == RED).all()
    behind = cloud.colours[len(near) :]
    shadow = (np.abs(far[:, 1]) < 2 * 12 / 8) & (np.abs(far[:, 2]) < 2 * 12 / 8)
    assert (behind[shadow] == GREY).all()
    beside = np.abs(far[:, 1]) > 2.2 * 12 / 8 + SPACING
    assert (behind[beside] == BLUE).all()
    assert colourer.unseen == int((cloud.colours == GREY).all(1).sum())


def test_a_floor_that_runs_away_from_the_camera_does_not_hide_itself() -> None:
    points = floor((4, 12), (-1, 1), -1.5)
    cloud, _ = coloured(points, [(plain(GREEN), at(0))])
    covers = SPACING**2 * 120**2 * 1.5 / np.linalg.norm(points, axis=1) ** 3 >= 1
    shown = (cloud.colours == GREEN).all(1)
    assert covers.sum() > 100
    assert shown[covers].all()
    assert not shown[~covers].any()


def test_what_lies_beyond_reach_or_behind_the_camera_stays_grey() -> None:
    points = np.concatenate([wall(8, (-1, 1), (-1, 1)), wall(-8, (-1, 1), (-1, 1))])
    colourer = MapColourer(ArrayCloud.of(points), SPACING, 7.0)
    assert colourer.add(plain(RED), LENS, at(0)) == 0
    assert colourer.add(plain(RED), LENS, at(2)) == 100
    cloud = colourer.result()
    assert (cloud.colours[100:] == GREY).all()
    assert colourer.unseen == 100


def test_what_passes_before_a_part_of_a_wall_is_outvoted() -> None:
    points = wall(8, (-2, 2), (-1, 1))
    views = []
    for k in range(12):
        image = plain(BLUE)
        if k in (0, 4, 5):
            image[:, :85] = RED
        views.append((image, at(0.05 * k)))
    cloud, colourer = coloured(points, views)
    red = (np.asarray(colourer._colours) == RED).all(2)
    # Seven of the twelve are drawn, of which three at most are red.
    assert red.any(1).sum() > 30
    assert (np.abs(cloud.colours.astype(int) - BLUE) <= 2).all()


def test_further_points_in_the_way_hide_the_map() -> None:
    points, car = wall(8, (-2, 2), (-1, 1)), wall(5, (-3, 3), (-2, 2))
    colourer = MapColourer(ArrayCloud.of(points), SPACING, 50.0)
    assert colourer.add(plain(RED), LENS, at(0), [car]) == 0
    assert colourer.add(plain(BLUE), LENS, at(0)) == len(points)
    assert (colourer.result().colours == BLUE).all()


def test_what_has_driven_off_is_not_coloured_by_what_stands_behind_and_hides_it_no_more() -> None:
    """The map has a car that only the first image shows; scans about the others see the wall through it."""
    car, points = wall(5, (-1, 1), (-1, 1)), wall(8, (-3, 3), (-2, 2))
    colourer = MapColourer(ArrayCloud.of(np.concatenate([car, points])), SPACING, 50.0)
    with_car = plain(BLUE)
    half = 120 * 1.1 / 5
    with_car[int(79.5 - half) : int(81.5 + half), int(99.5 - half) : int(101.5 + half)] = RED
    colourer.add(with_car, LENS, at(0), [np.concatenate([car, points])])
    for k in range(1, 4):
        shown = colourer.add(plain(BLUE), LENS, at(0.02 * k), [points])
        assert shown == len(points)
    colours = colourer.result().colours
    assert (colours[: len(car)] == RED).all()
    assert (np.abs(colours[len(car) :].astype(int) - BLUE) <= 2).all()


def test_views_are_drawn_by_their_solid_angle_whatever_their_order() -> None:
    points = wall(20, (-2, 2), (-2, 2))
    near, far = (plain(RED), at(14)), (plain(BLUE), at(2))
    colourer = MapColourer(ArrayCloud.of(points), SPACING, 50.0)
    for k in range(40):
        image, T = near if k % 2 else far
        colourer.add(image, LENS, T)
    kept = np.asarray(colourer._colours)
    is_near = (kept == RED).all(2)
    # Solid angles are as 6^-2 to 18^-2, nine to one: of seven drawn without replacement from twenty each, some six.
    assert is_near.mean() > 0.75
    assert (np.asarray(colourer._ranks) > 0).sum(1).tolist() == [VIEWS] * len(points)


def test_exposures_are_brought_together() -> None:
    points = wall(8, (-2, 2), (-1, 1))
    gains = np.array([0.7, 1.0, 1.3, 0.9, 1.1])
    cloud, _ = coloured(points, [(plain(GREEN, gain), at(0.1 * k)) for k, gain in enumerate(gains)])
    level = float(np.exp(np.log(gains).mean()))
    assert (np.abs(cloud.colours.astype(float) - level * np.array(GREEN)) <= 3).all()


def test_gains_are_found_though_a_third_of_the_views_show_something_else() -> None:
    rng = np.random.default_rng(0)
    true = np.exp(0.2 * rng.standard_normal(30))
    albedo = rng.uniform(40, 150, (2000, 3))
    views = np.stack([rng.choice(30, 5, replace=False) for _ in range(2000)]).astype(np.int32)
    values = albedo[:, None] * true[views][..., None] + rng.normal(0, 1, (2000, 5, 3))
    wrong = rng.random((2000, 5)) < 0.3
    values[wrong] = rng.uniform(5, 250, (int(wrong.sum()), 3))
    found = image_gains(views, np.clip(np.rint(values), 0, 255).astype(np.uint8), np.ones((2000, 5), bool), 30)
    ratio = found / true[:, None]
    assert (np.abs(ratio / ratio.mean(0) - 1) < 0.01).all()


def test_a_map_without_points_and_one_without_images_are_as_they_are() -> None:
    empty = MapColourer(ArrayCloud.of(np.zeros((0, 3))), SPACING, 50.0)
    assert empty.add(plain(RED), LENS, at(0)) == 0
    assert len(empty.result()) == 0
    alone = MapColourer(ArrayCloud.of(wall(8, (-1, 1), (-1, 1))), SPACING, 50.0)
    assert (alone.result().colours == GREY).all()
    assert alone.unseen == 100


def test_the_same_images_give_the_same_bytes() -> None:
    rng = np.random.default_rng(1)
    points = np.concatenate([wall(8, (-2, 2), (-1, 1)), floor((3, 8), (-2, 2), -1)])
    views = [(rng.integers(1, 255, (160, 200, 3)).astype(np.uint8), at(0.05 * k)) for k in range(10)]
    once, again = (coloured(points, views)[0].colours.tobytes() for _ in range(2))
    assert once == again
