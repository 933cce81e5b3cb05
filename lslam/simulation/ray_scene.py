"""Rays against a triangle mesh (Embree)."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lslam.geometry import portable
from lslam.simulation.scene_mesh import SceneMesh
from lslam.types.arrays import Floats


class RayScene:
    """A mesh prepared for ray casting."""

    def __init__(self, mesh: SceneMesh) -> None:
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
        distances = np.full(len(faces), np.inf, np.float32)
        met = np.flatnonzero(faces >= 0)
        # Embree's arithmetic is the processor's: which face is met is taken from it, where follows from the face.
        normals, offsets = self._planes
        square, towards = normals[faces[met]], directions[met].astype(np.float64)
        height = offsets[faces[met]] - portable.dot(square, origins[met].astype(np.float64))
        descent = portable.dot(square, towards)
        with np.errstate(divide="ignore", invalid="ignore"):
            distances[met] = np.where(descent != 0, height / descent, hit["tfar"][met])
        return distances, faces

    @cached_property
    def _planes(self) -> tuple[Floats, Floats]:
        """Normals (F, 3) of any length and offsets (F,) of the planes of the faces."""
        a, b, c = (self.mesh.vertices[self.mesh.faces[:, k]].astype(np.float64) for k in range(3))
        normals = np.cross(b - a, c - a)
        return normals, portable.dot(normals, a)
