"""LiDAR measurement model: rays that meet a scene become points with noise, resolution, losses and intensity."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Bools, Floats
from lslam.core.geometry import portable
from lslam.core.labels import CLASSES
from lslam.core.types.scan import Scan
from lslam.simulation.lidar_models import LidarModel
from lslam.simulation.returns import Errors, Hits, Rays, Returns, errors, mirror_indices, penetrate, range_walk, reflect
from lslam.simulation.scene_mesh import LOOKS, RayScene, Surface, is_glass

REFLECTIVITY = np.array([LOOKS[surface].reflectivity for surface in Surface], np.float32)
# Class of each surface, where it stands and where it moves.
LABELS = np.array([[CLASSES[LOOKS[surface].label] for surface in Surface], [0] * len(Surface)], np.uint16)
for _surface in (Surface.CAR, Surface.PANE, Surface.PERSON):
    LABELS[1, _surface] = CLASSES[f"moving-{LOOKS[_surface].label}"]
# Light that a rough surface, its facets tilted by 0.6 rad, sends back where it came from: A cos + B sin^2 of the incidence
# (Oren and Nayar 1994). KITTI's intensities of roads hardly fall from 4 m to 20 m, as they would by the cosine alone.
ROUGH_A, ROUGH_B = 1 - 0.5 * 0.36 / (0.36 + 0.33), 0.45 * 0.36 / (0.36 + 0.09)


MOVES = -2  # in place of a face, which is of the city; others that are of none are -1
BODY_STEP = 0.004  # s between the poses of a moving body


@dataclass(frozen=True)
class Roof:
    """Roof of the vehicle below the LiDAR, level in its frame: extents behind, ahead, to either side, and depth below, m.

    returns : whether the roof gives points, or only occludes the ground
    """

    behind: float
    ahead: float
    aside: float
    below: float
    returns: bool = False

    def reach(self, directions: NDArray[np.float32], heights: NDArray[np.float32]) -> NDArray[np.float32]:
        """Distance (N,), m, at which unit rays (N, 3) from `heights` (N,), m, above the LiDAR's origin end on it, else inf."""
        fall = (self.below + heights) / np.maximum(-directions[:, 2], np.float32(1e-6))
        x, y = fall * directions[:, 0], fall * directions[:, 1]
        blocked = (x > -self.behind) & (x < self.ahead) & (np.abs(y) < self.aside)
        return np.where(blocked, fall, np.float32(np.inf)).astype(np.float32)


@dataclass(frozen=True)
class MovingMesh:
    """Body that moves during a scan: its mesh in its own frame, T_city_body at times (M,), s, and a bounding sphere.

    radius : of a sphere round the body's origin that holds all of it, m; speed : largest, m/s
    centre : (3,) its origin at the stamp of the scan, in the city frame, m
    """

    scene: RayScene
    poses: Callable[[NDArray[Any]], Floats]
    radius: float
    speed: float
    centre: Floats


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
    returns: Returns | None = None,
    has_one_instant: bool | None = None,
) -> Scan:
    """Simulate one scan of `model`.

    T_city_lidar : (4, 4) one pose for all rays (a motion-compensated scan, without times), or (columns, 4, 4) the pose at
        each firing (a distorted scan: points in the LiDAR frame of their own instant, times from 0 to `period` s)
    rng : source of noise and losses
    bodies : moving objects; a ray hits them at their poses when it is fired (at `stamp_ns` in a compensated scan)
    glass : share of the rays on a pane that pass it and hit objects behind
    roof : of the vehicle that carries the LiDAR, which occludes the ground
    returns : effects of real surfaces and beams; None for clean, sharp ones
    has_one_instant : whether all rays are fired at `stamp_ns`, whatever the poses; None: when there is one pose

    Returns The measured points, with intensity 0..1 in steps of 0.01, rings, classes and, for distorted scans, times.
    """
    # A stream of its own: without these effects every scan stays as it is.
    extra = rng.spawn(1)[0] if returns is not None else rng
    directions, true = _directions(model, rng, index, period)
    poses = np.asarray(T_city_lidar, np.float64)
    moving = poses.ndim == 3 if has_one_instant is None else not has_one_instant
    column, ring = np.divmod(np.arange(model.rays), model.rings)
    since = column * (period / model.columns) + model.firing[ring] if moving else np.zeros(model.rays)
    rays = _into_city(model, true, poses, period, stamp_ns / 1e9 + since)
    meeting = Meeting(scene, bodies, stamp_ns / 1e9, None if returns is None else returns.extinction, extra)
    hits = meeting.meet(rays, model.rings)
    lucky = rng.random(model.rays) < glass if glass > 0 else np.zeros(0, np.bool_)
    if len(lucky) or (returns is not None and returns.mirror > 0):
        _leave_panes(meeting, rays, hits, lucky, returns)
    heights = model.heights.astype(np.float32)[ring]
    if roof is not None:
        _meet_roof(roof, true, heights, hits)
    wrong = None if returns is None else errors(returns, model, rays, hits, extra)
    seen, distance, intensity = _detect(model, hits, rng, returns, wrong)
    kept = model.sequence[seen[model.sequence]]
    points = directions[kept] * distance[kept, None]
    points[:, 2] += heights[kept]
    times = since[kept].astype(np.float32) if moving else None
    labels = LABELS[(hits.face[kept] == MOVES).astype(np.intp), hits.surface[kept]]
    return Scan(points, stamp_ns, index, intensity[kept], times, ring[kept].astype(np.uint16), labels=labels)


