"""Effects of real surfaces and optics on returns: grass, texture, beam width, mixed pixels, biases, losses.

Everything here acts on arrays of one scan, after the rays are cast. A beam of divergence g (full angle at 1/e2 of the middle's
light) lights a spot whose standard deviation at r is r g / 4.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from lslam.core.arrays import Bools, Floats, Ints
from lslam.core.config.input import Section
from lslam.core.geometry import portable
from lslam.simulation.lidar_models import LidarModel
from lslam.simulation.scene_mesh import SceneMesh, Surface, is_glass

Cast = Callable[[NDArray[np.float32], NDArray[np.float32]], tuple[NDArray[np.float32], Ints]]
LAYERS = 8  # surfaces of volumes that a beam passes, at most
_BEYOND = np.float32(1e-3)  # m behind a surface from which a ray goes on
VOLUMES = (Surface.CROWN, Surface.HEDGE)
Array = NDArray[np.float32]
BUMP_M = 0.15  # m of one bump of a surface's texture
FLATTEST = 0.1  # cosine of incidence: what is met still flatter errs no more than there
REFERENCE = 0.4  # share of light that comes back at which a LiDAR's ranges are calibrated
SLANT = 2.0  # times the step of a slanted surface between two rays: more is an edge
_TABLE = 1 << 16
_TEXTURES = {
    "ground": (Surface.ROAD, Surface.PAVEMENT, Surface.LAWN),
    "walls": (Surface.WALL, Surface.ROOF, Surface.FENCE, Surface.TRUNK),
}


@dataclass(frozen=True)
class Rays:
    """Rays in the city frame: origins, m, and unit directions (N, 3), and firing times (N,), s."""

    origins: NDArray[np.float32]
    directions: NDArray[np.float32]
    times: Floats

    def __getitem__(self, which: NDArray[np.intp]) -> Rays:
        return Rays(self.origins[which], self.directions[which], self.times[which])

    def with_more(self, others: Rays) -> Rays:
        """The rays followed by `others`, in one object."""
        return Rays(
            np.concatenate([self.origins, others.origins]),
            np.concatenate([self.directions, others.directions]),
            np.concatenate([self.times, others.times]),
        )

    def after(self, distance: NDArray[np.float32]) -> Rays:
        """Rays that start `distance` (N,), m, further on."""
        return Rays(self.origins + distance[:, None] * self.directions, self.directions, self.times)


@dataclass(frozen=True)
class Hits:
    """First hits of rays: distance (N,), m, inf for none; cosine of incidence (N,); surface class (N,).

    face : (N,) of the static scene, below 0 for no hit, a leaf, or a moving body
    """

    distance: NDArray[np.float32]
    cosine: NDArray[np.float32]
    surface: NDArray[np.uint8]
    face: Ints


def penetrate(
    cast: Cast, mesh: SceneMesh, rays: Rays, hits: Hits, extinction: NDArray[np.float32], rng: np.random.Generator
) -> None:
    """Let rays that hit volumes of leaves end at a leaf inside, or at the first object in or behind the volume.

    cast : first hits of rays on `mesh`, whose volumes are wound outwards; extinction : (surfaces,) 1/m, of volumes

    A volume's transmission over x m is exp(-extinction x) (Ross 1981): the optical depth that a beam penetrates is
    exponential of mean 1. It is drawn for every ray of the scan, so that rays are independent of each other's hits.
    """
    depth = rng.standard_exponential(len(hits.distance), np.float32)
    facing = rng.random(len(hits.distance), np.float32)
    inside = np.zeros(len(Surface), np.bool_)
    inside[list(VOLUMES)] = True
    which = np.flatnonzero(inside[hits.surface] & (hits.face >= 0))
    at, left = hits.distance[which], depth[which]
    face, thick = hits.face[which], extinction[hits.surface[which]]
    count = np.where(_enters(mesh, face, rays.directions[which]), 1, 0)
    for _ in range(LAYERS):
        if not len(which):
            return
        onward = rays[which].after(at + _BEYOND)
        far, following = cast(onward.origins, onward.directions)
        leg = far + _BEYOND
        dense = np.where(count > 0, thick, np.float32(0))
        with np.errstate(invalid="ignore"):
            passed = np.where(dense > 0, dense * leg, np.float32(0))
        ends = left < passed
        _leaf(hits, which[ends], (at[ends] + left[ends] / dense[ends]).astype(np.float32), facing)
        surface = mesh.surfaces[following]
        goes_on = ~ends & (following >= 0) & inside[surface]
        stops = ~ends & ~goes_on
        _solid(mesh, rays, hits, which[stops], at[stops] + leg[stops], following[stops])
        entering = _enters(mesh, following[goes_on], rays.directions[which[goes_on]])
        thick = np.where(entering, extinction[surface[goes_on]], thick[goes_on])
        count = np.maximum(count[goes_on] + np.where(entering, 1, -1), 0)
        at, left = at[goes_on] + leg[goes_on], left[goes_on] - passed[goes_on]
        which = which[goes_on]
    _leaf(hits, which, at, facing)


def _enters(mesh: SceneMesh, face: Ints, directions: NDArray[np.float32]) -> Bools:
    """(N,) whether a ray enters a volume at its face, rather than leaving it."""
    return np.asarray(np.einsum("ij,ij->i", mesh.normals[face], directions) < 0)


def _leaf(hits: Hits, which: NDArray[np.intp], at: NDArray[np.float32], facing: NDArray[np.float32]) -> None:
    """Set hits on leaves at random orientations: the cosine of incidence is uniform."""
    hits.distance[which] = at
    hits.cosine[which] = facing[which]
    hits.surface[which] = Surface.FOLIAGE
    hits.face[which] = -1


def _solid(
    mesh: SceneMesh, rays: Rays, hits: Hits, which: NDArray[np.intp], at: NDArray[np.float32], face: Ints
) -> None:
    """Set hits of the rays `which` on faces of a mesh, at the distances `at`, m."""
    hits.distance[which] = at
    hits.cosine[which] = np.abs(np.einsum("ij,ij->i", mesh.normals[face], rays.directions[which]))
    hits.surface[which] = mesh.surfaces[face]
    hits.face[which] = face


class Returns(Section):
    """Deviations of returns from those of clean, sharp surfaces; all are off by default.

    crown_extinction, hedge_extinction : of beams in leaves, 1/m, where `layout.volumes` makes crowns and hedges volumes: half
        the leaf area in a cubic metre (Beer and Lambert's law with leaves facing every way, Ross 1981)
    grass : standard deviation of the half-normal heights at which a lawn returns beams, m
    ground_texture, wall_texture : standard deviation of the surface itself, the same on every visit, m
    divergence_mrad : width of the beam, which errs on slanted surfaces and straddles edges; HDL-64E about 2, VLP-16 about 3
    pulse : m along the beam within which two echoes merge into one between them, half the length of the pulse (Adams and
        Probert 1996, Tuley et al. 2005): mixed pixels; HDL-64E 0.75
    incidence_bias : m by which a beam at 60 deg to the normal is measured too long, growing as 1/cos - 1 (Laconte et al. 2019)
    walk : m by which half as bright a surface is measured too long, the range walk of a fixed threshold (Amann et al. 2001)
    mirror : share of the light that a pane mirrors when met squarely, more when met flat (Schlick 1994)
    paint : exponent of the cosine by which car bodies and panes, which shine, return less than diffuse surfaces do
    attenuation : of light in the air, 1/m, there and back: 3.9 over the visibility (Koschmieder 1924)
    calibration : times the errors that each laser's calibration left, `ring_bias` and `ring_tilt_deg` of the LiDAR
    """

    crown_extinction: float = Field(1.2, gt=0, le=50)
    hedge_extinction: float = Field(5.0, gt=0, le=50)
    grass: float = Field(0.0, ge=0, le=1)
    ground_texture: float = Field(0.0, ge=0, le=0.2)
    wall_texture: float = Field(0.0, ge=0, le=0.2)
    divergence_mrad: float = Field(0.0, ge=0, le=20)
    pulse: float = Field(0.0, ge=0, le=5)
    incidence_bias: float = Field(0.0, ge=-0.5, le=0.5)
    walk: float = Field(0.0, ge=-0.2, le=0.2)
    mirror: float = Field(0.0, ge=0, le=1)
    paint: float = Field(0.0, ge=0, le=50)
    attenuation: float = Field(0.0, ge=0, le=0.1)
    calibration: float = Field(1.0, ge=0, le=20)

    @property
    def is_on(self) -> bool:
        """Whether any effect is on."""
        return self != Returns()

    @property
    def extinction(self) -> Array:
        """(surfaces,) extinction of beams in the volume behind each surface, 1/m; 0 for opaque surfaces."""
        table = np.zeros(len(Surface), np.float32)
        table[Surface.CROWN], table[Surface.HEDGE] = self.crown_extinction, self.hedge_extinction
        return table


@dataclass(frozen=True)
class Errors:
    """Errors of the echoes of N rays: range error of each, m, and remaining share of its light."""

    late: Array
    gain: Array


def errors(returns: Returns, model: LidarModel, rays: Rays, hits: Hits, rng: np.random.Generator) -> Errors:
    """Range errors and intensity gains of the hits of `rays` of one scan, column after column."""
    cosine: Array = np.clip(hits.cosine, np.float32(FLATTEST), np.float32(1)).astype(np.float32)
    distance: Array = np.where(np.isfinite(hits.distance), hits.distance, 0).astype(np.float32)
    slant: Array = (np.sqrt(1 - cosine**2) / cosine).astype(np.float32)
    late = np.zeros_like(distance)
    if returns.divergence_mrad > 0:
        spot = np.float32(returns.divergence_mrad * 1e-3 / 4) * distance
        late += rng.standard_normal(len(late), np.float32) * spot * slant
    if returns.incidence_bias:
        late += (returns.incidence_bias * (1 / cosine - 1)).astype(np.float32)
    if returns.grass > 0:
        lawn = np.flatnonzero(hits.surface == Surface.LAWN)
        blades = np.abs(rng.standard_normal(len(lawn), np.float32)) * np.float32(returns.grass)
        late[lawn] -= np.minimum(blades / cosine[lawn], distance[lawn] / 2)
    for deviation, surfaces in zip((returns.ground_texture, returns.wall_texture), _TEXTURES.values(), strict=True):
        if deviation > 0:
            has_texture = np.zeros(len(Surface), np.bool_)
            has_texture[list(surfaces)] = True
            met = np.flatnonzero(has_texture[hits.surface] & (distance > 0))
            place = (rays.origins[met] + distance[met, None] * rays.directions[met]).astype(np.float32)
            late[met] += np.float32(deviation) * texture(place) / cosine[met]
    if returns.divergence_mrad > 0 and returns.pulse > 0:
        late += mixed_pixels(returns, model, hits.distance, slant, rng)
    return Errors(late, _gain(returns, hits, distance))


def range_walk(returns: Returns, brightness: Array) -> Array:
    """(N,) range error, m, of surfaces of some `brightness` (N,), the share of light that they return."""
    dimmer = portable.log(np.float32(REFERENCE) / np.clip(brightness, np.float32(0.02), np.float32(1))) / np.log(2)
    return np.asarray(np.float32(returns.walk) * dimmer, np.float32)


def texture(places: Array) -> Array:
    """(N,) standard normal surface heights at (N, 3) places, m: one per cell of `BUMP_M` m, the same on every visit."""
    cell = np.floor(places / np.float32(BUMP_M)).astype(np.int32)
    # Teschner et al. 2003, a hash of cells in space; int32 wraps.
    mix = cell[:, 0] * np.int32(73856093) ^ cell[:, 1] * np.int32(19349663) ^ cell[:, 2] * np.int32(83492791)
    return np.asarray(_bumps()[(mix ^ (mix >> 15)) & (_TABLE - 1)])


@cache
def _bumps() -> Array:
    """Table of standard normal numbers for surface heights."""
    return np.random.default_rng(_TABLE).standard_normal(_TABLE, np.float32)


def mixed_pixels(returns: Returns, model: LidarModel, distance: Array, slant: Array, rng: np.random.Generator) -> Array:
    """(N,) range error, m, of beams that straddle an edge.

    An edge somewhere between two columns is within the spot of one of the two rays beside it with the probability of the
    spot's width over the columns' spacing. Most of that ray's light, half at least, is on its own side, and the one echo of
    both surfaces lies between them by the shares of light.
    """
    spacing = 2 * np.pi / model.columns
    chance = np.float32(min(returns.divergence_mrad * 1e-3 / spacing, 1.0) / 2)
    by_column = distance.reshape(model.columns, model.rings)
    draw = rng.random(by_column.shape, np.float32)
    share = rng.random(by_column.shape, np.float32) / 2
    out = np.zeros_like(by_column)
    slope = np.float32(SLANT * spacing) * slant.reshape(by_column.shape)
    with np.errstate(invalid="ignore"):  # the sky is infinitely far
        edge = np.float32(0.05) + by_column * slope
        for shift, low in ((1, 0.0), (-1, 0.5)):
            # Each side has its half of the draws.
            gap = np.roll(by_column, shift, axis=0) - by_column
            wide = np.abs(gap)
            met = (draw >= low) & (draw < low + chance) & (wide > edge) & (wide < np.float32(returns.pulse))
            out[met] = share[met] * gap[met]
    return out.ravel()


def mirror_indices(returns: Returns, hits: Hits, normals: Array, rng: np.random.Generator) -> NDArray[np.intp]:
    """Indices of the rays that a pane of the static scene mirrors; `normals` (F, 3) of its faces."""
    panes = np.flatnonzero(is_glass(hits.surface) & np.isfinite(hits.distance) & (hits.face >= 0))
    share = returns.mirror + (1 - returns.mirror) * portable.power(1 - hits.cosine[panes], 5)
    lucky = rng.random(len(panes), np.float32) < share
    met = np.linalg.norm(normals[hits.face[panes]], axis=1) > 0
    return np.asarray(panes[lucky & met])


def reflect(rays: Rays, distance: Array, normals: Array) -> Rays:
    """Rays (N,) reflected at `distance` (N,), m, by faces with `normals` (N, 3)."""
    along = np.einsum("ij,ij->i", rays.directions, normals)
    directions = rays.directions - 2 * along[:, None] * normals
    return Rays(rays.origins + distance[:, None] * rays.directions, directions, rays.times)


def _gain(returns: Returns, hits: Hits, distance: Array) -> Array:
    """(N,) factor on the light of echoes: attenuation in the air, and shiny surfaces met at an angle."""
    gain = portable.exp(np.float32(-2 * returns.attenuation) * distance)
    if returns.paint > 0:
        shiny = np.flatnonzero((hits.surface == Surface.CAR) | is_glass(hits.surface))
        gain[shiny] *= portable.power(hits.cosine[shiny], returns.paint)
    return np.asarray(gain, np.float32)
