"""Heights and bases from tags as people write them."""

from __future__ import annotations

import pytest

from lslam.io.formats.osm_buildings import base_of, height_of


@pytest.mark.parametrize(
    ("tags", "height"),
    [
        ({"height": "12"}, 12.0),
        ({"height": "12.5 m"}, 12.5),
        ({"height": "7,5"}, 7.5),
        ({"height": "40 ft"}, 12.192),
        ({"height": "40'6\""}, 12.3444),
        ({"height": "10", "building:levels": "9"}, 10.0),
        ({"building:levels": "4"}, 12.0),
        ({"building:levels": "2.5"}, 7.5),
        ({"height": "high", "building:levels": "2"}, 6.0),
        ({"height": "tall"}, None),
        ({"height": "0"}, None),
        ({"height": "-3"}, None),
        ({"height": "99999"}, None),
        ({"height": "12 storeys"}, None),
        ({"height": '10"'}, None),
        ({"building:levels": "2;3"}, None),
        ({"building:levels": "0"}, None),
        ({}, None),
    ],
)
def test_heights(tags: dict[str, str], height: float | None) -> None:
    assert height_of(tags) == (None if height is None else pytest.approx(height))


@pytest.mark.parametrize(
    ("tags", "base"),
    [
        ({"min_height": "4.5"}, 4.5),
        ({"building:min_level": "1", "building:levels": "3"}, 3.0),
        ({"building:min_level": "3", "building:levels": "3"}, 0.0),
        ({"min_height": "some"}, 0.0),
        ({"building:min_level": "-1"}, 0.0),
        ({}, 0.0),
    ],
)
def test_bases(tags: dict[str, str], base: float) -> None:
    assert base_of(tags) == base
