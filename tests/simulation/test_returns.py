"""What real surfaces and beams do to returns, each by its law."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from lslam.simulation.lidar import trace
from lslam.simulation.lidar_models import LidarModel
from lslam.simulation.returns import Hits, Rays, Returns, errors, mixed_pixels, range_walk, texture
from lslam.simulation.scenario_files import find_scenario
from lslam.simulation.scenarios import simulate
from lslam.simulation.scene_mesh import MeshBuilder, RayScene, Surface

Floats = NDArray[np.float64]

BEAMS = LidarModel("beams", (0.0,), 36000, 0.1, 500.0, 0.0, 1e-6, 0.0, 1e6, 0.0)
DOWN = replace(BEAMS, elevations_deg=(-20.0, -40.0), columns=4000)


def wall(x: float, surface: int = Surface.WALL) -> RayScene:
    builder = MeshBuilder()
    builder.add_quads([[(x, -300, -300), (x, 300, -300), (x, 300, 300), (x, -300, 300)]], surface)
    return RayScene(builder.build())


def floor(surface: int) -> RayScene:
    builder = MeshBuilder()
    builder.add_quads([[(-90, -90, -2), (90, -90, -2), (90, 90, -2), (-90, 90, -2)]], surface)
    return RayScene(builder.build())


def seen(scene: RayScene, returns: Returns | None, model: LidarModel = BEAMS, seed: int = 3) -> Floats:
    return trace(scene, model, np.eye(4), np.random.default_rng(seed), returns=returns).points.astype(float)


def azimuth(points: Floats) -> Floats:
    return np.degrees(np.arctan2(points[:, 1], points[:, 0]))


def late(scene: RayScene, returns: Returns) -> tuple[Floats, Floats]:
    """Azimuth, deg, and m by which each return is too long, on a wall that every beam comes back from."""
    clean, points = seen(scene, None), seen(scene, returns)
    assert len(clean) == len(points)
    return azimuth(clean), np.linalg.norm(points, axis=1) - np.linalg.norm(clean, axis=1)


def test_all_off_is_byte_for_byte_what_it_was() -> None:
    model = replace(BEAMS, range_noise=0.02, angle_noise_deg=0.01, dropout=0.05, range_10pct=45.0)
    for scene in (wall(9.0), floor(Surface.LAWN)):
        plain, asked = (
            trace(scene, model, np.eye(4), np.random.default_rng(5), glass=0.5, returns=returns)
            for returns in (None, Returns())
        )
        assert plain.points.tobytes() == asked.points.tobytes()
        assert plain.intensity is not None
        assert asked.intensity is not None
        assert plain.intensity.tobytes() == asked.intensity.tobytes()
    assert not Returns().is_on
    assert find_scenario("urban").real_returns is None


def test_incidence_bias_is_nothing_at_normal_incidence_and_its_value_at_60_deg() -> None:
    bearing, off = late(wall(10.0), Returns(incidence_bias=0.03))
    assert off[np.abs(bearing) < 0.02] == pytest.approx(0.0, abs=1e-5)
    assert off[np.abs(np.abs(bearing) - 60) < 0.02] == pytest.approx(0.03, abs=1e-4)
    fair = np.abs(bearing) < 80
    np.testing.assert_allclose(off[fair], 0.03 * (1 / np.cos(np.radians(bearing[fair])) - 1), atol=1e-4)


def test_a_beam_errs_by_its_spot_on_what_is_slanted() -> None:
    bearing, off = late(wall(20.0), Returns(divergence_mrad=4.0))
    for low, high in ((0, 1), (44, 46), (69, 71)):
        here = (np.abs(bearing) >= low) & (np.abs(bearing) < high)
        angle = np.radians(bearing[here])
        expected = 20.0 / np.cos(angle) * 4e-3 / 4 * np.abs(np.tan(angle))
        assert np.std(off[here]) == pytest.approx(np.sqrt(np.mean(expected**2)), rel=0.15, abs=1e-5)


def test_grass_returns_half_normal_heights() -> None:
    points = seen(floor(Surface.LAWN), Returns(grass=0.05), DOWN)
    height = points[:, 2] + 2.0
    assert len(height) == DOWN.rays
    assert height.min() >= -1e-4
    assert stats.kstest(height, "halfnorm", args=(0, 0.05)).pvalue > 0.01
    np.testing.assert_allclose(seen(floor(Surface.ROAD), Returns(grass=0.05), DOWN)[:, 2], -2.0, atol=1e-4)


def test_texture_is_the_same_on_every_visit() -> None:
    returns = Returns(wall_texture=0.02)
    first, again = seen(wall(6.0), returns, seed=1), seen(wall(6.0), returns, seed=2)
    np.testing.assert_array_equal(first, again)
    near = np.abs(azimuth(first)) < 80
    assert np.std(first[near, 0] - 6.0) == pytest.approx(0.02, rel=0.2)
    np.testing.assert_allclose(seen(wall(6.0), Returns(ground_texture=0.02))[:, 0], 6.0, atol=1e-3)
    places = np.random.default_rng(0).uniform(-500, 500, (100_000, 3)).astype(np.float32)
    bumps = texture(places).astype(float)
    assert stats.kstest(bumps, "norm").statistic < 0.01
    assert abs(np.corrcoef(bumps, texture(places + np.float32(0.2)))[0, 1]) < 0.02


def step(gap: float, model: LidarModel) -> NDArray[np.float32]:
    """Ranges of two facing surfaces: 10 m in the first half of the columns and `gap` m more in the second."""
    distance = np.full((model.columns, model.rings), 10.0, np.float32)
    distance[model.columns // 2 :] += np.float32(gap)
    return distance.ravel()


def test_mixed_pixels_lie_between_two_surfaces_and_only_at_their_edge() -> None:
    model = replace(BEAMS, elevations_deg=tuple(np.linspace(10, -10, 64)), columns=2000)
    returns = Returns(divergence_mrad=2.0, pulse=0.75)
    flat = np.zeros(model.rays, np.float32)
    drawn = [
        mixed_pixels(returns, model, step(0.6, model), flat, np.random.default_rng(k)).reshape(model.columns, -1)
        for k in range(40)
    ]
    off = np.concatenate(drawn, axis=1)
    half = model.columns // 2
    edges = {0, half - 1, half, model.columns - 1}
    assert set(np.flatnonzero(off.any(axis=1)).tolist()) == edges
    near, far = off[[half - 1, 0]], off[[half, model.columns - 1]]
    assert near.min() >= 0
    assert near.max() <= 0.3  # most of the light stays on its own side
    assert far.max() <= 0
    assert far.min() >= -0.3
    chance = 2e-3 / (2 * np.pi / model.columns) / 2
    assert np.mean(off[list(edges)] != 0) == pytest.approx(chance, rel=0.1)
    assert stats.kstest(near[near > 0] / 0.6, "uniform", args=(0, 0.5)).pvalue > 0.01


def test_two_echoes_farther_apart_than_the_pulse_do_not_merge_nor_does_a_slope() -> None:
    model = replace(BEAMS, elevations_deg=tuple(np.linspace(10, -10, 64)), columns=2000)
    returns, flat = Returns(divergence_mrad=2.0, pulse=0.75), np.zeros(model.rays, np.float32)
    assert not mixed_pixels(returns, model, step(0.8, model), flat, np.random.default_rng(0)).any()
    sky = step(0.0, model)
    sky[: model.rays // 2] = np.inf
    assert not mixed_pixels(returns, model, sky, flat, np.random.default_rng(0)).any()
    angle = np.linspace(0.9, 1.4, model.columns)
    grazing = np.repeat(5.0 / np.cos(angle), 64).astype(np.float32)
    slant = np.repeat(np.tan(angle), 64).astype(np.float32)
    inner = mixed_pixels(returns, model, grazing, slant, np.random.default_rng(0)).reshape(model.columns, -1)[1:-1]
    assert not inner.any()


def test_mixed_points_of_a_scan_lie_on_their_rays() -> None:
    """A wall before a wall: every point is on one of them or, beside the edge alone, between."""
    builder = MeshBuilder()
    for x, low, high in ((10.0, 0.0, 40.0), (10.5, -40.0, 40.0)):
        builder.add_quads([[(x, low, -9), (x, high, -9), (x, high, 9), (x, low, 9)]], Surface.WALL)
    model = replace(BEAMS, columns=2000, elevations_deg=tuple(np.linspace(20, -20, 64)))
    points = seen(RayScene(builder.build()), Returns(divergence_mrad=2.0, pulse=0.75), model)
    ahead = points[np.abs(azimuth(points)) < 5]
    between = (ahead[:, 0] > 10.05) & (ahead[:, 0] < 10.45)
    assert between.sum() > 10
    assert np.abs(azimuth(ahead[between])).max() <= 360 / 2000 + 1e-4


def test_half_as_bright_is_measured_one_walk_too_long() -> None:
    returns = Returns(walk=0.02)
    found = range_walk(returns, np.array([0.4, 0.2, 0.1], np.float32))
    np.testing.assert_allclose(found, [0.0, 0.02, 0.04], atol=1e-6)
    _, off = late(wall(10.0, Surface.ROOF), returns)
    assert off[0] == pytest.approx(0.02 * np.log2(0.4 / 0.25), abs=1e-4)


def echo(surface: int, distance: float, cosine: float, returns: Returns) -> float:
    """Share of the light left."""
    one = np.ones(1, np.float32)
    ray = Rays(np.zeros((1, 3), np.float32), np.array([[1, 0, 0]], np.float32), np.zeros(1))
    hit = Hits(distance * one, cosine * one, np.array([surface], np.uint8), np.zeros(1, np.int32))
    model = replace(BEAMS, columns=1)
    return float(errors(returns, model, ray, hit, np.random.default_rng(0)).gain[0])


def test_losses_by_range_and_material() -> None:
    """Beer and Lambert's law there and back; what shines returns by a power of the cosine, what is diffuse does not care."""
    assert echo(Surface.WALL, 50.0, 1.0, Returns(attenuation=0.002)) == pytest.approx(np.exp(-0.2))
    shiny = Returns(paint=3.0)
    assert echo(Surface.CAR, 20.0, 0.5, shiny) == pytest.approx(0.125)
    assert echo(Surface.GLASS, 20.0, 0.5, shiny) == pytest.approx(0.125)
    assert echo(Surface.WALL, 20.0, 0.5, shiny) == pytest.approx(1.0)
    faint = replace(BEAMS, range_10pct=30.0)
    clean, hazy = (len(seen(wall(60.0), r, faint)) for r in (None, Returns(attenuation=0.01)))
    assert hazy < 0.8 * clean


