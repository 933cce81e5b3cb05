"""Registration on arrays in scenes whose answer is known: recovery, failure, memory of the map, determinism."""

from __future__ import annotations

import copy
import hashlib
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from analytic_scenes import corridor, distance, is_near, pose_at, random_pose, room, seen_from
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from lslam.core.config.input import PreprocessConfig
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.errors import InputError
from lslam.core.geometry import se3, so3
from lslam.registration.gaussian_map import COUNT_CAP
from lslam.registration.optimiser import KERNEL_MIN_M
from lslam.registration.preprocessing.prepare import PreparedPoints
from lslam.registration.registration import Registration
from lslam.registration.voxel_target import MIN_SOURCE_POINTS

Floats = NDArray[np.float64]


def in_room(seed: int = 0, config: RegistrationConfig | None = None) -> Registration:
    """A registration that has seen the room from its middle."""
    registration = Registration(config)
    registration.register(room(np.random.default_rng(seed)).astype(np.float32))
    return registration


def settled(scans: int = 8) -> tuple[Registration, np.random.Generator]:
    """The same after a few scans of slow driving, past its careful start."""
    registration, rng = in_room(), np.random.default_rng(100)
    for k in range(1, scans):
        assert registration.register(seen_from(room(rng), pose_at((0.1 * k, 0.0, 0.0), 0.5 * k))).ok
    return registration, rng


def test_the_first_scan_defines_the_world_or_takes_its_prior() -> None:
    points = room(np.random.default_rng(0)).astype(np.float32)
    np.testing.assert_array_equal(Registration().register(points).T_world_lidar, np.eye(4))
    prior = random_pose(np.random.default_rng(1), 50.0, 90.0)
    np.testing.assert_array_equal(Registration().register(points, prior).T_world_lidar, prior)


@given(st.integers(0, 2**31), st.sampled_from([(0.3, 3.0), (1.0, 5.0), (2.5, 5.0)]))
@settings(max_examples=12)
def test_a_start_at_unknown_speed_is_found(seed: int, limits: tuple[float, float]) -> None:
    rng = np.random.default_rng(seed)
    T = random_pose(rng, *limits)
    result = in_room(seed).register(seen_from(room(rng), T))
    assert result.ok
    assert result.converged
    assert len(result.degenerate) == 0
    assert is_near(T, result.T_world_lidar, 0.01, 0.05)
    np.testing.assert_allclose(
        result.prior_error, (np.linalg.norm(T[:3, 3]), np.deg2rad(distance(T, np.eye(4))[1])), atol=0.01
    )


@given(st.integers(0, 2**31))
@settings(max_examples=10)
def test_unexpected_motion_after_the_start_is_recovered_coarse_to_fine(seed: int) -> None:
    registration, _ = settled(6)
    rng = np.random.default_rng(seed)
    T = pose_at((0.5, 0.0, 0.0), 2.5) @ random_pose(rng, 2.0, 6.0)
    result = registration.register(seen_from(room(rng), T))
    assert result.ok
    assert is_near(T, result.T_world_lidar, 0.01, 0.05)


def test_where_priors_are_right_the_kernel_begins_where_it_ends() -> None:
    """And a surprise of a decimetre is found all the same, in a step or two more."""
    registration, rng = settled(22)
    assert registration.history.threshold.width == KERNEL_MIN_M
    usual = registration.register(seen_from(room(rng), pose_at((2.2, 0.0, 0.0), 11.0)))
    assert usual.iterations <= 2
    T = pose_at((2.42, 0.0, 0.0), 11.5)
    surprised = registration.register(seen_from(room(rng), T))
    assert surprised.iterations <= 4
    assert is_near(T, surprised.T_world_lidar, 0.01, 0.05)
    assert registration.history.threshold.width > KERNEL_MIN_M


def test_a_corridor_keeps_the_prior_along_itself_scan_after_scan() -> None:
    rng = np.random.default_rng(0)
    registration = Registration()
    for k in range(10):
        x = 0.5 * k
        prior = pose_at((x + 0.1, 0.05, 0.03), 0.5) if k else np.eye(4)
        result = registration.register(seen_from(corridor(rng, along=x), pose_at((x, 0.0, 0.0))), prior)
        assert result.ok
        if k:
            assert len(result.degenerate) == 1
            assert abs(result.degenerate[0, 0]) > 0.99
            assert result.T_world_lidar[0, 3] == pytest.approx(prior[0, 3], abs=1e-3)
            assert np.abs(result.T_world_lidar[1:3, 3]).max() < 0.01


