"""Which voxels were seen across their beams: a surface was, what one ring of beams hit was not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from lslam.core.kernels import gaussians
from lslam.core.kernels.gaussians import BLOB, EMPTY, breadth_of
from lslam.registration.gaussian_map import GaussianMap

Floats = NDArray[np.float64]

HEIGHT = 1.8


def ring(elevation_deg: float, rng: np.random.Generator, roughness: float = 0.02, n: int = 4000) -> NDArray[np.float32]:
    """What one beam, turning, hits on ground that is so rough: a bump of h is met h / sin(elevation) nearer."""
    azimuth, down = rng.uniform(-np.pi, np.pi, n), np.radians(-elevation_deg)
    r = (HEIGHT - rng.normal(0, roughness, n)) / np.sin(down)
    return np.column_stack(
        [r * np.cos(down) * np.cos(azimuth), r * np.cos(down) * np.sin(azimuth), -r * np.sin(down)]
    ).astype(np.float32)


def at(x: float) -> Floats:
    T = np.eye(4)
    T[0, 3] = x
    return T


def kinds(m: GaussianMap) -> NDArray[np.float64]:
    slots = np.flatnonzero((m.keys != gaussians.FREE) & (m.moments[:, 0] >= m.min_points))
    return m.planes[slots, 7]


def asked(size: float = 0.8) -> GaussianMap:
    return GaussianMap(size, breadth=4.0)


@given(st.integers(0, 10_000))
@settings(max_examples=50, deadline=None)
def test_breadth_is_the_smaller_variance_in_the_plane_across_the_beam(seed: int) -> None:
    rng = np.random.default_rng(seed)
    A, d = rng.normal(size=(3, 3)) * [1.0, 0.3, 0.01], rng.normal(size=3) * 10
    C = A @ A.T
    across = np.linalg.svd(d[None])[2][1:]
    expected = np.linalg.eigvalsh(across @ C @ across.T)[0]
    found = breadth_of(C[0, 0], C[0, 1], C[0, 2], C[1, 1], C[1, 2], C[2, 2], *d)
    assert found == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("elevation_deg", [-15.0, -7.0, -3.0])
def test_a_ring_on_rough_ground_is_no_surface_however_often_it_is_seen_from_one_place(elevation_deg: float) -> None:
    rng = np.random.default_rng(0)
    m, unasked = asked(), GaussianMap(0.8)
    for _ in range(25):
        points = ring(elevation_deg, rng)
        m.insert(points, np.eye(4))
        unasked.insert(points, np.eye(4))
    assert (kinds(unasked) != EMPTY).all()
    assert (kinds(m) == EMPTY).mean() > 0.99


def test_two_rings_and_one_that_sweeps_over_the_ground_make_it_a_surface() -> None:
    rng = np.random.default_rng(0)
    two = asked(1.6)
    for elevation in (-15.0, -13.0):
        two.insert(ring(elevation, rng, 0.005), np.eye(4))
    assert (kinds(two) >= 0).mean() > 0.3
    swept = asked()
    for k in range(9):
        swept.insert(ring(-9.0, rng, 0.005), at(0.1 * k))
    ahead = swept.planes[(swept.keys != gaussians.FREE) & (swept.planes[:, 7] >= 0)]
    ahead = ahead[np.abs(ahead[:, 1]) < 3]
    assert len(ahead) > 10
    # Its planes are the ground's, not the cone's: 9 deg from it.
    assert np.degrees(np.arccos(np.abs(ahead[:, 5]))).max() < 2.0


@pytest.mark.parametrize("gap_deg", [1.5, 2.0])
def test_one_ring_makes_no_plane_where_rings_are_known_and_a_fourth_of_a_second_does(gap_deg: float) -> None:
    """A wall 20 m ahead, whose height in a voxel one ring meets at one elevation, wherever the sensor claims to be."""
    rng = np.random.default_rng(0)
    azimuth = rng.uniform(-0.3, 0.3, 4000)
    for share, is_surface in ((0.0, False), (0.02, False), (0.25, True)):
        m = GaussianMap(0.8, ring_gap=np.radians(gap_deg), breadth=1e6)
        for k in range(4):
            elevation = np.radians(0.1 + np.where(rng.uniform(size=4000) < share, gap_deg, 0.0))
            x = 20.3 + rng.normal(0, 0.02, 4000)
            m.insert(np.column_stack([x, x * np.tan(azimuth), x * np.tan(elevation)]).astype(np.float32), at(0.2 * k))
        is_plane = m.planes[m.keys != gaussians.FREE, 7] >= 0
        assert is_plane.mean() > 0.5 if is_surface else not is_plane.any(), share


def test_grazed_ground_is_a_surface_once_several_rings_have_passed_over_it() -> None:
    """Seen from 25 m away a voxel of ground is 6 cm high: less than the floor of a plane's thickness lets spread count."""
    rng = np.random.default_rng(0)
    known, unknown = GaussianMap(0.8, ring_gap=np.radians(0.4), breadth=4.0), asked()
    elevations = -np.degrees(np.arctan(HEIGHT / np.arange(18.0, 40.0)))
    for k in range(16):
        for elevation in np.arange(elevations[0], elevations[-1], 0.4):
            for m in (known, unknown):
                m.insert(ring(elevation, rng, 0.005), at(0.7 * k))
    shares = []
    for m in (known, unknown):
        is_ahead = (m.planes[:, 0] > 28.0) & (np.abs(m.planes[:, 1]) < 4.0) & (m.keys != gaussians.FREE)
        shares.append((m.planes[is_ahead, 7] >= 0).mean())
    assert shares[0] > 0.4
    assert shares[1] < 0.1


def test_walls_seen_by_several_rings_are_surfaces_and_bushes_are_volumes() -> None:
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.normal(8.4, 0.02, 3000), rng.uniform(-4, 4, 3000), rng.uniform(-0.8, 1.6, 3000)])
    m = asked()
    m.insert(wall.astype(np.float32), np.eye(4))
    assert (kinds(m) >= 0).mean() > 0.9
    bush = asked()
    bush.insert(rng.normal((10.0, 0.0, 0.0), 0.4, (3000, 3)).astype(np.float32), np.eye(4))
    assert (kinds(bush) == BLOB).mean() > 0.4


def test_coarser_voxels_keep_the_viewpoints_of_their_points() -> None:
    rng = np.random.default_rng(0)
    m = GaussianMap(0.5, breadth=4.0, count_cap=1e9)
    direct = GaussianMap(1.5, breadth=4.0, min_points=18, count_cap=1e9)
    for k in range(3):
        points = ring(-12.0, rng)
        m.insert(points, at(0.2 * k))
        direct.insert(points, at(0.2 * k))
    coarse = m.coarsen(3)
    rows = {int(key): slot for slot, key in enumerate(direct.keys) if key != gaussians.FREE}
    for slot in np.flatnonzero(coarse.keys != gaussians.FREE):
        np.testing.assert_allclose(coarse.moments[slot], direct.moments[rows[int(coarse.keys[slot])]], atol=1e-6)
