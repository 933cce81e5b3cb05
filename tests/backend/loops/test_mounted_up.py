"""Up by the first keyframes of a sensor that lies, whose single scans see lines of the ground and no more."""

from __future__ import annotations

import numpy as np
import pytest
from known_town import pose, seen, town
from numpy.typing import NDArray

from lslam.backend.keyframes.store import GROUND_KEYFRAMES, KeyframeStore, mounted_up
from lslam.core.config.input import PreprocessConfig
from lslam.core.geometry import se3, so3
from lslam.core.types.trajectory import Keyframe
from lslam.registration.preprocessing.ground import AXIS, Z, find_up

# Of a sensor of 16 rings.
HALF_FIELD = np.deg2rad(15.0)


def drive(rpy_deg: tuple[float, float, float], count: int = GROUND_KEYFRAMES) -> KeyframeStore:
    """Keyframes of a drive along a street, of a sensor mounted so, in the world of the first."""
    world, store = town(), KeyframeStore()
    mounting = se3.make(so3.from_euler_rpy(np.deg2rad(rpy_deg)), np.zeros(3))
    poses = [pose(-20 + 2.2 * k, -45) @ mounting for k in range(count)]
    for k, T in enumerate(poses):
        points = seen(world, T, np.random.default_rng(k))
        inside = np.abs(points[:, 2]) < np.sin(HALF_FIELD) * np.linalg.norm(points, axis=1)
        store.add(Keyframe(k, k, k, se3.relative(poses[0], T)), points[inside][::5])
    return store


def up_of(store: KeyframeStore, config: PreprocessConfig | None = None) -> NDArray[np.float64]:
    poses = np.array([k.T_world_lidar for k in store.keyframes]).reshape(-1, 4, 4)
    return mounted_up(store, poses, config or PreprocessConfig())


@pytest.mark.parametrize(
    "rpy_deg", [(0.0, 60.0, 0.0), (0.0, -60.0, 0.0), (0.0, 90.0, 0.0), (90.0, 0.0, 45.0), (180.0, 0, 0)]
)
def test_ten_keyframes_show_the_ground_that_one_does_not(rpy_deg: tuple[float, float, float]) -> None:
    store = drive(rpy_deg)
    true = so3.from_euler_rpy(np.deg2rad(rpy_deg))[2]
    if rpy_deg[0] != 180:
        assert find_up(store.points(0)) == AXIS
    assert np.rad2deg(np.arccos(up_of(store) @ true)) < 2.0


def test_a_sensor_that_stands_has_z() -> None:
    assert np.array_equal(up_of(drive((0.0, 20.0, 0.0), 3)), Z)
    assert np.array_equal(up_of(KeyframeStore()), Z)


def test_what_is_configured_is_up_at_the_first_keyframe() -> None:
    store = KeyframeStore()
    T = se3.make(so3.exp(np.array([0.2, 0.0, 0.0])), np.zeros(3))
    store.add(Keyframe(0, 0, 0, T), np.zeros((0, 3), np.float32))
    np.testing.assert_allclose(up_of(store, PreprocessConfig(up=(0.0, 3.0, 0.0))), T[:3, 1])