@pytest.mark.parametrize("n", [0, 1, MIN_SOURCE_POINTS - 1])
def test_too_few_points_keep_the_prior_with_a_reason(n: int) -> None:
    registration = in_room()
    prior = pose_at((0.3, 0.0, 0.0))
    result = registration.register(np.full((n, 3), 5.0) + np.arange(n)[:, None] * [1.0, 0.0, 0.0], prior)
    assert not result.ok
    assert not result.converged
    assert f"{n} usable points, {MIN_SOURCE_POINTS} needed" in result.reason
    np.testing.assert_array_equal(result.T_world_lidar, prior)
    assert result.covariance is not None
    assert np.sqrt(result.covariance[0, 0]) == pytest.approx(0.5)


def bad_scan(kind: str) -> NDArray[np.float32]:
    rng = np.random.default_rng(5)
    if kind == "noise":
        return rng.uniform(-40, 40, (20_000, 3)).astype(np.float32)
    if kind == "a ball of noise":
        return rng.normal(0, 8, (20_000, 3)).astype(np.float32)
    if kind == "nan":
        return np.full((500, 3), np.nan, np.float32)
    if kind == "zeros":
        return np.zeros((500, 3), np.float32)
    return np.zeros((0, 3), np.float32)


@pytest.mark.parametrize("kind", ["noise", "a ball of noise", "nan", "zeros", "empty"])
def test_a_bad_scan_fails_without_effect_on_the_map_and_the_next_is_registered(kind: str) -> None:
    registration, rng = settled()
    before = copy.deepcopy(registration.map)
    result = registration.register(bad_scan(kind))
    assert not result.ok
    assert result.reason
    # Constant velocity: 0.1 m and half a degree on.
    assert is_near(result.T_world_lidar, pose_at((0.8, 0.0, 0.0), 4.0), 0.01, 0.1)
    for level, known in ((registration.map.fine, before.fine), (registration.map.coarser[0], before.coarser[0])):
        for name in ("moments", "planes", "keys", "table"):
            np.testing.assert_array_equal(getattr(level, name), getattr(known, name))
    for k in (9, 10):
        T = pose_at((0.1 * k, 0.0, 0.0), 0.5 * k)
        good = registration.register(seen_from(room(rng), T))
        assert good.ok
        assert is_near(T, good.T_world_lidar, 0.01, 0.05)


def test_a_jump_beyond_the_limit_fails() -> None:
    T = pose_at((1.5, 0.0, 0.0))
    points = seen_from(room(np.random.default_rng(1)), T)
    assert in_room().register(points).ok
    result = in_room(config=RegistrationConfig(max_jump_m=1.0, start_reach=0.0)).register(points)
    assert not result.ok
    assert "impossible jump of 1.5 m" in result.reason
    np.testing.assert_array_equal(result.T_world_lidar, np.eye(4))
    turned = seen_from(room(np.random.default_rng(1)), pose_at((0.0, 0.0, 0.0), 5.0))
    result = in_room(config=RegistrationConfig(max_jump_deg=4.0, start_reach=0.0)).register(turned)
    assert "5 deg" in result.reason


def test_a_static_sensor_neither_drifts_nor_becomes_overconfident() -> None:
    rng = np.random.default_rng(0)
    base = room(rng, 2500)
    registration = Registration()
    spread = []
    for _ in range(200):
        result = registration.register((base + rng.normal(0, 0.01, base.shape)).astype(np.float32))
        assert result.ok
        assert is_near(result.T_world_lidar, np.eye(4), 0.005, 0.05)
        assert result.covariance is not None
        spread.append(np.sqrt(np.diag(result.covariance)))
    # As sure in the end as when the map had filled, not two hundred scans surer; a millimetre here.
    assert (spread[-1] > 0.4 * spread[20]).all()
    assert (np.array(spread)[1:, :3] > 2e-4).all()
    assert registration.map.fine.moments[:, 0].max() < 1.1 * COUNT_CAP


def digest(seed: int = 3) -> str:
    registration = in_room(seed)
    rng = np.random.default_rng(seed + 1)
    out = hashlib.sha256()
    for k in range(1, 6):
        result = registration.register(seen_from(room(rng), pose_at((0.2 * k, 0.01 * k, 0.0), 1.0 * k)))
        out.update(result.T_world_lidar.tobytes())
        assert result.covariance is not None
        out.update(result.covariance.tobytes())
    out.update(registration.map.fine.planes.tobytes() + registration.map.coarser[0].planes.tobytes())
    return out.hexdigest()


def test_the_same_scans_give_the_same_bytes_twice_in_threads_and_in_another_process() -> None:
    expected = digest()
    assert digest() == expected
    with ThreadPoolExecutor(3) as pool:
        found = list(pool.map(digest, [3, 4, 3, 4]))
    assert found[0] == found[2] == expected
    assert found[1] == found[3] != expected
    homes = [str(Path(__file__).parent), str(Path(__file__).parents[1])]
    code = f"import sys; sys.path[:0] = {homes!r}; import test_registration as t; print(t.digest())"
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert other.stdout.strip() == expected