def behind_a_pane() -> RayScene:
    """A pane 5 m ahead, a wall 12 m ahead behind it, and one 8 m behind the LiDAR."""
    builder = MeshBuilder()
    for x, surface, half in ((5.0, Surface.GLASS, 20), (12.0, Surface.WALL, 200), (-8.0, Surface.WALL, 200)):
        builder.add_quads([[(x, -half, -9), (x, half, -9), (x, half, 9), (x, -half, 9)]], surface)
    return RayScene(builder.build())


def test_a_perfect_mirror_shows_the_room_behind_it() -> None:
    points = seen(behind_a_pane(), Returns(mirror=1.0))
    ahead = points[np.abs(azimuth(points)) < 60]
    assert len(ahead) == pytest.approx(12000, rel=0.01)
    np.testing.assert_allclose(ahead[:, 0], 2 * 5.0 + 8.0, atol=0.03)


def test_panes_mirror_as_schlick_says_and_pass_of_the_rest_their_share() -> None:
    returns = Returns(mirror=0.1)
    scan = trace(behind_a_pane(), BEAMS, np.eye(4), np.random.default_rng(3), glass=0.5, returns=returns)
    points = scan.points.astype(float)
    for low, high in ((0, 10), (55, 60)):
        bearing = np.abs(azimuth(points))
        here = points[(bearing >= low) & (bearing < high)]
        cosine = np.cos(np.radians((low + high) / 2))
        mirrored = 0.1 + 0.9 * (1 - cosine) ** 5
        assert np.mean(here[:, 0] > 17) == pytest.approx(mirrored, abs=0.04)
        assert np.mean(np.abs(here[:, 0] - 12) < 0.1) == pytest.approx((1 - mirrored) / 2, abs=0.06)
        assert np.mean(np.abs(here[:, 0] - 5) < 0.1) == pytest.approx((1 - mirrored) / 2, abs=0.06)


def test_calibration_errors_are_scaled() -> None:
    plain = simulate("block", lidar="hdl64-kitti", count=2)
    worse = simulate("block", lidar="hdl64-kitti", count=2, settings=["returns.calibration=2.5"])
    for k in (0, 1):
        np.testing.assert_allclose(worse.lidar.ring_errors[k], 2.5 * plain.lidar.ring_errors[k])


def test_a_hard_drive_is_decided_by_its_seed() -> None:
    first, again = (simulate("climbing-hard", seed=4, count=3) for _ in range(2))
    a, b = first.scan(2), again.scan(0)
    b = again.scan(2)
    assert a.points.tobytes() == b.points.tobytes()
    assert a.intensity is not None
    assert b.intensity is not None
    assert a.intensity.tobytes() == b.intensity.tobytes()
    assert simulate("climbing-hard", seed=5, count=3).scan(2).points.tobytes() != a.points.tobytes()