@dataclass(frozen=True)
class Meeting:
    """Objects that the rays of a scan may hit: static ones, those that move about `stamp`, s, and leaves of some `extinction`."""

    scene: RayScene
    bodies: Sequence[MovingMesh]
    stamp: float
    extinction: NDArray[np.float32] | None
    rng: np.random.Generator

    def meet(self, rays: Rays, rings: int = 1) -> Hits:
        """First hits on static and moving objects; the rays come in columns of `rings`."""
        mesh = self.scene.mesh
        distance, face = self.scene.cast(rays.origins, rays.directions)
        cosine = np.abs(np.einsum("ij,ij->i", mesh.normals[face], rays.directions))
        hits = Hits(distance, cosine, mesh.surfaces[face], face)
        if self.extinction is not None:
            penetrate(self.scene.cast, mesh, rays, hits, self.extinction, self.rng)
        if self.bodies and len(distance):
            _meet_bodies(self.bodies, rays, rings, hits, self.stamp)
        return hits


def _meet_bodies(bodies: Sequence[MovingMesh], rays: Rays, rings: int, hits: Hits, stamp: float) -> None:
    """Replace `hits` by closer ones on bodies, posed at `stamp`, s; rings : of a whole scan, rays column after column; else 1."""
    centres = np.stack([body.centre for body in bodies])
    lasting = float(rays.times.max()) - stamp
    # Body and LiDAR both move while the sweep lasts; a millimetre for the rounding.
    radii = np.array([body.radius + 1e-3 + body.speed * lasting for body in bodies])
    candidates = _by_column(centres, radii, rays, rings) if rings > 1 else _by_ray(centres, radii, rays, hits)
    for body, near in zip(bodies, candidates, strict=True):
        if not len(near):
            continue
        to = (body.centre - rays.origins[near]).astype(np.float32)
        along = np.einsum("ij,ij->i", to, rays.directions[near])
        aside = np.einsum("ij,ij->i", to, to) - along**2
        # Each ray knows where it starts and when.
        reached = (body.radius + 1e-3 + body.speed * (rays.times[near] - stamp)).astype(np.float32)
        near = near[(along > -reached) & (aside < reached**2) & (along < hits.distance[near] + reached)]
        if len(near):
            _meet_body(body, near, rays[near], hits, stamp)


