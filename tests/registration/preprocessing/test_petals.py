"""Lines of a pattern that does not repeat: where they turn, which of their points are features, and which never are."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.config.input import PreprocessConfig
from lslam.core.errors import InputError
from lslam.core.types.scan import Scan
from lslam.registration.kernels import petals
from lslam.registration.preprocessing.features import extract_features
from lslam.registration.preprocessing.petals import petal_features, walk_lines
from lslam.simulation.lidar import trace
from lslam.simulation.lidar_models import LIDARS
from lslam.simulation.scene_mesh import MeshBuilder, RayScene, Surface

GATE = PreprocessConfig(range_min=0.5, range_max=200.0)
HALF = 10.0


@cache
def box(noise: float = 0.0, x: float = -8.0) -> Scan:
    """A room of 20 m as a Livox sees it from near its back wall: the four edges of the wall ahead are within the view."""
    model = replace(
        LIDARS["livox"], range_noise=noise, angle_noise_deg=0.0, range_10pct=1e6, dropout=0.0, range_step=1e-6
    )
    pose = np.eye(4)
    pose[0, 3] = x
    poses = np.repeat(pose[None], model.columns, axis=0)
    builder = MeshBuilder()
    builder.add_box([-HALF] * 3, [HALF] * 3, Surface.CAR)
    return trace(RayScene(builder.build()), model, poses, np.random.default_rng(0), index=3)


def from_corner(points: NDArray[np.float64], x: float = -8.0) -> NDArray[np.float64]:
    """Distance of each point from the nearest edge of the room: from the second nearest of its walls."""
    off = np.sort(np.abs(HALF - np.abs(points + np.array([x, 0.0, 0.0]))), axis=1)
    return np.asarray(off[:, 1])


def test_a_line_ends_where_it_turns_and_where_it_has_a_gap() -> None:
    off = np.radians(np.concatenate([np.arange(2, 30), np.arange(30, 4, -1), np.arange(4, 20), np.arange(28, 33)]))
    xyz = np.stack([np.cos(off), np.sin(off), np.zeros(len(off))], axis=1) * 7.0
    steps = np.append(np.linalg.norm(np.diff(xyz / 7.0, axis=0), axis=1), np.inf)
    starts = np.array([0, len(off)], np.int64)
    found = petals.cut_lines(xyz, steps, starts, np.radians(4.0), np.radians(2.0))
    assert found.tolist() == [0, 28, 54, 70, 75]
    # What wavers by less than a turn is one line.
    wavering = xyz[:20].copy()
    wavering[7] = xyz[6]
    steps = np.append(np.linalg.norm(np.diff(wavering / 7.0, axis=0), axis=1), np.inf)
    assert petals.cut_lines(wavering, steps, np.array([0, 20]), np.radians(4.0), np.radians(2.0)).tolist() == [0, 20]


def test_edges_lie_where_walls_meet_and_planes_do_not() -> None:
    for noise in (0.0, 0.02):
        scan = box(noise)
        found = petal_features(scan, gate=GATE)
        assert len(found.edges) > 50
        assert len(found.planes) > 300
        assert np.median(from_corner(found.edges.points)) < 0.15
        assert (from_corner(found.edges.points) < 0.5).mean() > 0.9
        assert (from_corner(found.planes.points) > 0.15).mean() > 0.97


def test_the_fringe_has_no_features() -> None:
    scan = box()
    found = petal_features(scan, gate=GATE)
    view = np.degrees(np.arctan2(np.hypot(scan.points[:, 1], scan.points[:, 2]), scan.points[:, 0]))
    assert view.max() > 35
    assert (view[found.labels != 0] < 33).all()
    assert (found.labels[view < 29] != 0).mean() > 0.5


def test_reflectivity_makes_edges_on_a_plane_and_strange_intensities_none() -> None:
    plain = replace(box(0.0, 0.0), intensity=None)
    assert len(petal_features(plain, gate=GATE).less_edges) == 0, "the wall ahead alone"
    stripes = np.where(np.floor(plain.points[:, 1]) % 4 < 2, 20.0, 60.0).astype(np.float32)
    found = petal_features(replace(plain, intensity=stripes), gate=GATE)
    assert len(found.edges) > 100
    off = np.abs((found.edges.points[:, 1] + 1) % 2 - 1)
    assert np.median(off) < 0.1
    assert off.max() < 0.3
    # Every seventh point is a cat's eye: it is left out, and its neighbours are no edges.
    bright = np.where(np.arange(len(plain)) % 7 == 0, 255.0, 20.0).astype(np.float32)
    glaring = petal_features(replace(plain, intensity=bright), gate=GATE)
    assert len(glaring.less_edges) == 0
    assert (glaring.labels[::7] == 0).all()
    assert (glaring.labels != 0).sum() > 0.5 * len(plain)


def test_the_order_of_the_file_does_not_matter_where_there_are_times() -> None:
    scan = box(0.02)
    mixed = scan.select(np.random.default_rng(1).permutation(len(scan)))
    one, other = petal_features(scan, gate=GATE), petal_features(mixed, gate=GATE)
    for kind in ("edges", "planes", "less_planes"):
        np.testing.assert_array_equal(getattr(one, kind).points, getattr(other, kind).points)
    with pytest.raises(InputError, match=r"in the order of firing .*--rings"):
        petal_features(replace(mixed, times=None), gate=GATE)


def test_a_spinning_sensors_lines_are_its_rings_and_a_livox_has_none_for_loam() -> None:
    azimuth = np.linspace(-np.pi, np.pi, 900, endpoint=False)
    beams = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(900)], axis=1)
    reach = np.min(np.array([9.0, 7.0]) / np.maximum(np.abs(beams[:, :2]), 1e-9), axis=1)
    ring = Scan((beams * reach[:, None]).astype(np.float32), 0, 0, rings=np.zeros(900, np.uint16))
    walk = walk_lines(ring, GATE)
    assert len(walk.starts) - 1 in (2, 3)
    edges = petal_features(ring, gate=GATE).edges.points
    assert len(edges) == 4
    np.testing.assert_allclose(np.abs(edges[:, :2]), np.tile([9.0, 7.0], (4, 1)), atol=0.1)
    with pytest.raises(InputError, match=r"neighbours on a ring .*--method loam-livox"):
        extract_features(box())
