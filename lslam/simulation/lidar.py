"""Rays against a mesh (Embree), and what a LiDAR makes of them: noise, resolution, losses, intensity."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
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
    Surface.PERSON: 0.35,
}.items():
    REFLECTIVITY[_surface] = _share


@dataclass(frozen=True)
class Roof:
    """The roof under a LiDAR, level in its frame, m: behind, ahead, to either side, and how far below."""

    behind: float
    ahead: float
    aside: float
    below: float

    def blocks(self, directions: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Which rays (N, 3) from the LiDAR end on it."""
        down = np.maximum(-directions[:, 2], np.float32(1e-6))
        x, y = self.below * directions[:, 0] / down, self.below * directions[:, 1] / down
        return np.asarray((x > -self.behind) & (x < self.ahead) & (np.abs(y) < self.aside))


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


@dataclass(frozen=True)
class MovingMesh:
    """A body that moves while rays fly: its scene in its own frame, T_city_body at times (M,), s, and a circle round it.

    radius : of a sphere round the body's origin that holds all of it, m; speed : the most it gets on, m/s
    """

    scene: RayScene
    poses: Callable[[NDArray[Any]], NDArray[np.float64]]
    radius: float
    speed: float


@dataclass(frozen=True)
class _Hits:
    """What rays meet first: distance (N,), m, inf for nothing; cosine of incidence (N,); surface (N,)."""

    distance: NDArray[np.float32]
    cosine: NDArray[np.float32]
    surface: NDArray[np.uint8]


def trace(
    scene: RayScene,
    model: LidarModel,
    T_city_lidar: NDArray[Any],
    rng: np.random.Generator,
    index: int = 0,
    stamp_ns: int = 0,
    period: float = 0.1,
    bodies: Sequence[MovingMesh] = (),
    glass: float = 0.0,
    roof: Roof | None = None,
) -> Scan:
    """One scan of `model`.

    Parameters
    ----------
    T_city_lidar : (4, 4) one pose for all rays (a motion-compensated scan, without times), or (columns, 4, 4) the pose at
        each firing (a distorted scan: points in the LiDAR frame of their own instant, times from 0 to `period` s)
    rng : source of noise and losses
    bodies : what moves, each ray meets it where it is when that ray is fired (at `stamp_ns` in a compensated scan)
    glass : share of the rays on a pane that pass it and go on to what is behind
    roof : of the vehicle that carries the LiDAR; what it is in the way of gives nothing

    Returns
    -------
    The points that came back, with intensity 0..1 in steps of 0.01, rings and, for distorted scans, times.
    """
    directions, true = _directions(model, rng, index)
    poses = np.asarray(T_city_lidar, np.float64)
    moving = poses.ndim == 3
    origins, world = _into_city(true, poses, moving)
    column, ring = np.divmod(np.arange(model.rays), model.rings)
    fired = stamp_ns / 1e9 + (column * (period / model.columns) if moving else np.zeros(model.rays))
    hits = _meet(scene, origins, world)
    _meet_bodies(bodies, origins, world, fired, model.rings, hits)
    if glass > 0:
        _pass_glass(scene, origins, world, hits, rng.random(model.rays) < glass)
    if roof is not None:
        hits.distance[roof.blocks(true)] = np.inf
    seen, distance, intensity = _detect(model, hits, rng)
    if model.order == "ring":
        order = np.argsort(ring, kind="stable")
        kept = order[seen[order]]
    else:
        kept = np.flatnonzero(seen)
    points = directions[kept] * distance[kept, None]
    times = (column[kept] * (period / model.columns)).astype(np.float32) if moving else None
    return Scan(points, stamp_ns, index, intensity[kept], times, ring[kept].astype(np.uint16))


def _meet(scene: RayScene, origins: NDArray[np.float32], directions: NDArray[np.float32]) -> _Hits:
    """First hits on what stands."""
    distance, face = scene.cast(origins, directions)
    cosine = np.abs(np.einsum("ij,ij->i", scene.mesh.normals[face], directions))
    return _Hits(distance, cosine, scene.mesh.surfaces[face])


