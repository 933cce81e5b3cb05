"""Beams in leaves: crowns and hedges are volumes, in which a beam ends at a depth drawn by Beer and Lambert's law."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from lslam.simulation.rays import Hits, Rays
from lslam.simulation.scene_mesh import SceneMesh, Surface

Cast = Callable[[NDArray[np.float32], NDArray[np.float32]], tuple[NDArray[np.float32], NDArray[np.int32]]]

LAYERS = 8  # surfaces of volumes that a beam passes, at most
_BEYOND = np.float32(1e-3)  # m behind a surface from which a ray goes on
VOLUMES = (Surface.CROWN, Surface.HEDGE)


def penetrate(
    cast: Cast, mesh: SceneMesh, rays: Rays, hits: Hits, extinction: NDArray[np.float32], rng: np.random.Generator
) -> None:
    """Let the rays whose `hits` are surfaces of volumes end at a leaf in them, or at what is in or behind them.

    cast : first hits of rays on `mesh`, whose volumes are wound outwards; extinction : (surfaces,) 1/m, of volumes

    A volume's transmission over x m is exp(-extinction x) (Ross 1981): the optical depth that a beam gets through is
    exponential of mean 1. It is drawn for every ray of the scan, so what one ray meets does not change another's leaf.
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


def _enters(mesh: SceneMesh, face: NDArray[np.int32], directions: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Whether rays go into a volume, not out of it, at its faces (N,)."""
    return np.asarray(np.einsum("ij,ij->i", mesh.normals[face], directions) < 0)


def _leaf(hits: Hits, which: NDArray[np.intp], at: NDArray[np.float32], facing: NDArray[np.float32]) -> None:
    """Leaves face every way alike: the cosine of incidence is uniform."""
    hits.distance[which] = at
    hits.cosine[which] = facing[which]
    hits.surface[which] = Surface.FOLIAGE
    hits.face[which] = -1


def _solid(
    mesh: SceneMesh, rays: Rays, hits: Hits, which: NDArray[np.intp], at: NDArray[np.float32], face: NDArray[np.int32]
) -> None:
    hits.distance[which] = at
    hits.cosine[which] = np.abs(np.einsum("ij,ij->i", mesh.normals[face], rays.directions[which]))
    hits.surface[which] = mesh.surfaces[face]
    hits.face[which] = face
