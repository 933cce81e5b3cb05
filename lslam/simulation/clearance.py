"""Whether a path is one that a body could take: above the ground, outside of buildings, with bends it can hold."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.errors import UsageError
from lslam.simulation.city import City
from lslam.simulation.lidar import RayScene
from lslam.simulation.scene_mesh import Surface

Floats = NDArray[np.float64]

SOLID = (Surface.ROAD, Surface.PAVEMENT, Surface.LAWN, Surface.WALL, Surface.GLASS, Surface.ROOF)
NAMES = {Surface.ROAD: "the ground", Surface.PAVEMENT: "the ground", Surface.LAWN: "the ground"}
HALF_WIDTH = 0.7  # m on both sides of the path that must be free as well
LOWEST = 0.3  # m above the ground
STEP = 0.05  # s


def check_path(scene: RayScene, city: City, poses: Callable[[NDArray[Any]], Floats], duration: float) -> None:
    """Raise UsageError naming the place where a path, 0..`duration` s, enters the ground or a building.

    Three lines are followed, the path and one on either side of it: whatever solid lies between two instants is crossed.
    """
    times = np.arange(0.0, duration, STEP)
    T = poses(times)
    height = T[:, 2, 3] - city.terrain.height(T[:, :2, 3])
    low = np.flatnonzero(height < LOWEST)
    if len(low):
        _fail("comes within 0.3 m of the ground or below it", T, int(low[0]))
    _check_start(scene, T[0])
    for aside in (0.0, HALF_WIDTH, -HALF_WIDTH):
        line = T[:, :3, 3] + aside * T[:, :3, 1]
        step = np.diff(line, axis=0)
        length = np.linalg.norm(step, axis=1)
        moving = np.flatnonzero(length > 1e-6)
        rays = (step[moving] / length[moving, None]).astype(np.float32)
        far, face = scene.cast(line[moving].astype(np.float32), rays)
        met = np.flatnonzero((far < length[moving]) & np.isin(scene.mesh.surfaces[face], SOLID))
        if len(met):
            surface = Surface(scene.mesh.surfaces[face[met[0]]])
            _fail(f"crosses {NAMES.get(surface, 'a building')}", T, int(moving[met[0]]))


def check_bends(curvature: Floats, s: Floats, speed: float, limit: float) -> None:
    """Raise UsageError where a bend taken at `speed` m/s needs more than `limit` m/s2 across; arrays (M,), 1/m and m."""
    needed = speed**2 * np.abs(curvature)
    worst = int(np.argmax(needed))
    if needed[worst] > limit:
        raise UsageError(
            f"the path bends with a radius of {1 / abs(curvature[worst]):.1f} m at {s[worst]:.0f} m along: {speed:g} m/s needs "
            f"{needed[worst]:.1f} m/s2 there, more than the {limit:g} allowed: use a lower --speed, or way-points farther apart"
        )


def _check_start(scene: RayScene, T: Floats) -> None:
    """Nothing solid above the start: inside a building one would be under its roof."""
    up = np.array([[0.0, 0.0, 1.0]], np.float32)
    _, face = scene.cast(T[None, :3, 3].astype(np.float32), up)
    if face[0] >= 0 and scene.mesh.surfaces[face[0]] in (Surface.WALL, Surface.ROOF, Surface.LAWN):
        _fail("starts inside a building or below the ground", T[None], 0)


def _fail(what: str, T: Floats, index: int) -> None:
    along = float(np.linalg.norm(np.diff(T[: index + 1, :3, 3], axis=0), axis=1).sum())
    x, y, z = T[index, :3, 3]
    raise UsageError(
        f"the path {what}, {along:.0f} m along at x = {x:.1f}, y = {y:.1f}, z = {z:.1f} m: move its way-points"
    )
