"""Classes by geometry: of an analytic scene, and against the surfaces that simulated rays met."""

from __future__ import annotations

import numpy as np
import pytest
from point_truth import NAMES, confusion, scores
from wall_scenes import Floats, box_at, noisy, plain, upright

from lslam.core.labels import CLASSES
from lslam.osm.walls import ROUGHNESS_M, classify

# Least precision and recall on a clean street: what geometry can tell there.
BOUNDS = {"ground": (0.8, 0.95), "wall": (0.95, 0.75), "vegetation": (0.45, 0.8), "vehicle": (0.8, 0.65)}


def car_at(x: float, y: float) -> Floats:
    """The sides and the roof of a van of 4.4 x 1.8 x 1.7 m."""
    corners = box_at(x, y, 4.4, 1.8)
    sides = [upright(a, b, 0.1, 1.7) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)]
    u, v = np.meshgrid(np.arange(x, x + 4.4, 0.2), np.arange(y, y + 1.8, 0.2))
    return np.concatenate([*sides, np.column_stack([u.ravel(), v.ravel(), np.full(u.size, 1.7)])])


def scene() -> tuple[list[Floats], list[int]]:
    rng = np.random.default_rng(0)
    bush = np.column_stack([rng.uniform(-8, -5, 900), rng.uniform(4, 7, 900), rng.uniform(0.4, 2.0, 900)])
    post = np.column_stack([np.full(40, -12.0), np.full(40, -6.0), np.linspace(0.2, 2.4, 40)])
    facade = upright((-15, 12), (15, 12), 0.3, 8)
    parts = [plain(25, 0.5), facade, car_at(2, -5), bush, post]
    return parts, [CLASSES["other-ground"], CLASSES["building"], CLASSES["car"], CLASSES["vegetation"], CLASSES["pole"]]


@pytest.mark.parametrize("low", [0.0, -30.0])
def test_each_thing_of_a_street_is_what_it_is(low: float) -> None:
    """Also where panes mirror a few points far below the street."""
    parts, expected = scene()
    rng = np.random.default_rng(1)
    ghosts = np.column_stack([rng.uniform(14, 20, (30, 2)), np.full(30, low - 5.0)]) if low else np.zeros((0, 3))
    found = classify(noisy(np.concatenate([*parts, ghosts])))
    ends = np.cumsum([len(part) for part in parts])
    for k, (end, number) in enumerate(zip(ends, expected, strict=True)):
        of_part = found[end - len(parts[k]) : end]
        above = parts[k][:, 2] > ROUGHNESS_M + 0.1 if k else np.ones(len(parts[k]), np.bool_)
        assert np.mean(of_part[above] == number) > 0.8, k


def test_nothing_and_a_few_points_have_classes() -> None:
    assert len(classify(np.zeros((0, 3)))) == 0
    assert len(classify(np.ones((3, 3)))) == 3


def test_geometry_agrees_with_the_surfaces_that_rays_met() -> None:
    figures = scores(confusion("street", 3, "os1-64", 1))
    for name, (precision, recall) in BOUNDS.items():
        found = figures[NAMES.index(name)]
        assert found[0] > precision, (name, found)
        assert found[1] > recall, (name, found)
