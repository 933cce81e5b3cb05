"""Rings out of parts, and footprints out of rings."""

from __future__ import annotations

import itertools

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from osm_builders import square_at

from lslam.io.formats.osm_buildings import footprints_from_rings, join_rings


@given(st.permutations(range(8)), st.lists(st.booleans(), min_size=8, max_size=8), st.integers(1, 7))
@settings(max_examples=80)
def test_rings_join_from_any_parts_in_any_order(order: list[int], flips: list[bool], cut: int) -> None:
    """Two octagons' edges, cut to parts, shuffled and turned round, give two rings of the same edges."""
    first = [tuple(range(cut + 1)), (*range(cut, 8), 0)]
    edges = [(10 + k, 10 + (k + 1) % 6) for k in range(6)]
    parts = [*first, *edges]
    shuffled = [parts[k][::-1] if flips[k] else parts[k] for k in order]
    rings = join_rings(shuffled)
    assert rings is not None
    assert sorted(len(ring) for ring in rings) == [7, 9]
    pairs = {frozenset(pair) for ring in rings for pair in itertools.pairwise(ring)}
    assert pairs == {frozenset(p) for part in parts for p in itertools.pairwise(part)}
    assert join_rings(shuffled[1:]) is None


def test_rings_without_area_leave_nothing() -> None:
    assert footprints_from_rings([np.zeros((0, 2)), np.ones((4, 2)), np.array([[0, 0], [1, 1], [2, 2.0]])], []) == ()
    assert footprints_from_rings([square_at(0, 0, 2)], [square_at(-1, -1, 5)]) == ()


def test_rings_that_touch_in_a_node_keep_their_areas() -> None:
    """A figure of eight in four parts: whichever way the parts are joined, both squares are there once."""
    corners = {0: (0, 0), 1: (10, 0), 2: (10, 10), 3: (0, 10), 4: (20, 10), 5: (20, 20), 6: (10, 20)}
    parts = [(2, 3), (3, 0, 1), (1, 2), (2, 4, 5), (6, 5), (2, 6)]
    for order in itertools.permutations(parts):
        rings = join_rings(order)
        assert rings is not None
        found = footprints_from_rings([np.array([corners[n] for n in ring[:-1]], float) for ring in rings], [])
        assert sorted(f.area for f in found) == [100, 100]