@pytest.mark.parametrize("prior", [np.eye(3), np.full((4, 4), np.nan), np.diag([1, 1, np.inf, 1]), np.zeros(6)])
def test_a_prior_that_is_no_pose_is_refused(prior: Floats) -> None:
    registration = in_room()
    with pytest.raises(InputError, match="motion prior"):
        registration.register(room(np.random.default_rng(1)).astype(np.float32), prior)


@pytest.mark.parametrize("metres", [0.0, 2.9, 8.9, -5.0])
def test_the_first_step_is_found_beside_posts_that_repeat(metres: float) -> None:
    """A road with a crash barrier on posts every 4 m and a few bridges: at 30 m/s the nearest agreement is a false one."""
    rng = np.random.default_rng(0)

    def view(x: float) -> NDArray[np.float32]:
        """What a sensor at (x, 0, 1.7) sees, in its own frame."""
        road = np.column_stack([rng.uniform(-60, 60, 20_000) + x, rng.uniform(-12, 12, 20_000), np.zeros(20_000)])
        posts = np.arange(-80, 80, 4.0)
        barrier = np.column_stack(
            [
                rng.choice(posts, 6000) + rng.uniform(-0.15, 0.15, 6000),
                rng.choice([-8.0, 8.0], 6000),
                rng.uniform(0, 1, 6000),
            ]
        )
        bridge = np.column_stack([rng.choice([-33.0, 37.0], 3000), rng.uniform(-9, 9, 3000), rng.uniform(4, 6, 3000)])
        points = np.concatenate([road, barrier, bridge]) + rng.normal(0, 0.02, (29_000, 3)) - [x, 0, 1.7]
        return points[np.abs(points[:, 0]) < 60].astype(np.float32)

    registration = Registration()
    registration.register(view(0.0))
    result = registration.register(view(metres))
    assert result.ok
    np.testing.assert_allclose(result.T_world_lidar[:3, 3], [metres, 0, 0], atol=0.03)


def cluttered_room(turn: float) -> NDArray[np.float32]:
    """Boxes of one to three decimetres, up to half a metre from the walls of a room of 3 m, seen turned about z."""
    rng = np.random.default_rng(3)
    centres, sizes, axis = rng.uniform(-1.5, 1.5, (400, 3)), rng.uniform(0.05, 0.15, (400, 3)), rng.integers(0, 3, 400)
    centres[np.arange(400), axis] = rng.choice([-1.5, 1.5], 400) * (1 - 0.3 * rng.random(400))
    faces = rng.uniform(-1, 1, (400, 60, 3))
    np.put_along_axis(faces, rng.integers(0, 3, (400, 60, 1)), rng.choice([-1.0, 1.0], (400, 60, 1)), axis=2)
    points = (centres[:, None] + sizes[:, None] * faces).reshape(-1, 3)
    points += rng.normal(0, 0.01, points.shape)
    return (points @ so3.exp(np.array([0.0, 0.0, turn]))).astype(np.float32)


@pytest.mark.parametrize(("voxel_m", "shares", "atol"), [(0.8, (0.1, 0.3), 0.1), (0.15, (0.5, 0.8), 0.02)])
def test_a_scan_is_judged_by_what_the_first_one_has_on_its_own_surfaces(
    voxel_m: float, shares: tuple[float, float], atol: float
) -> None:
    """Few points agree with planes of 0.8 m in a small room, at the true pose, too; small voxels find the pose."""
    preprocess = PreprocessConfig(range_min=0.1, map_leaf=0.375 * voxel_m)
    registration = Registration(RegistrationConfig(voxel_size=voxel_m), preprocess)
    registration.register(cluttered_room(0.0))
    usual = registration.history.matches.usual
    assert shares[0] < usual < shares[1]
    result = registration.register(cluttered_room(0.02))
    assert result.ok
    assert result.inlier_share > 0.9 * usual
    np.testing.assert_allclose(se3.log(result.T_world_lidar), [0, 0, 0, 0, 0, 0.02], atol=atol)


@pytest.mark.parametrize(("share", "is_sparse"), [(0.09, False), (0.11, True)])
def test_a_tenth_of_the_points_beyond_a_voxel_between_rings_makes_a_sparse_sensor(
    share: float, is_sparse: bool
) -> None:
    """Rings two degrees apart lie a voxel apart at a distance of 28.6 voxels."""
    registration = Registration(RegistrationConfig(residual="point"), PreprocessConfig(ring_gap_deg=2.0))
    limit = registration.map.fine.size / np.deg2rad(2.0)
    distances = np.where(np.arange(1000) < 1000 * share, 1.01, 0.99) * limit
    source = distances[:, None] * [0.6, -0.64, 0.48]
    prepared = PreparedPoints(np.zeros((0, 3), np.float32), source, np.zeros((1000, 6)), 1000)
    found = registration.target.ready(prepared).gaps
    assert (found is not None) == is_sparse
    if found is not None:
        np.testing.assert_allclose(found, np.deg2rad(2.0) * distances)