def _by_column(centres: Floats, radii: Floats, rays: Rays, rings: int) -> Iterator[NDArray[np.intp]]:
    """For each body, the rays of a scan that may hit it: those within `radii` (B,), m, of its centre (B, 3)."""
    # Bearings of whole columns first: a body is met by few of them, and then by few of their rings.
    bearing = portable.arctan2(rays.directions[:, 1], rays.directions[:, 0]).reshape(-1, rings)
    middle = bearing[:, rings // 2]
    spread = np.abs(_wrap_angle(bearing - middle[:, None])).max(axis=1)
    climb = rays.directions[:, 2].reshape(-1, rings)
    apart = sum(float(np.ptp(axis)) for axis in rays.origins.T)
    to = centres - rays.origins[len(rays.times) // 2]
    reach, level, away = radii + apart, portable.hypot(to[:, 0], to[:, 1]), portable.norm(to)
    aside = portable.arcsin(reach / np.maximum(level, reach))
    rise, tilt = portable.arctan2(to[:, 2], level), portable.arcsin(reach / np.maximum(away, reach)) + 1e-3
    lowest, highest = (portable.sin(np.clip(rise + k * tilt, -np.pi / 2, np.pi / 2)) for k in (-1, 1))
    for i, towards in enumerate(portable.arctan2(to[:, 1], to[:, 0]).astype(np.float32)):
        if level[i] <= reach[i]:
            yield np.arange(len(rays.times))
            continue
        columns = np.flatnonzero(np.abs(_wrap_angle(middle - towards)) <= aside[i] + spread)
        upright = climb[columns]
        at, ring = np.nonzero((upright >= lowest[i]) & (upright <= highest[i]))
        yield columns[at] * rings + ring


def _by_ray(centres: Floats, radii: Floats, rays: Rays, hits: Hits) -> Iterator[NDArray[np.intp]]:
    """For each body, the rays of any origin that may hit it: those within `radii` (B,), m, of its centre (B, 3)."""
    # Relative to their middle single precision is good for centimetres, which `reach` allows.
    middle = rays.origins.mean(axis=0, dtype=np.float64)
    start, at = (rays.origins - middle).astype(np.float32), (centres - middle).astype(np.float32)
    reach = radii.astype(np.float32)[:, None] + np.float32(0.05)
    # No matrix product: BLAS would wake its threads for three columns.
    along = np.einsum("bi,ni->bn", at, rays.directions)
    along -= np.einsum("ij,ij->i", start, rays.directions)
    apart2 = np.einsum("bi,ni->bn", at, -2 * start)
    apart2 += np.einsum("ij,ij->i", start, start)
    apart2 += np.sum(at**2, axis=1)[:, None]
    may = np.abs(apart2) < (np.minimum(np.float32(1e4), hits.distance) + reach) ** 2 + reach
    apart2 -= along**2
    may &= (apart2 < reach**2) & (along > -reach)
    return iter([np.flatnonzero(row) for row in may])


def _meet_body(body: MovingMesh, which: NDArray[np.intp], rays: Rays, hits: Hits, stamp: float) -> None:
    """Intersect the rays `which` with a body at its pose when each of them is fired; closer hits replace `hits`.

    rays : of `which` alone, city frame; stamp : s, of the scan, on the clock of the rays and the body
    """
    # Between instants of a few milliseconds it moves on evenly, to micrometres; they do not hang on which rays are tried.
    share = (rays.times - stamp) / BODY_STEP
    at = share.astype(np.intp)
    first = int(at.min())
    T = body.poses(stamp + BODY_STEP * np.arange(first, int(at.max()) + 2))
    T = T[at - first] + (share - at)[:, None, None] * (T[at - first + 1] - T[at - first])
    R, centre = T[:, :3, :3].astype(np.float32), T[:, :3, 3]
    R = np.swapaxes(R, -1, -2)
    local = portable.rotate(R, rays.directions)
    start = portable.rotate(R, (rays.origins - centre).astype(np.float32))
    far, face = body.scene.cast(start, local)
    nearer = far < hits.distance[which]
    met, face = which[nearer], face[nearer]
    hits.distance[met] = far[nearer]
    hits.cosine[met] = np.abs(np.einsum("ij,ij->i", body.scene.mesh.normals[face], local[nearer]))
    hits.surface[met] = body.scene.mesh.surfaces[face]
    hits.face[met] = MOVES


def _meet_roof(roof: Roof, directions: NDArray[np.float32], heights: NDArray[np.float32], hits: Hits) -> None:
    """Replace `hits` by hits on the vehicle's own roof, or by none if it returns no points; rays in the LiDAR's frame."""
    reach = roof.reach(directions, heights)
    met = np.flatnonzero(np.isfinite(reach))
    hits.distance[met] = reach[met] if roof.returns else np.inf
    hits.cosine[met] = -directions[met, 2]
    hits.surface[met] = Surface.CAR
    hits.face[met] = -1


def _wrap_angle(angle: NDArray[np.float32]) -> NDArray[np.float32]:
    """Angles wrapped to half a turn about zero, rad."""
    return np.asarray(angle - np.float32(2 * np.pi) * np.round(angle / np.float32(2 * np.pi)), np.float32)


def _leave_panes(meeting: Meeting, rays: Rays, hits: Hits, lucky: Bools, returns: Returns | None) -> None:
    """Reflect some of the rays that hit panes, and let the others among `lucky` (N,) pass; `hits` and `lucky` are updated.

    A reflected ray measures a point behind the pane. A passing ray hits the next object; a second pane stops it.
    """
    off = np.zeros(0, np.intp)
    if returns is not None and returns.mirror > 0:
        off = mirror_indices(returns, hits, meeting.scene.mesh.normals, meeting.rng)
    if len(lucky):
        lucky[off] = False
    through = np.flatnonzero(lucky & is_glass(hits.surface) & np.isfinite(hits.distance)) if len(lucky) else off[:0]
    # A centimetre behind the pane or before it, so that it is not met again.
    start = np.concatenate([hits.distance[through] + np.float32(0.01), hits.distance[off] - np.float32(0.01)])
    onward = rays[through].after(start[: len(through)])
    if len(off):
        turned = reflect(rays[off], start[len(through) :], meeting.scene.mesh.normals[hits.face[off]])
        onward = onward.with_more(turned)
    which = np.append(through, off)
    if not len(which):
        return
    met = meeting.meet(onward)
    hits.distance[which] = start + met.distance
    hits.cosine[which] = met.cosine
    hits.surface[which] = met.surface
    hits.face[which] = met.face


def _directions(
    model: LidarModel, rng: np.random.Generator, index: int, period: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(columns * rings, 3) unit rays in the LiDAR frame, column after column: nominal ones, and those with angular errors."""
    azimuth, elevation = model.beams(index, period)
    noise = rng.standard_normal((2, model.columns, model.rings), np.float32) * np.float32(
        np.radians(model.angle_noise_deg)
    )
    a = azimuth.astype(np.float32) + noise[0]
    e = elevation.astype(np.float32) + noise[1]
    said = _unit(a, e)
    return said, _unit(a, e + model.ring_errors[1].astype(np.float32)) if model.ring_tilt_deg else said


def _unit(azimuth: NDArray[np.float32], elevation: NDArray[np.float32]) -> NDArray[np.float32]:
    """Unit vectors (N, 3) by azimuth and elevation, rad."""
    (sine, cosine), (rise, flat) = portable.sine_cosine(azimuth), portable.sine_cosine(elevation)
    both = np.stack([flat * cosine, flat * sine, rise], axis=-1)
    return np.asarray(both.reshape(-1, 3))


def _into_city(
    model: LidarModel,
    directions: NDArray[np.float32],
    poses: Floats,
    period: float,
    times: Floats,
) -> Rays:
    """Rays (N, 3) of the LiDAR in the city frame, by one pose (4, 4) or a pose (columns, 4, 4) per column.

    directions : (N, 3) unit vectors, LiDAR frame; period : s per turn; times : (columns,) s
    """
    by_column = directions.reshape(model.columns, model.rings, 3)
    lift = np.outer(model.heights, [0, 0, 1]).astype(np.float32)
    R, t = poses[..., :3, :3].astype(np.float32), poses[..., :3, 3].astype(np.float32)
    origins = t[..., None, :] + portable.product(lift, np.swapaxes(R, -1, -2))
    towards = portable.product(by_column, np.swapaxes(R, -1, -2))
    if poses.ndim == 3 and model.firing_us:
        # Between two columns it moves on evenly: what is left out of a turn of w in 50 us is (w 50 us)^2 / 2.
        share = (model.firing * model.columns / period).astype(np.float32)[:, None]
        step_R, step_t = _on(np.diff(poses[:, :3, :3], axis=0)), _on(np.diff(poses[:, :3, 3], axis=0))
        origins = origins + share * step_t[:, None]
        towards = towards + share * portable.product(by_column, np.swapaxes(step_R, -1, -2))
    spread = np.broadcast_to(origins, by_column.shape)
    return Rays(spread.reshape(-1, 3), towards.reshape(-1, 3), times)


def _on(steps: Floats) -> NDArray[np.float32]:
    """Steps from each pose to the next, float32; the last step is repeated, so that there is one per pose."""
    return np.concatenate([steps, steps[-1:]]).astype(np.float32)


def _detect(
    model: LidarModel, hits: Hits, rng: np.random.Generator, returns: Returns | None, wrong: Errors | None
) -> tuple[Bools, NDArray[np.float32], NDArray[np.float32]]:
    """Mask of the rays that return, their measured ranges, m, and intensities, 0..1.

    The echo's peak is that of a diffuse surface: reflectivity times the cosine of incidence over the range squared. The
    intensity is that of the whole echo, which a slanted surface stretches, without the range: what drivers report.
    """
    distance = hits.distance
    noise = rng.standard_normal(len(distance), np.float32) * np.float32(model.range_noise)
    off = noise + np.tile(model.ring_errors[0].astype(np.float32), model.columns) if model.ring_bias else noise
    chance = rng.random(len(distance), np.float32)
    seen = (distance >= model.range_min) & (distance <= model.range_max)
    r = np.where(seen, distance, np.float32(1))
    colour = REFLECTIVITY[hits.surface] * hits.cosine
    if returns is not None and wrong is not None:
        colour = colour * wrong.gain
        off = off + wrong.late + (range_walk(returns, colour) if returns.walk else 0)
    echo = colour / np.float32(0.1) * (np.float32(model.range_10pct) / r) ** 2
    # Half of the echoes of a quarter of the reference strength are lost.
    seen &= chance < (1 - model.dropout) * echo**2 / (echo**2 + np.float32(0.0625))
    step = np.float32(model.range_step)
    measured = np.maximum(np.round((r + off) / step) * step, np.float32(model.range_min))
    rough = np.float32(ROUGH_A) * hits.cosine + np.float32(ROUGH_B) * (1 - hits.cosine**2)
    shade = REFLECTIVITY[hits.surface] * rough / np.float32(ROUGH_A)
    intensity = np.clip(np.round(shade * (1 + 2 * noise) * 100) / 100, 0, 1).astype(np.float32)
    return seen, measured.astype(np.float32), intensity
