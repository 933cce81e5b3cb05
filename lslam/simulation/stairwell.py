"""A stairwell of two storeys between an entrance hall and a corridor without any feature along it, and the way through."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.geometry import portable
from lslam.simulation.city import City
from lslam.simulation.curve import RouteCurve, smooth_curve
from lslam.simulation.scene_mesh import MeshBuilder, Surface
from lslam.simulation.terrain import Terrain

Floats = NDArray[np.float64]

# DIN 18065: twice the rise and the run are 0.63 m.
RISE, RUN, STEPS = 0.17, 0.29, 9  # m, m, of a flight; two of them a storey
STOREYS = 2
FLIGHT = RUN * STEPS
WIDTH, WALL = 1.7, 0.2  # m, of a flight and of the wall between two
LANDING = 2.0
HALF = WIDTH + WALL / 2  # m from the middle of the shaft to its walls
ROOM = 2.7  # m, clear height
TOP = 2 * STOREYS * STEPS * RISE
ENTRANCE = (9.0, 7.0)  # m along the way in and across
CORRIDOR = 2.4  # m wide
# It is open at both ends, and beyond them there is nothing that a LiDAR sees: what tells how far along one is, is the
# stairwell alone, and that is soon out of sight.
BEHIND, AHEAD = 30.0, 70.0  # m of corridor
WALKED = 36.0  # m of it that are walked
TURNING = WIDTH / 2 + WALL / 2  # m, radius of the turns on the landings


def stairs_line(above: float) -> tuple[RouteCurve, tuple[Floats, Floats]]:
    """In, round and round up the flights, and out along the corridor; distances and heights, m, `above` the floor."""
    parts: list[Floats] = []  # (K, 3) each
    xs, ys = np.array([-LANDING - 5.0, 0.0]), np.full(2, -TURNING)
    parts.append(np.column_stack([xs, ys, np.zeros(2)]))
    bend = np.linspace(-np.pi / 2, np.pi / 2, 13)
    for storey in range(STOREYS):
        low = 2 * storey * STEPS * RISE
        half, full = low + STEPS * RISE, low + 2 * STEPS * RISE
        turn = np.column_stack([FLIGHT + TURNING * portable.cos(bend), TURNING * portable.sin(bend), np.full(13, half)])
        parts += [turn, np.array([[0.0, TURNING, full]])]
        if storey + 1 < STOREYS:
            parts.append(
                np.column_stack([-TURNING * portable.cos(bend), -TURNING * portable.sin(bend), np.full(13, full)])
            )
    # Out of the landing ahead, then to the right along the corridor.
    x = -LANDING - CORRIDOR / 2
    out = np.linspace(0, np.pi / 2, 7)
    parts.append(np.column_stack([x + 1.0 - portable.sin(out), TURNING + 1.0 - portable.cos(out), np.full(7, TOP)]))
    parts.append(np.array([[x, TURNING + WALKED, TOP]]))
    points = np.concatenate(parts)
    points = points[np.append(True, np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1) > 1e-6)]
    line = smooth_curve(points[:, :2], False, 0.3)
    s = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1)))
    return line, (s * line.length / s[-1], points[:, 2] + above)


def build_stairwell(line: RouteCurve, terrain: Terrain, rng: np.random.Generator) -> City:
    """The building round `stairs_line`; what stands about in it differs from seed to seed."""
    builder = MeshBuilder()
    _add_entrance(builder, rng)
    _add_shaft(builder)
    for storey in range(STOREYS):
        _add_flights(builder, 2 * storey * STEPS * RISE)
    for z in STEPS * RISE * np.arange(1, 2 * STOREYS, 2):
        _add_cabinet(builder, float(z), rng)
    _add_corridor(builder)
    x = (-LANDING - CORRIDOR, FLIGHT + LANDING)
    outline = np.array([[x[0], -HALF], [x[1], -HALF], [x[1], HALF], [x[0], HALF]])
    return City(builder.build(), terrain, line, [outline], [TOP + ROOM])


def _floor(builder: MeshBuilder, x: tuple[float, float], y: tuple[float, float], z: float) -> None:
    """A slab without a thickness, seen from above and below."""
    corners = [[x[0], y[0], z], [x[1], y[0], z], [x[1], y[1], z], [x[0], y[1], z]]
    # Concrete: the class of walls and roofs above a start would be those of a building that one is caught in.
    builder.add_quads([corners], Surface.PAVEMENT)


def _wall(builder: MeshBuilder, a: tuple[float, float], b: tuple[float, float], z: tuple[float, float]) -> None:
    """A wall without a thickness from place `a` to `b`."""
    builder.add_quads([[[*a, z[0]], [*b, z[0]], [*b, z[1]], [*a, z[1]]]], Surface.WALL)


def _add_entrance(builder: MeshBuilder, rng: np.random.Generator) -> None:
    """A hall before the stairs, with a few boxes and two columns beside the way."""
    (length, across), x = ENTRANCE, -LANDING
    y = across / 2
    _floor(builder, (x - length, x), (-y, y), 0.0)
    _floor(builder, (x - length, x), (-y, y), ROOM + 0.3)
    for a, b in (((x - length, -y), (x - length, y)), ((x - length, -y), (x, -y)), ((x - length, y), (x, y))):
        _wall(builder, a, b, (0.0, ROOM + 0.3))
    for a, b in (((x, -y), (x, -HALF)), ((x, 0.1), (x, y))):
        _wall(builder, a, b, (0.0, ROOM + 0.3))
    for at in (x - 2.5, x - 6.0):
        low = np.array([at + rng.uniform(-0.5, 0.5), rng.uniform(0.8, 1.5), 0.0])
        builder.add_box(low, low + np.array([0.35, 0.35, ROOM + 0.3]), Surface.WALL)
    for _ in range(3):
        size = rng.uniform([0.3, 0.3, 0.4], [1.2, 0.7, 1.6])
        low = np.array([x - rng.uniform(1.5, length - 1.5), y - size[1], 0.0])
        builder.add_box(low, low + size, Surface.FENCE)


def _add_shaft(builder: MeshBuilder) -> None:
    """The walls round the stairs and the one between the flights, with the two ways in and out left open."""
    end, top = FLIGHT + LANDING, TOP + ROOM
    for y in (-HALF, HALF):
        _wall(builder, (-LANDING, y), (end, y), (0.0, top))
    _wall(builder, (end, -HALF), (end, HALF), (0.0, top))
    builder.add_box([0.0, -WALL / 2, 0.0], [FLIGHT, WALL / 2, top], Surface.WALL)
    # Before the ground floor's landing one comes in on the right, at the top one leaves on the left.
    _wall(builder, (-LANDING, 0.1), (-LANDING, HALF), (0.0, TOP))
    _wall(builder, (-LANDING, -HALF), (-LANDING, 0.1), (ROOM + 0.3, top))
    _floor(builder, (-LANDING, 0.0), (-HALF, HALF), 0.0)
    _floor(builder, (-LANDING, end), (-HALF, HALF), top)


def _add_flights(builder: MeshBuilder, low: float) -> None:
    """Two flights of steps, each a tread and a riser, and the landings they lead to."""
    half = low + STEPS * RISE
    for k in range(STEPS):
        for first, z, away, y in (
            (k * RUN, low + k * RISE, 1, (-HALF, 0.0)),
            (FLIGHT - k * RUN, half + k * RISE, -1, (0.0, HALF)),
        ):
            x = sorted((first, first + away * RUN))
            _wall(builder, (first, y[0]), (first, y[1]), (z, z + RISE))
            _floor(builder, (x[0], x[1]), y, z + RISE)
    _floor(builder, (FLIGHT, FLIGHT + LANDING), (-HALF, HALF), half)
    _floor(builder, (-LANDING, 0.0), (-HALF, HALF), half + STEPS * RISE)


def _add_cabinet(builder: MeshBuilder, z: float, rng: np.random.Generator) -> None:
    """A cabinet of a fire hose on the wall of a half landing, beyond where one turns."""
    end, y = FLIGHT + LANDING, rng.uniform(-1.0, 0.4)
    builder.add_box([end - 0.15, y, z + 0.6], [end, y + 0.6, z + 1.4], Surface.FENCE)


def _add_corridor(builder: MeshBuilder) -> None:
    """Two walls, a floor and a ceiling; in the wall towards the stairs nothing but the way out of them."""
    x, y = (-LANDING - CORRIDOR, -LANDING), (TURNING - BEHIND, TURNING + AHEAD)
    z = (TOP, TOP + ROOM)
    _floor(builder, x, y, z[0])
    _floor(builder, x, y, z[1])
    _wall(builder, (x[0], y[0]), (x[0], y[1]), z)
    _wall(builder, (x[1], y[0]), (x[1], 0.1), z)
    _wall(builder, (x[1], HALF), (x[1], y[1]), z)