def _meet_bodies(
    bodies: Sequence[MovingMesh],
    origins: NDArray[np.float32],
    directions: NDArray[np.float32],
    fired: NDArray[np.float64],
    rings: int,
    hits: _Hits,
) -> None:
    """Put hits on what moves into `hits` where they are nearer."""
    if not bodies:
        return
    # Bearings of whole columns first: a body is met by few of them.
    bearing = np.arctan2(directions[:, 1], directions[:, 0]).reshape(-1, rings)
    middle = bearing[:, rings // 2]
    spread = np.abs(_turned(bearing - middle[:, None])).max(axis=1)
    half = len(fired) // 2
    for body in bodies:
        centre = body.poses(fired[half : half + 1])[0, :3, 3]
        # Body and LiDAR both move while the sweep lasts.
        reach = body.radius + body.speed * float(np.ptp(fired)) + float(np.abs(origins[-1] - origins[0]).sum())
        dx, dy, _ = (centre - origins[half]).tolist()
        share = reach / max(float(np.hypot(dx, dy)), reach)
        towards = np.abs(_turned(middle - np.float32(np.arctan2(dy, dx)))) <= np.arcsin(share) + spread
        columns = np.flatnonzero(towards | (share == 1.0))
        rays = (columns[:, None] * rings + np.arange(rings)).ravel()
        to = (centre - origins[rays]).astype(np.float32)
        along = np.einsum("ij,ij->i", to, directions[rays])
        aside = np.einsum("ij,ij->i", to, to) - along**2
        rays = rays[(along > -reach) & (aside < reach**2) & (along < hits.distance[rays] + reach)]
        if len(rays):
            _meet_body(body, rays, origins, directions, fired, hits)


def _meet_body(
    body: MovingMesh,
    rays: NDArray[np.intp],
    origins: NDArray[np.float32],
    directions: NDArray[np.float32],
    fired: NDArray[np.float64],
    hits: _Hits,
) -> None:
    """Each of `rays` against the body where it is when that ray is fired."""
    instants, which = np.unique(fired[rays], return_inverse=True)
    T = body.poses(instants)
    R, centre = T[which, :3, :3].astype(np.float32), T[which, :3, 3]
    local = np.einsum("nji,nj->ni", R, directions[rays])
    start = np.einsum("nji,nj->ni", R, (origins[rays] - centre).astype(np.float32))
    far, face = body.scene.cast(start, local)
    nearer = far < hits.distance[rays]
    at, face = rays[nearer], face[nearer]
    hits.distance[at] = far[nearer]
    hits.cosine[at] = np.abs(np.einsum("ij,ij->i", body.scene.mesh.normals[face], local[nearer]))
    hits.surface[at] = body.scene.mesh.surfaces[face]


def _turned(angle: NDArray[np.float32]) -> NDArray[np.float32]:
    """Angles within half a turn of zero."""
    return np.asarray(angle - np.float32(2 * np.pi) * np.round(angle / np.float32(2 * np.pi)), np.float32)


def _pass_glass(
    scene: RayScene,
    origins: NDArray[np.float32],
    directions: NDArray[np.float32],
    hits: _Hits,
    lucky: NDArray[np.bool_],
) -> None:
    """The `lucky` rays on glass go on to what stands behind it; a second pane stops them."""
    rays = np.flatnonzero(lucky & (hits.surface == Surface.GLASS) & np.isfinite(hits.distance))
    start = hits.distance[rays] + np.float32(0.01)
    onward = _meet(scene, origins[rays] + start[:, None] * directions[rays], directions[rays])
    hits.distance[rays] = start + onward.distance
    hits.cosine[rays] = onward.cosine
    hits.surface[rays] = onward.surface


def _directions(
    model: LidarModel, rng: np.random.Generator, index: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(columns * rings, 3) unit rays in the LiDAR frame, column after column: as it reports them, and as they fly."""
    azimuth, elevation = model.beams(index)
    noise = rng.standard_normal((2, model.columns, model.rings), np.float32) * np.float32(
        np.radians(model.angle_noise_deg)
    )
    a = azimuth.astype(np.float32) + noise[0]
    e = elevation.astype(np.float32) + noise[1]
    said = _unit(a, e)
    return said, _unit(a, e + model.ring_errors[1].astype(np.float32)) if model.ring_tilt_deg else said


def _unit(azimuth: NDArray[np.float32], elevation: NDArray[np.float32]) -> NDArray[np.float32]:
    flat = np.cos(elevation)
    both = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)
    return np.asarray(both.reshape(-1, 3))


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
    model: LidarModel, hits: _Hits, rng: np.random.Generator
) -> tuple[NDArray[np.bool_], NDArray[np.float32], NDArray[np.float32]]:
    """Which rays return, their measured ranges and intensities.

    The echo is that of a diffuse surface: reflectivity times the cosine of incidence over the range squared.
    """
    distance = hits.distance
    noise = rng.standard_normal(len(distance), np.float32) * np.float32(model.range_noise)
    off = noise + np.tile(model.ring_errors[0].astype(np.float32), model.columns) if model.ring_bias else noise
    chance = rng.random(len(distance), np.float32)
    seen = (distance >= model.range_min) & (distance <= model.range_max)
    r = np.where(seen, distance, np.float32(1))
    colour = REFLECTIVITY[hits.surface] * hits.cosine
    echo = colour / np.float32(0.1) * (np.float32(model.range_10pct) / r) ** 2
    # Half of the echoes of a quarter of the reference strength are lost.
    seen &= chance < (1 - model.dropout) * echo**2 / (echo**2 + np.float32(0.0625))
    step = np.float32(model.range_step)
    measured = np.maximum(np.round((r + off) / step) * step, np.float32(model.range_min))
    intensity = np.clip(np.round(colour * (1 + 2 * noise) * 100) / 100, 0, 1).astype(np.float32)
    return seen, measured.astype(np.float32), intensity
