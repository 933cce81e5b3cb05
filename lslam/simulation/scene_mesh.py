"""Triangle meshes with a surface class per face, a builder that collects them part by part, and rays on them (Embree)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Bools, Floats, Ints, Longs
from lslam.core.geometry import portable


class Surface(IntEnum):
    """Class of a face's surface; it determines the LiDAR's intensity and losses."""

    ROAD = 0
    PAVEMENT = 1
    LAWN = 2
    WALL = 3
    GLASS = 4
    ROOF = 5
    FOLIAGE = 6
    TRUNK = 7
    POLE = 8
    CAR = 9
    FENCE = 10
    PERSON = 11
    CROWN = 12  # of leaves that fill a volume; so is a hedge
    HEDGE = 13
    PANE = 14  # glass of a vehicle


Colour = tuple[int, int, int]


class SurfaceLook(NamedTuple):
    """What a surface looks like.

    reflectivity : share of the light of a 905 nm laser that comes back where it is met squarely
    label : class of its points; colour, plan_colour : red, green, blue in images of a camera, and in a plan. Colours of a camera
        are apart from one another by more than exposure and noise.
    """

    reflectivity: float
    label: str
    colour: Colour
    plan_colour: Colour


LOOKS = {
    Surface.ROAD: SurfaceLook(0.35, "road", (95, 95, 100), (96, 96, 100)),
    Surface.PAVEMENT: SurfaceLook(0.40, "sidewalk", (165, 160, 150), (168, 166, 160)),
    Surface.LAWN: SurfaceLook(0.45, "terrain", (60, 150, 50), (206, 220, 184)),
    Surface.WALL: SurfaceLook(0.45, "building", (215, 160, 100), (182, 120, 96)),
    Surface.GLASS: SurfaceLook(0.03, "building", (60, 90, 170), (120, 160, 176)),
    Surface.ROOF: SurfaceLook(0.25, "building", (170, 60, 40), (168, 92, 74)),
    Surface.FOLIAGE: SurfaceLook(0.45, "vegetation", (35, 95, 40), (88, 136, 70)),
    Surface.TRUNK: SurfaceLook(0.30, "trunk", (105, 70, 40), (104, 78, 54)),
    Surface.POLE: SurfaceLook(0.40, "pole", (205, 205, 60), (20, 20, 20)),
    Surface.CAR: SurfaceLook(0.35, "car", (200, 30, 130), (50, 76, 150)),
    Surface.FENCE: SurfaceLook(0.35, "fence", (150, 110, 180), (90, 80, 70)),
    Surface.PERSON: SurfaceLook(0.35, "person", (240, 120, 20), (200, 0, 160)),
    Surface.CROWN: SurfaceLook(0.45, "vegetation", (90, 130, 20), (80, 130, 64)),
    Surface.HEDGE: SurfaceLook(0.45, "vegetation", (20, 110, 90), (68, 118, 54)),
    # Clear to a camera: what is behind it is the car as well.
    Surface.PANE: SurfaceLook(0.03, "car", (200, 30, 130), (124, 150, 170)),
}


def is_glass(surfaces: NDArray[np.uint8]) -> Bools:
    """(N,) whether surfaces let light through, of houses or of vehicles."""
    return np.asarray((surfaces == Surface.GLASS) | (surfaces == Surface.PANE))


@dataclass(frozen=True)
class SceneMesh:
    """Triangles: vertices (V, 3) float32, m; faces (F, 3) int32 indices; surfaces (F,) uint8 values of `Surface`."""

    vertices: NDArray[np.float32]
    faces: Ints
    surfaces: NDArray[np.uint8]

    @cached_property
    def normals(self) -> NDArray[np.float32]:
        """(F, 3) unit face normals; zero for degenerate faces. Their sign is not defined."""
        a, b, c = (self.vertices[self.faces[:, k]].astype(np.float64) for k in range(3))
        cross = np.cross(b - a, c - a)
        length = np.linalg.norm(cross, axis=1, keepdims=True)
        return np.asarray(cross / np.where(length > 0, length, 1), np.float32)


class MeshBuilder:
    """Collects meshes in one frame; `build` joins them."""

    def __init__(self) -> None:
        self._vertices: list[NDArray[Any]] = []
        self._faces: list[NDArray[Any]] = []
        self._surfaces: list[NDArray[np.uint8]] = []
        self._count = 0

    def add(self, vertices: NDArray[Any], faces: NDArray[Any], surfaces: int | NDArray[np.uint8]) -> None:
        """Add vertices (V, 3), m, and faces (F, 3) that index them, of one surface or one per face."""
        self._vertices.append(np.asarray(vertices, np.float64))
        self._faces.append(np.asarray(faces, np.int64) + self._count)
        self._surfaces.append(np.broadcast_to(np.asarray(surfaces, np.uint8), len(faces)))
        self._count += len(vertices)

    def add_quads(self, corners: Any, surface: int) -> None:
        """Add quadrilaterals (N, 4, 3), corners in order round each."""
        corners = np.asarray(corners, np.float64).reshape(-1, 4, 3)
        first = 4 * np.arange(len(corners))[:, None]
        faces = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])
        self.add(corners.reshape(-1, 3), faces, surface)

    def add_grid(self, xy: Floats, z: Floats, surface: int) -> None:
        """Add a sheet through a grid of places (R, C, 2) at heights (R, C), m."""
        self.add(grid_vertices(xy, z), grid_faces(*z.shape), surface)

    def add_box(self, low: Any, high: Any, surface: int) -> None:
        """Add an axis-aligned box between two corners (3,)."""
        self.add(*box(low, high), surface)

    def add_mesh(self, mesh: SceneMesh, position: Any = (0, 0, 0), yaw: float = 0.0) -> None:
        """Add a mesh rotated by `yaw` (rad, about z) and moved to `position` (3,), m."""
        c, s = portable.cos(yaw), portable.sin(yaw)
        turned = portable.product(mesh.vertices, np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]))
        self.add(turned + np.asarray(position, np.float64), mesh.faces, mesh.surfaces)

    def build(self) -> SceneMesh:
        """All parts as one mesh."""
        if not self._faces:
            return SceneMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros(0, np.uint8))
        return SceneMesh(
            np.concatenate(self._vertices).astype(np.float32),
            np.concatenate(self._faces).astype(np.int32),
            np.concatenate(self._surfaces),
        )


def box(low: Any, high: Any) -> tuple[Floats, Longs]:
    """Vertices (8, 3) and faces (12, 3) of the axis-aligned box between two corners."""
    pair = np.array([low, high], np.float64)
    corners = np.array([[pair[i, 0], pair[j, 1], pair[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    sides = np.array([[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]])
    return corners, np.concatenate([sides[:, [0, 1, 2]], sides[:, [0, 2, 3]]])


def tube(radius_low: float, radius_high: float, bottom: float, top: float, sides: int) -> tuple[Floats, Longs]:
    """Vertices (2 sides, 3), m, and faces (2 sides, 3) of an open vertical tube round the z axis, possibly conical.

    radius_low, radius_high : m, at z = `bottom` and z = `top`, m; sides : quadrangles round it
    """
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack([portable.cos(angle), portable.sin(angle)], axis=1)
    low = np.column_stack([radius_low * ring, np.full(sides, bottom)])
    high = np.column_stack([radius_high * ring, np.full(sides, top)])
    here, there = np.arange(sides), (np.arange(sides) + 1) % sides
    faces = np.concatenate(
        [np.stack([here, there, there + sides], 1), np.stack([here, there + sides, here + sides], 1)]
    )
    return np.concatenate([low, high]), faces


def grid_vertices(xy: Floats, z: Floats) -> Floats:
    """Vertices (R * C, 3) of a grid of places (R, C, 2) at heights (R, C), row by row."""
    return np.concatenate([xy, z[..., None]], -1).reshape(-1, 3)


def grid_faces(rows: int, columns: int) -> Longs:
    """Faces of a (rows x columns) grid of vertices stored row by row: two per cell, cell after cell."""
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    both = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=2)
    return np.asarray(both.reshape(-1, 3))


class RayScene:
    """A mesh prepared for ray casting."""

    def __init__(self, mesh: SceneMesh) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self.mesh = mesh
        self._scene = EmbreeScene()
        self._geometry = TriangleMesh(self._scene, mesh.vertices, mesh.faces)

    def cast(self, origins: NDArray[np.float32], directions: NDArray[np.float32]) -> tuple[NDArray[np.float32], Ints]:
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
