"""Rays against a mesh (Embree), and what a LiDAR makes of them: noise, resolution, losses, intensity."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.simulation.lidar_models import LidarModel
from lslam.simulation.mesh import Mesh, Surface
from lslam.types.scan import Scan

# Share of the light of a 905 nm laser that comes back from each surface met squarely.
REFLECTIVITY = np.zeros(len(Surface), np.float32)
for _surface, _share in {
    Surface.ROAD: 0.18,
    Surface.PAVEMENT: 0.28,
    Surface.LAWN: 0.40,
    Surface.WALL: 0.45,
    Surface.GLASS: 0.03,
    Surface.ROOF: 0.25,
    Surface.FOLIAGE: 0.45,
    Surface.TRUNK: 0.30,
    Surface.POLE: 0.40,
    Surface.CAR: 0.35,
    Surface.FENCE: 0.35,
}.items():
    REFLECTIVITY[_surface] = _share


class RayScene:
    """A mesh prepared for ray casting."""

    def __init__(self, mesh: Mesh) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self.mesh = mesh
        self._scene = EmbreeScene()
        self._geometry = TriangleMesh(self._scene, mesh.vertices, mesh.faces)

    def cast(
        self, origins: NDArray[np.float32], directions: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """First hits of rays (N, 3) with unit directions: distances (N,), m, inf where nothing is hit, and faces (N,) or -1."""
        hit = self._scene.run(np.ascontiguousarray(origins), np.ascontiguousarray(directions), output=1)
        faces = np.asarray(hit["primID"], np.int32)
        return np.where(faces >= 0, hit["tfar"], np.float32(np.inf)), faces


def trace(
    scene: RayScene,
    model: LidarModel,
    T_city_lidar: NDArray[Any],
    rng: np.random.Generator,
    index: int = 0,
    stamp_ns: int = 0,
    period: float = 0.1,
) -> Scan:
    """One scan of `model`.

    Parameters
    ----------
    T_city_lidar : (4, 4) one pose for all rays (a motion-compensated scan, without times), or (columns, 4, 4) the pose at
        each firing (a distorted scan: points in the LiDAR frame of their own instant, times from 0 to `period` s)
    rng : source of noise and losses

    Returns
    -------
    The points that came back, with intensity 0..1 in steps of 0.01, rings and, for distorted scans, times.
    """
    directions = _directions(model, rng)
    poses = np.asarray(T_city_lidar, np.float64)
    moving = poses.ndim == 3
    origins, world = _into_city(directions, poses, moving)
    distance, face = scene.cast(origins, world)
    seen, distance, intensity = _detect(scene.mesh, model, world, distance, face, rng)
    column, ring = np.divmod(np.arange(model.rays), model.rings)
    if model.order == "ring":
        order = np.argsort(ring, kind="stable")
        kept = order[seen[order]]
    else:
        kept = np.flatnonzero(seen)
    points = directions[kept] * distance[kept, None]
    times = (column[kept] * (period / model.columns)).astype(np.float32) if moving else None
    return Scan(points, stamp_ns, index, intensity[kept], times, ring[kept].astype(np.uint16))


def _directions(model: LidarModel, rng: np.random.Generator) -> NDArray[np.float32]:
    """(columns * rings, 3) unit rays in the LiDAR frame, column after column, with the noise of the angles."""
    azimuth, elevation = model.angles
    noise = rng.standard_normal((2, model.columns, model.rings), np.float32) * np.float32(
        np.radians(model.angle_noise_deg)
    )
    a = azimuth.astype(np.float32)[:, None] + noise[0]
    e = elevation.astype(np.float32) + noise[1]
    flat = np.cos(e)
    return np.asarray(np.stack([flat * np.cos(a), flat * np.sin(a), np.sin(e)], axis=-1).reshape(-1, 3))


def _into_city(
    directions: NDArray[np.float32], poses: NDArray[np.float64], moving: bool
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Origins and directions (N, 3) of the rays in the city frame."""
    R, t = poses[..., :3, :3].astype(np.float32), poses[..., :3, 3].astype(np.float32)
    if not moving:
        return np.broadcast_to(t, directions.shape), directions @ R.T
    by_column = directions.reshape(len(poses), -1, 3)
    return np.repeat(t, by_column.shape[1], axis=0), (by_column @ np.swapaxes(R, -1, -2)).reshape(-1, 3)


def _detect(
    mesh: Mesh,
    model: LidarModel,
    directions: NDArray[np.float32],
    distance: NDArray[np.float32],
    face: NDArray[np.int32],
    rng: np.random.Generator,
) -> tuple[NDArray[np.bool_], NDArray[np.float32], NDArray[np.float32]]:
    """Which rays return, their measured ranges and intensities.

    The echo is that of a diffuse surface: reflectivity times the cosine of incidence over the range squared.
    """
    noise = rng.standard_normal(len(face), np.float32) * np.float32(model.range_noise)
    chance = rng.random(len(face), np.float32)
    seen = (face >= 0) & (distance >= model.range_min) & (distance <= model.range_max)
    r = np.where(seen, distance, np.float32(1))
    square = np.abs(np.einsum("ij,ij->i", mesh.normals[face], directions))
    colour = REFLECTIVITY[mesh.surfaces[face]] * square
    echo = colour / np.float32(0.1) * (np.float32(model.range_10pct) / r) ** 2
    # Half of the echoes of a quarter of the reference strength are lost.
    seen &= chance < (1 - model.dropout) * echo**2 / (echo**2 + np.float32(0.0625))
    step = np.float32(model.range_step)
    measured = np.maximum(np.round((r + noise) / step) * step, np.float32(model.range_min))
    intensity = np.clip(np.round(colour * (1 + 2 * noise) * 100) / 100, 0, 1).astype(np.float32)
    return seen, measured.astype(np.float32), intensity
