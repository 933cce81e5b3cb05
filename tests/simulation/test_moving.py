"""Moving bodies, panes and the own roof, met by rays whose answers are known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.simulation.curve import flat, rolling, smooth_curve
from lslam.simulation.lidar import MovingMesh, Roof, trace
from lslam.simulation.lidar_models import LIDARS, LidarModel
from lslam.simulation.moving import NEAREST_M, Mover, add_traffic, moving_meshes, pedestrian
from lslam.simulation.scenario_files import TrafficSection
from lslam.simulation.scenarios import simulate
from lslam.simulation.scene_mesh import MeshBuilder, RayScene, SceneMesh, Surface

PERFECT = LidarModel("perfect", (2.0, 0.0, -2.0), 3600, 0.1, 500.0, 0.0, 1e-6, 0.0, 1e6, 0.0)


def cube(half: float, surface: int = Surface.CAR) -> SceneMesh:
    builder = MeshBuilder()
    builder.add_box([-half] * 3, [half] * 3, surface)
    return builder.build()


def body_of(
    mesh: SceneMesh,
    poses: Callable[[NDArray[Any]], NDArray[np.float64]],
    radius: float,
    speed: float = 0.0,
    at: float = 0.0,
) -> MovingMesh:
    """The body as a scan stamped `at` s is told of it."""
    return MovingMesh(RayScene(mesh), poses, radius, speed, poses(np.array([at]))[0, :3, 3])


def passing(speed: float, at: float = 0.0) -> MovingMesh:
    """A cube of 2 m, 10 m to the left, that drives along +x and is beside us at 0.05 s."""

    def poses(times: NDArray[Any]) -> NDArray[np.float64]:
        T = np.tile(np.eye(4), (len(times), 1, 1))
        T[:, 0, 3], T[:, 1, 3] = speed * (np.asarray(times) - 0.05), 10.0
        return T

    return body_of(cube(1.0), poses, np.sqrt(3.0), speed, at)


def standing_at(place: NDArray[np.float64], times: NDArray[Any]) -> NDArray[np.float64]:
    return np.tile(place, (len(times), 1, 1))


def test_a_body_is_met_where_it_is_when_the_ray_is_fired() -> None:
    scene, standing = RayScene(cube(100.0, Surface.WALL)), np.tile(np.eye(4), (3600, 1, 1))
    scan = trace(scene, PERFECT, standing, np.random.default_rng(0), bodies=[passing(20.0)])
    on_body = np.abs(scan.points[:, 1] - 9.0) < 0.01
    assert scan.times is not None
    assert on_body.sum() > 300
    x, at = scan.points[on_body, 0].astype(float), scan.times[on_body].astype(float)
    assert np.abs(x - 20.0 * (at - 0.05)).max() < 1.0 + 1e-3
    # The side that faces us is seen from end to end, as it stands at that time.
    assert np.ptp(x - 20.0 * (at - 0.05)) > 1.95
    # Read as if it stood still it would lie elsewhere: it is met at 0.025 s, to the left.
    assert abs(x.mean() + 0.5) < 0.05


def test_a_compensated_scan_meets_it_at_the_stamp() -> None:
    scan = trace(RayScene(cube(100.0, Surface.WALL)), PERFECT, np.eye(4), np.random.default_rng(0),
                 stamp_ns=80_000_000, bodies=[passing(20.0, 0.08)])  # fmt: skip
    x = scan.points[np.abs(scan.points[:, 1] - 9.0) < 0.01, 0]
    assert x.mean() == pytest.approx(20.0 * 0.03, abs=0.01)


def test_what_stands_in_front_hides_a_body_and_all_else_is_as_without_it() -> None:
    front = MeshBuilder()
    front.add_box([-5, 4.9, -3], [5, 5.1, 3], Surface.WALL)
    front.add_mesh(cube(100.0, Surface.WALL))
    scene = RayScene(front.build())
    hidden = trace(scene, PERFECT, np.eye(4), np.random.default_rng(0), bodies=[passing(5.0)])
    without = trace(scene, PERFECT, np.eye(4), np.random.default_rng(0))
    assert hidden.points.tobytes() == without.points.tobytes()


def test_a_body_behind_us_and_one_all_round_us_are_met() -> None:
    for x in (-20.0, 20.0):
        place = np.array([[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
        body = body_of(cube(1.0), partial(standing_at, place), 2.0)
        scan = trace(RayScene(cube(100.0)), PERFECT, np.eye(4), np.random.default_rng(0), bodies=[body])
        assert np.sum(np.abs(scan.points[:, 0] - np.sign(x) * 19.0) < 0.01) > 50
    shell = body_of(cube(5.0), partial(standing_at, np.eye(4)), 9.0)
    scan = trace(RayScene(cube(100.0)), PERFECT, np.eye(4), np.random.default_rng(0), bodies=[shell])
    np.testing.assert_allclose(np.abs(scan.points).max(axis=1), 5.0, atol=1e-3)


def test_a_share_of_the_rays_passes_a_pane_to_what_is_behind() -> None:
    builder = MeshBuilder()
    builder.add_quads([[[5, -400, -400], [5, 400, -400], [5, 400, 400], [5, -400, 400]]], Surface.GLASS)
    builder.add_quads([[[8, -400, -400], [8, 400, -400], [8, 400, 400], [8, -400, 400]]], Surface.WALL)
    scene = RayScene(builder.build())
    bright = replace(PERFECT, range_10pct=1e9)
    for share in (0.0, 0.3, 1.0):
        scan = trace(scene, bright, np.eye(4), np.random.default_rng(1), glass=share)
        behind = np.isclose(scan.points[:, 0], 8.0, atol=1e-3)
        assert np.isclose(scan.points[~behind, 0], 5.0, atol=1e-3).all()
        assert behind.mean() == pytest.approx(share, abs=0.02)


def test_what_moves_behind_a_pane_is_seen_through_it_and_what_moves_before_it_hides_it() -> None:
    """A body passes at 100 m/s, behind a pane or before it: each ray meets it where it is when that ray is fired."""
    builder = MeshBuilder()
    for x, surface in ((5, Surface.GLASS), (12, Surface.WALL)):
        builder.add_quads([[[x, -400, -400], [x, 400, -400], [x, 400, 400], [x, -400, 400]]], surface)
    scene, bright = RayScene(builder.build()), replace(PERFECT, range_10pct=1e9)

    def passing(x: float) -> MovingMesh:
        def poses(times: NDArray[Any]) -> NDArray[np.float64]:
            T = np.tile(np.eye(4), (len(times), 1, 1))
            T[:, 0, 3], T[:, 1, 3] = x, 100.0 * (np.asarray(times) - 0.05)
            return T

        return body_of(cube(1.0), poses, 1.8, 100.0)

    bright, still = replace(bright, start_deg=-180.0), np.tile(np.eye(4), (PERFECT.columns, 1, 1))
    for x in (8.0, 3.0):
        scan = trace(scene, bright, still, np.random.default_rng(1), bodies=[passing(x)], glass=1.0)
        assert scan.times is not None
        on_body = np.isclose(scan.points[:, 0], x - 1.0, atol=1e-3)
        assert on_body.sum() > 50
        y = scan.points[on_body, 1] - 100.0 * (scan.times[on_body] - 0.05)
        assert np.abs(y).max() < 1.001
        assert np.ptp(scan.points[on_body, 1]) > 2.2, "it has moved while the scan was taken"
        assert not np.isclose(scan.points[:, 0], 5.0, atol=1e-2).any(), "no ray stops at the pane"
    shut = trace(scene, bright, still, np.random.default_rng(1), bodies=[passing(8.0)], glass=0.0)
    assert not np.isclose(shut.points[:, 0], 7.0, atol=1e-2).any()


def test_the_own_roof_shadows_what_is_low() -> None:
    down = replace(PERFECT, elevations_deg=(-10.0, -20.0, -30.0))
    scene, roof = RayScene(cube(50.0, Surface.WALL)), Roof(0.9, 0.75, 0.5, 0.3)
    scan = trace(scene, down, np.eye(4), np.random.default_rng(0), roof=roof)
    azimuth = np.degrees(np.arctan2(scan.points[:, 1], scan.points[:, 0]))
    assert scan.rings is not None
    # At -10 deg the roof's level is reached at 1.7 m, beyond all edges; at -20 deg at 0.82 m: behind only.
    assert np.sum(scan.rings == 0) == 3600
    seen = azimuth[scan.rings == 1]
    assert np.abs(seen).max() < 180 - np.degrees(np.arcsin(0.5 / 0.8243)) + 0.2
    assert np.sum(np.abs(seen) < 24) == pytest.approx(480, abs=2)
    assert not np.any((np.abs(seen) > 25) & (np.abs(seen) < 37))
    # At -30 deg at 0.52 m: only to the sides is there a view past its edge.
    assert np.abs(np.abs(azimuth[scan.rings == 2]) - 90).max() < 16


def test_the_own_roof_is_seen_where_it_returns() -> None:
    """From 0.2 m above it, rays at -15 deg end on it 0.77 m away; what it hides is the same as where it does not show."""
    down = replace(LIDARS["vlp16"], range_noise=0.0, range_step=1e-6, angle_noise_deg=0.0, range_10pct=1e6, dropout=0.0)
    scene = RayScene(cube(50.0, Surface.WALL))
    seen, cut = (
        trace(scene, down, np.eye(4), np.random.default_rng(0), roof=Roof(0.8, 0.5, 0.6, 0.2, returns))
        for returns in (True, False)
    )
    near = np.linalg.norm(seen.points, axis=1) < 1.0
    body = seen.points[near].astype(float)
    np.testing.assert_allclose(body[:, 2], -0.2, atol=1e-5)
    assert seen.rings is not None
    assert set(seen.rings[near].tolist()) == {14, 15}, "at -11 deg it would be 1.03 m away, beyond its edge"
    np.testing.assert_allclose(np.hypot(*body[seen.rings[near] == 15, :2].T), 0.2 / np.tan(np.radians(15)), atol=1e-4)
    assert np.all((body[:, 0] > -0.8) & (body[:, 0] < 0.5) & (np.abs(body[:, 1]) < 0.6))
    assert seen.points[~near].tobytes() == cut.points.tobytes()


def test_what_calibration_misses_stays_with_its_ring() -> None:
    model = replace(PERFECT, ring_bias=0.05, ring_tilt_deg=0.0)
    scan = trace(RayScene(cube(20.0)), model, np.eye(4), np.random.default_rng(0))
    exact = trace(RayScene(cube(20.0)), PERFECT, np.eye(4), np.random.default_rng(0))
    assert scan.rings is not None
    off = np.linalg.norm(scan.points.astype(float), axis=1) - np.linalg.norm(exact.points.astype(float), axis=1)
    for ring, bias in enumerate(model.ring_errors[0]):
        np.testing.assert_allclose(off[scan.rings == ring], bias, atol=1e-4)
    tilted = replace(PERFECT, ring_tilt_deg=0.5)
    scan = trace(RayScene(cube(20.0)), tilted, np.eye(4), np.random.default_rng(0))
    # Reported at the nominal elevation, measured along the true one.
    elevation = np.degrees(np.arctan2(scan.points[:, 2], np.hypot(scan.points[:, 0], scan.points[:, 1])))
    np.testing.assert_allclose(np.unique(np.round(elevation, 3)), np.sort(PERFECT.elevations_deg), atol=2e-3)


def test_the_livox_pattern_does_not_repeat_and_fills_its_view() -> None:
    model = replace(LIDARS["livox"], range_noise=0.0, angle_noise_deg=0.0, range_10pct=1e6, dropout=0.0)
    scene = RayScene(cube(50.0))
    filled = []
    cells: set[tuple[int, int]] = set()
    for index in range(8):
        p = trace(scene, model, np.eye(4), np.random.default_rng(0), index=index).points.astype(float)
        assert len(p) == 24_000
        assert np.degrees(np.arctan2(np.hypot(p[:, 1], p[:, 2]), p[:, 0])).max() < 36.5
        cell = np.floor(np.degrees(np.stack([np.arctan2(p[:, 1], p[:, 0]), np.arctan2(p[:, 2], p[:, 0])])) / 0.5).T
        cells |= {(int(a), int(b)) for a, b in cell}
        filled.append(len(cells))
    assert filled[7] > 1.5 * filled[0]
    assert filled[1] > 1.1 * filled[0]


def test_movers_drive_on_the_ground_at_their_speed() -> None:
    street = smooth_curve(np.array([[0.0, 0.0], [200.0, 0.0]]), closed=False)
    ground = rolling(np.random.default_rng(4))
    mover = Mover(RayScene(cube(1.0)), 1.8, street, ground, 150.0, -8.0, 2.0)
    T = mover.poses(np.array([0.0, 10.0, 30.0]))
    np.testing.assert_allclose(T[:2, :2, 3], [[150, 2], [70, 2]], atol=1e-6)
    np.testing.assert_allclose(T[:2, 2, 3], ground.height(T[:2, :2, 3]), atol=1e-9)
    assert T[0, 0, 0] < -0.99
    assert T[2, 2, 3] < -1000, "it has left the street"
    assert len(moving_meshes([mover], np.array([140.0, 0, 0]), 0.0, 20.0)) == 1
    assert not moving_meshes([mover], np.array([100.0, 0, 0]), 0.0, 20.0)


def test_bodies_are_told_with_the_places_their_poses_say_and_the_far_ones_not_at_all() -> None:
    drive = simulate("urban", seed=2, count=10)
    here, time = drive.city_poses[4, :3, 3], 0.4
    near = moving_meshes(drive.movers, here, time, 60.0)
    at = [mover.poses(np.array([time]))[0, :3, 3] for mover in drive.movers]
    expected = [p for p, m in zip(at, drive.movers, strict=True) if np.linalg.norm(p - here) < 60.0 + m.radius]
    assert 5 < len(near) == len(expected) < len(drive.movers)
    for body, p in zip(near, expected, strict=True):
        np.testing.assert_allclose(body.centre, p, atol=1e-9)


def test_a_body_that_no_ray_comes_near_is_not_asked_where_it_is() -> None:
    asked: list[float] = []

    def poses(times: NDArray[Any]) -> NDArray[np.float64]:
        asked.extend(times)
        T = np.tile(np.eye(4), (len(times), 1, 1))
        T[:, 0, 3] = 200.0
        return T

    hidden = MovingMesh(RayScene(cube(1.0)), poses, 2.0, 10.0, np.array([200.0, 0.0, 0.0]))
    trace(RayScene(cube(100.0, Surface.WALL)), PERFECT, np.eye(4), np.random.default_rng(0), bodies=[hidden])
    assert not asked
    trace(RayScene(cube(400.0, Surface.WALL)), PERFECT, np.eye(4), np.random.default_rng(0), bodies=[hidden])
    assert asked


def test_traffic_keeps_clear_of_the_line() -> None:
    street = smooth_curve(np.array([[0.0, 0.0], [300.0, 0.0]]), closed=False)

    def line(times: NDArray[Any]) -> NDArray[np.float64]:
        T = np.tile(np.eye(4), (len(times), 1, 1))
        T[:, 0, 3], T[:, 1, 3], T[:, 2, 3] = 10.0 * np.asarray(times), -1.2, 1.7
        return T

    traffic = TrafficSection(cars=200, people=100, lanes=(1.7, -1.2), speed=8.0)
    movers = add_traffic([street], flat(), line, 30.0, np.random.default_rng(5), traffic, 6.0)
    assert len(movers) > 20
    times = np.arange(0, 30, 0.05)
    for mover in movers:
        at = mover.poses(times)[:, :3, 3]
        present = at[:, 2] > -100
        apart = np.linalg.norm((at - line(times)[:, :3, 3])[present, :2], axis=1)
        assert apart.min(initial=np.inf) > NEAREST_M - 0.5
    assert any(mover.offset == 1.7 and mover.speed < 0 for mover in movers)


def test_people_have_a_size_and_a_class_of_their_own() -> None:
    for seed in range(4):
        person = pedestrian(np.random.default_rng(seed))
        size = np.ptp(person.vertices, axis=0)
        assert 1.5 < size[2] < 1.95
        assert size[:2].max() < 0.9
        assert set(person.surfaces.tolist()) == {Surface.PERSON}


def test_cars_of_a_drive_are_seen_moving() -> None:
    drive = simulate("identical", count=30, settings=["traffic.cars=60", "traffic.speed=12"])
    assert len(drive.movers) > 5
    calm = simulate("identical", count=30, settings=["traffic.cars=0"])
    assert calm.city.mesh.vertices.tobytes() == drive.city.mesh.vertices.tobytes()
    with_cars, without = drive.scan(10), calm.scan(10)
    from scipy.spatial import cKDTree

    fresh = np.asarray(cKDTree(without.points).query(with_cars.points)[0]) > 0.5
    at = with_cars.points[fresh]
    T = drive.city_poses[10]
    city = at.astype(float) @ T[:3, :3].T + T[:3, 3]
    centres = np.array([m.poses(np.array([1.05]))[0, :3, 3] for m in drive.movers])
    near = np.asarray(cKDTree(centres).query(city)[0]) < 4.0
    assert near.sum() > 200
