"""Boxes on the Earth, the antimeridian and the poles included."""

from __future__ import annotations

import numpy as np
import pytest

from lslam.core.errors import UsageError
from lslam.core.geometry.geodesy import to_local
from lslam.osm.bounds import Bounds, around


@pytest.mark.parametrize("place", [(49.01, 8.42), (-17.7, 179.9995), (65.0, -180.0), (0.0, 0.0)])
def test_a_circle_lies_in_its_box_and_not_much_more(place: tuple[float, float]) -> None:
    box = around(np.array([place]), 120.0)
    ring = np.radians(np.arange(0, 360, 5))
    origin = np.array([*place, 0.0])
    corners = np.array([[box.south, box.west, 0.0], [box.north, box.east, 0.0]])
    low, high = to_local(corners, origin)[:, :2]
    assert (low <= -119.0).all()
    assert (high >= 119.0).all()
    assert (high - low < 245.0).all()
    step = 119 / 111_320
    circle = np.column_stack(
        [place[0] + step * np.sin(ring), place[1] + step * np.cos(ring) / np.cos(np.radians(place[0]))]
    )
    assert box.share_inside(circle, 2.0) == 1.0
    assert box.share_inside(np.array([[place[0], (place[1] + 1.0 + 180) % 360 - 180]]), 100.0) == 0.0


def test_a_box_over_the_antimeridian_holds_what_lies_on_both_sides() -> None:
    fiji = around(np.array([[-17.0, 179.999], [-17.0, -179.999]]), 100.0)
    assert fiji.west > 179.9
    assert fiji.east < -179.9
    assert fiji.area_km2 < 0.2
    assert fiji.holds(Bounds(-17.0005, 179.9995, -16.9995, -179.9995))
    assert not fiji.holds(Bounds(-17.0005, 179.9995, -16.9995, -179.99))
    assert not Bounds(-17.1, 179.0, -16.9, 179.2).holds(fiji)


@pytest.mark.parametrize(
    ("box", "sentence"),
    [
        ((49.1, 8.4, 49.0, 8.5), "is no box"),
        ((49.0, 8.4, 91.0, 8.5), "is no box"),
        ((49.0, 8.4, float("nan"), 8.5), "is no box"),
        ((49.0, 8.4, 49.1, 8.4), "without width"),
        ((48.0, 7.0, 50.0, 9.0), "covers 32.* km2, public servers are asked for at most 600"),
    ],
)
def test_other_boxes_are_refused(box: tuple[float, ...], sentence: str) -> None:
    with pytest.raises(UsageError, match=sentence):
        Bounds(*box)


def test_places_off_the_earth_are_refused() -> None:
    for place in ([95.0, 8.0], [49.0, 190.0], [np.nan, 8.0]):
        with pytest.raises(UsageError, match="a place is LAT,LON"):
            around(np.array([place]), 100.0)
    with pytest.raises(UsageError, match="makes no sense"):
        around(np.array([[49.0, 8.0]]), -1.0)
