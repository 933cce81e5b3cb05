"""Beams in leaves: depths by Beer and Lambert's law, what is in and behind a volume, and crowns wound outwards."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from lslam.core.types.scan import Scan
from lslam.simulation import furniture
from lslam.simulation.lidar import trace
from lslam.simulation.lidar_models import LidarModel
from lslam.simulation.returns import Returns
from lslam.simulation.scene_mesh import MeshBuilder, RayScene, SceneMesh, Surface, box

BEAMS = LidarModel("beams", (0.0,), 36000, 0.1, 500.0, 0.0, 1e-6, 0.0, 1e6, 0.0)
AHEAD = 5.0  # deg to either side


def slab(near: float, far: float, surface: int = Surface.CROWN) -> SceneMesh:
    """A volume across the way from x = near to far, wound outwards; walls when it is one."""
    builder = MeshBuilder()
    low, high = np.array([near, -50.0, -20.0]), np.array([far, 50.0, 20.0])
    corners, faces = box(low, high)
    outward = corners[faces].mean(axis=1) - (low + high) / 2
    normal = np.cross(corners[faces[:, 1]] - corners[faces[:, 0]], corners[faces[:, 2]] - corners[faces[:, 0]])
    faces = np.where(np.sum(outward * normal, axis=1)[:, None] > 0, faces, faces[:, ::-1])
    builder.add(corners, faces, surface)
    return builder.build()


def joined(*meshes: SceneMesh) -> RayScene:
    builder = MeshBuilder()
    for mesh in meshes:
        builder.add_mesh(mesh)
    return RayScene(builder.build())


def look(scene: RayScene, returns: Returns, seed: int = 3) -> tuple[Scan, NDArray[np.float64], NDArray[np.float64]]:
    """A scan ahead, its ranges and their cosines to the x axis."""
    scan = trace(scene, BEAMS, np.eye(4), np.random.default_rng(seed), returns=returns)
    azimuth = np.degrees(np.arctan2(scan.points[:, 1], scan.points[:, 0]).astype(float))
    p = scan.points[np.abs(azimuth) < AHEAD].astype(float)
    ranges = np.linalg.norm(p, axis=1)
    return scan, ranges, p[:, 0] / ranges


@pytest.mark.parametrize("extinction", [0.4, 2.5])
def test_depths_in_a_crown_are_exponential(extinction: float) -> None:
    _, ranges, cosine = look(joined(slab(5.0, 200.0)), Returns(crown_extinction=extinction))
    depth = ranges - 5.0 / cosine
    assert len(depth) == pytest.approx(1000, abs=1)
    assert depth.min() > 0
    assert stats.kstest(depth, "expon", args=(0, 1 / extinction)).pvalue > 0.01
    # The law is not met by another coefficient: the test can fail.
    assert stats.kstest(depth, "expon", args=(0, 1.3 / extinction)).pvalue < 1e-6


def test_what_gets_through_meets_what_is_behind() -> None:
    scene = joined(slab(5.0, 7.0, Surface.HEDGE), slab(20.0, 21.0, Surface.WALL))
    _, ranges, cosine = look(scene, Returns(hedge_extinction=0.6))
    at = ranges * cosine
    behind = at > 19.9
    np.testing.assert_allclose(at[behind], 20.0, atol=1e-3)
    assert (at[~behind] < 7.0).all()
    assert np.mean(behind) == pytest.approx(np.mean(np.exp(-0.6 * 2.0 / cosine)), abs=0.05)


def test_volumes_that_overlap_are_one() -> None:
    """From 5 to 9 m in all, of which 6 to 7 m twice; then a second crown from 12 to 13 m."""
    scene = joined(slab(5.0, 7.0), slab(6.0, 9.0), slab(12.0, 13.0), slab(30.0, 31.0, Surface.WALL))
    _, ranges, cosine = look(scene, Returns(crown_extinction=0.3))
    at = ranges * cosine
    assert not np.any((at > 9.001) & (at < 11.999) | (at > 13.001) & (at < 29.99))
    assert np.mean(at > 29.9) == pytest.approx(np.exp(-0.3 * 5.0), abs=0.05)


def test_a_trunk_in_a_crown_is_met() -> None:
    scene = joined(slab(5.0, 15.0), slab(8.0, 8.5, Surface.TRUNK))
    _, ranges, cosine = look(scene, Returns(crown_extinction=0.2))
    at = ranges * cosine
    assert at.max() < 8.001
    assert np.mean(at > 7.999) == pytest.approx(np.exp(-0.2 * 3.0), abs=0.05)


def test_leaves_are_drawn_by_the_seed() -> None:
    scene, returns = joined(slab(5.0, 200.0)), Returns(crown_extinction=1.0)
    first, again, other = (look(scene, returns, seed)[0].points for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert len(first) != len(other) or (first != other).any()


@pytest.mark.parametrize("seed", range(6))
def test_crowns_and_hedges_are_wound_outwards(seed: int) -> None:
    """A ray from far away enters before it leaves, and as often."""
    rng = np.random.default_rng(seed)
    for mesh in (furniture.tree(rng, True), furniture.hedge(rng, 5.0, True)):
        volume = np.isin(mesh.surfaces, (Surface.CROWN, Surface.HEDGE))
        assert volume.any()
        builder = MeshBuilder()
        builder.add(mesh.vertices, mesh.faces[volume], mesh.surfaces[volume])
        shell = RayScene(builder.build())
        middle = shell.mesh.vertices[np.unique(shell.mesh.faces)].mean(axis=0)
        away = rng.normal(size=(200, 3)) * [1, 1, 0.2]
        away = (away / np.linalg.norm(away, axis=1, keepdims=True)).astype(np.float32)
        _, face = shell.cast(middle + 30 * away, -away)
        assert (face >= 0).mean() > 0.9
        met = face >= 0
        assert (np.einsum("ij,ij->i", shell.mesh.normals[face[met]], -away[met]) < 0.05).mean() > 0.95


def test_loose_leaves_stay_what_they_were() -> None:
    """Without volumes a tree draws as it did, and its leaves end every beam."""
    mesh = furniture.tree(np.random.default_rng(0))
    assert set(np.unique(mesh.surfaces)) == {int(Surface.TRUNK), int(Surface.FOLIAGE)}
    model = replace(BEAMS, columns=720)
    builder = MeshBuilder()
    builder.add_mesh(mesh, (6.0, 0.0, -4.0))
    scene = RayScene(builder.build())
    plain = trace(scene, model, np.eye(4), np.random.default_rng(1))
    asked = trace(scene, model, np.eye(4), np.random.default_rng(1), returns=Returns(grass=0.1))
    np.testing.assert_array_equal(plain.points, asked.points)
