"""Final poses: what fixes, control points and the map say of each other."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from lslam.backend.fixes import Fixes
from lslam.backend.optimise import fixes_against_points, redundancy, thickening, thicker_map
from lslam.core.geometry import geodesy
from lslam.core.types.constraint import ControlPoint, Instant
from lslam.core.types.gnss import Georeference

ORIGIN = np.array([49.0, 8.4, 115.0])
POINTS = [ControlPoint(Instant("line 2", scan=0), np.zeros(3), np.full(3, 0.05), 25832)] * 3


def fixes(off: np.ndarray, noise: float, seed: int) -> Fixes:
    """Of an antenna on a line, `off` (3,) m from where the run is."""
    rng = np.random.default_rng(seed)
    antenna = np.column_stack([np.arange(60.0), np.zeros(60), np.zeros(60)])
    origin = ORIGIN + np.array([1e-4, 1e-4, 3.0])
    places = geodesy.from_local(antenna + off + noise * rng.normal(size=(60, 3)), ORIGIN)
    sigmas = np.full((60, 3), noise)
    stamps = np.arange(60) * 10**9
    return Fixes(stamps, geodesy.to_local(places, origin), sigmas, antenna, np.zeros(60), origin, 60, True)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    ("off", "said"),
    [
        ([0.0, 0.0, 0.0], ""),
        ([1.0, 0.0, -1.0], ""),
        ([0.0, 0.0, 48.0], r"4[78]\.\d m above"),
        ([0.0, 0.0, -48.0], r"4[78]\.\d m below"),
        ([9.0, 12.0, 0.0], r"1[45]\.\d m aside"),
    ],
)
def test_fixes_that_disagree_with_control_points_are_said(off: list[float], said: str, seed: int) -> None:
    import re

    sentence = fixes_against_points(fixes(np.array(off), 0.8, seed), POINTS, Georeference(ORIGIN, np.eye(4)))
    assert bool(sentence) == bool(said)
    assert re.search(said, sentence)
    assert ("aside" in sentence) == (off[0] == 9.0)


def test_two_points_have_no_redundancy() -> None:
    said, facts = redundancy(np.array([[0.0, 0, 0], [0, 0, 101]]), np.array([[5.0, 0, 0], [5, 100, 0]]), is_level=False)
    assert "no redundancy" in said
    assert "1.0100 times as far" in said
    assert facts == {"redundancy": 0, "scale_to_odometry": 1.01}
    assert redundancy(np.ones((2, 3)), np.zeros((2, 3)), is_level=False) == ("", {})


def test_heights_of_three_points_have_no_redundancy_unless_up_is_known() -> None:
    said, facts = redundancy(np.zeros((3, 3)), np.zeros((3, 3)), is_level=False)
    assert "the heights of three have no redundancy" in said
    assert facts == {"height_redundancy": 0}
    assert redundancy(np.zeros((3, 3)), np.zeros((3, 3)), is_level=True) == ("", {})
    assert redundancy(np.zeros((4, 3)), np.zeros((4, 3)), is_level=False) == ("", {})


class Walls:
    """Keyframes, a metre apart, that see two walls and the ground with 2 cm of noise."""

    def points(self, k: int) -> np.ndarray:
        rng = np.random.default_rng(k)
        u, v = rng.uniform(-6, 6, (2, 4000))
        walls = np.where(
            (rng.random(4000) < 0.5)[:, None], np.column_stack([u, 0 * u + 5, v]), np.column_stack([u, v, 0 * u - 1])
        )
        return np.asarray(walls + 0.02 * rng.normal(size=walls.shape) - [0.0, 0.5 * k, 0.0], np.float32)


def test_a_map_that_gets_thicker_contradicts_what_holds_the_poses() -> None:
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 1, 3] = 0.5 * np.arange(6)
    store: Any = Walls()
    bent = poses.copy()
    bent[:, 1, 3] *= 1.15
    said, facts = thicker_map(thickening(store, poses, bent), "control points", 0.999)
    assert said.startswith("control points: planes of the keyframes are ")
    assert "they contradict the scans" in said
    assert facts["planes_m"] > 1.3 * facts["planes_without_m"]
    # What moves the run as a whole, and what makes it crisper, is no contradiction.
    moved = poses.copy()
    moved[:, :3, 3] += [100.0, -20.0, 7.0]
    assert thicker_map(thickening(store, poses, moved), "GNSS", 0.999)[0] == ""
    assert thicker_map(thickening(store, bent, poses), "GNSS", 0.999)[0] == ""


def test_a_little_is_a_contradiction_where_it_is_more_than_chance() -> None:
    """Poses that run off by 8 mm a metre thicken planes by a twentieth; those that err by a millimetre by nothing."""
    poses = np.tile(np.eye(4), (16, 1, 1))
    poses[:, 1, 3] = 0.5 * np.arange(16)
    store: Any = Walls()
    bent, shaken = poses.copy(), poses.copy()
    bent[:, 1, 3] *= 1.008
    shaken[:, 1, 3] += 0.001 * np.random.default_rng(1).normal(size=16)
    change = thickening(store, poses, bent)
    assert change is not None
    assert 1.02 < change.after / change.before < 1.12
    assert change.is_clear(0.999)
    assert thicker_map(change, "control points", 0.999)[0].endswith("sigmas: they contradict the scans")
    for other in (shaken, poses):
        change = thickening(store, poses, other)
        assert change is not None
        assert not change.is_clear(0.999)


def test_without_neighbourhoods_nothing_is_said() -> None:
    store: Any = Walls()
    assert thickening(store, np.eye(4)[None], np.eye(4)[None]) is not None
    store.points = lambda k: np.zeros((3, 3), np.float32)
    assert thickening(store, np.eye(4)[None], np.eye(4)[None]) is None
    assert thicker_map(None, "GNSS", 0.999) == ("", {})
