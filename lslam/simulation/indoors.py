"""Rooms under a roof: a hall, a living room, a stairwell with its corridors."""

from __future__ import annotations

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.geometry import portable
from lslam.simulation.city import City
from lslam.simulation.curve import RouteCurve, Terrain, rounded_rectangle, smooth_curve
from lslam.simulation.scene_mesh import MeshBuilder, Surface

HALL_SIDE_M = 12.0  # m from the middle line to the walls
END = 1.0  # m that the hall is longer than its line at either end
HEIGHT = 11.0
BAY = 7.5  # m from column to column, and from beam to beam
AISLE = 7.5  # m on both sides of the middle that are free up to the roof
LOW = 2.2  # m, of what stands in the aisle


def build_hall(line: RouteCurve, terrain: Terrain, rng: np.random.Generator) -> City:
    """Build a hall with racks, boxes, columns and beams round a straight `line` along x, the middle of its floor at z = 0.

    `terrain` is only stored in the city. The hall is its one building.
    """
    ends = line.position(np.array([0.0, line.length]))
    low, high = float(ends[0, 0]) - END, float(ends[1, 0]) + END
    middle = float(ends[0, 1])
    builder = MeshBuilder()
    # What is above a start is no roof that one would be caught under.
    builder.add_box([low, middle - HALL_SIDE_M, -0.3], [high, middle + HALL_SIDE_M, 0.0], Surface.ROAD)
    builder.add_box([low, middle - HALL_SIDE_M, HEIGHT], [high, middle + HALL_SIDE_M, HEIGHT + 0.3], Surface.PAVEMENT)
    for y in (-HALL_SIDE_M, HALL_SIDE_M):
        builder.add_box([low, middle + y - 0.15, 0.0], [high, middle + y + 0.15, HEIGHT], Surface.WALL)
    for x in (low, high):
        builder.add_box([x - 0.15, middle - HALL_SIDE_M, 0.0], [x + 0.15, middle + HALL_SIDE_M, HEIGHT], Surface.WALL)
    for x in np.arange(low + rng.uniform(2, 4), high - 1.0, BAY).tolist():
        builder.add_box(
            [x - 0.15, middle - HALL_SIDE_M, HEIGHT - 0.8], [x + 0.15, middle + HALL_SIDE_M, HEIGHT], Surface.WALL
        )
        for y in (middle - HALL_SIDE_M + 0.4, middle + HALL_SIDE_M - 0.4):
            builder.add_box([x - 0.2, y - 0.25, 0.0], [x + 0.2, y + 0.25, HEIGHT], Surface.WALL)
    for side in (-1, 1):
        _add_racks(builder, low, high, middle, side, rng)
    for x in np.arange(low + 3.0, high - 3.0, 5.0):
        at = np.array([x + rng.uniform(-1.5, 1.5), middle + rng.uniform(-AISLE, AISLE)])
        size = rng.uniform([0.4, 0.4, 0.6], [1.0, 1.0, LOW])
        builder.add_box([*(at - size[:2]), 0.0], [*(at + size[:2]), size[2]], Surface.FENCE)
    outline = np.array(
        [
            [low, middle - HALL_SIDE_M],
            [high, middle - HALL_SIDE_M],
            [high, middle + HALL_SIDE_M],
            [low, middle + HALL_SIDE_M],
        ]
    )
    return City(builder.build(), terrain, line, [outline], [HEIGHT + 0.3])


def _add_racks(
    builder: MeshBuilder, low: float, high: float, middle: float, side: int, rng: np.random.Generator
) -> None:
    """Add racks of different heights and depths between the aisle and one wall, with gaps.

    low, high : m, ends of the hall in x; middle : m, its axis in y; side : 1 for the wall at larger y, else -1
    """
    x = low + rng.uniform(0.5, 3.0)
    while x < high - 3.0:
        length, depth = min(rng.uniform(2.0, 6.0), high - 0.5 - x), rng.uniform(0.8, 2.0)
        front = rng.uniform(AISLE, HALL_SIDE_M - 1.0 - depth)
        y = sorted((middle + side * front, middle + side * (front + depth)))
        builder.add_box([x, y[0], 0.0], [x + length, y[1], rng.uniform(1.5, 6.0)], Surface.FENCE)
        x += length + rng.uniform(0.8, 4.0)


ROOM_M = np.array([5.0, 4.0, 2.6])  # m, clear
LOOP = (1.8, 1.2, 0.5)  # m along and across, and radius of its corners
TABLE = (1.2, 0.7, 0.75)  # m
SHELVES, BOXES = 7, 16


def room_line() -> RouteCurve:
    """Path round the middle of the room."""
    return smooth_curve(rounded_rectangle(*LOOP), closed=True, smoothing=0.1)


def build_room(line: RouteCurve, terrain: Terrain, rng: np.random.Generator) -> City:
    """Build a room with its floor's middle at the origin and furniture at random; `line` is the path in it."""
    builder, half = MeshBuilder(), ROOM_M / 2
    low, high = np.array([-half[0], -half[1], 0.0]), np.array([half[0], half[1], ROOM_M[2]])
    # What is above a start is no roof that one would be caught under.
    for z in (0.0, ROOM_M[2]):
        builder.add_box([low[0], low[1], z - 0.1], [high[0], high[1], z], Surface.PAVEMENT)
    for axis in (0, 1):
        for side in (low, high):
            a, b = low - 0.1, high + 0.1
            a[axis], b[axis], a[2], b[2] = side[axis] - 0.05, side[axis] + 0.05, 0.0, ROOM_M[2]
            builder.add_box(a, b, Surface.WALL)
    _add_shelves(builder, rng)
    corner = half[:2] * rng.choice([-1.0, 1.0], 2)
    _add_table(builder, corner - np.sign(corner) * (np.array(TABLE[:2]) / 2 + 0.05), rng)
    outline = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    return City(builder.build(), terrain, line, [outline], [ROOM_M[2]])


def _add_shelves(builder: MeshBuilder, rng: np.random.Generator) -> None:
    """Add cupboards along the walls, with boxes on top of them."""
    for _ in range(SHELVES):
        axis, side = int(rng.integers(0, 2)), float(rng.choice([-1.0, 1.0]))
        depth, width, height = rng.uniform(0.2, 0.4), rng.uniform(0.4, 1.2), rng.uniform(0.4, 1.9)
        a, b = np.zeros(3), np.zeros(3)
        wall = side * ROOM_M[axis] / 2
        a[axis], b[axis] = sorted((wall, wall - side * depth))
        along = rng.uniform(-1, 1) * (ROOM_M[1 - axis] / 2 - width / 2)
        a[1 - axis], b[1 - axis], b[2] = along - width / 2, along + width / 2, height
        builder.add_box(a, b, Surface.FENCE)
        at = a + (b - a) * rng.uniform(0.1, 0.6, 3)
        at[2] = height
        builder.add_box(at, at + rng.uniform([0.1, 0.1, 0.1], [0.2, 0.2, 0.4]), Surface.FENCE)


def _add_table(builder: MeshBuilder, middle: Floats, rng: np.random.Generator) -> None:
    """Add a table on four legs at `middle` (2,), m, with objects on it."""
    half, top = np.array(TABLE[:2]) / 2, TABLE[2]
    builder.add_box([*(middle - half), top - 0.03], [*(middle + half), top], Surface.FENCE)
    for corner in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        leg = middle + np.array(corner) * (half - 0.05)
        builder.add_box([*(leg - 0.03), 0.0], [*(leg + 0.03), top], Surface.FENCE)
    for _ in range(BOXES):
        at, size = middle + rng.uniform(-0.9, 0.9, 2) * half, rng.uniform([0.04, 0.04, 0.05], [0.15, 0.15, 0.4])
        builder.add_box([*(at - size[:2] / 2), top], [*(at + size[:2] / 2), top + size[2]], Surface.FENCE)


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
WALK_M = 36.0  # m of it that are walked
TURNING = WIDTH / 2 + WALL / 2  # m, radius of the turns on the landings


def stairs_line(above: float) -> tuple[RouteCurve, tuple[Floats, Floats]]:
    """Path into the building, up the flights and out along the corridor; distances, m, and heights, m, `above` the floor."""
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
    parts.append(np.array([[x, TURNING + WALK_M, TOP]]))
    points = np.concatenate(parts)
    points = points[np.append(True, np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1) > 1e-6)]
    line = smooth_curve(points[:, :2], False, 0.3)
    s = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1)))
    return line, (s * line.length / s[-1], points[:, 2] + above)


def build_stairwell(line: RouteCurve, terrain: Terrain, rng: np.random.Generator) -> City:
    """Build the building round `stairs_line`; the seed places loose objects."""
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
    """Add a slab without thickness, visible from above and below."""
    corners = [[x[0], y[0], z], [x[1], y[0], z], [x[1], y[1], z], [x[0], y[1], z]]
    # Concrete: the class of walls and roofs above a start would be those of a building that one is caught in.
    builder.add_quads([corners], Surface.PAVEMENT)


def _wall(builder: MeshBuilder, a: tuple[float, float], b: tuple[float, float], z: tuple[float, float]) -> None:
    """Add a wall without thickness from `a` to `b`."""
    builder.add_quads([[[*a, z[0]], [*b, z[0]], [*b, z[1]], [*a, z[1]]]], Surface.WALL)


def _add_entrance(builder: MeshBuilder, rng: np.random.Generator) -> None:
    """Add a hall before the stairs, with a few boxes and two columns beside the path."""
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
    """Add the walls round the stairs and the one between the flights, open at the two doors."""
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
    """Add two flights of steps, each step a tread and a riser, and the landings, from a floor at z = `low`, m."""
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
    """Add a fire-hose cabinet on the wall of a half landing."""
    end, y = FLIGHT + LANDING, rng.uniform(-1.0, 0.4)
    builder.add_box([end - 0.15, y, z + 0.6], [end, y + 0.6, z + 1.4], Surface.FENCE)


def _add_corridor(builder: MeshBuilder) -> None:
    """Add two walls, a floor and a ceiling. The wall towards the stairs has no feature but the door."""
    x, y = (-LANDING - CORRIDOR, -LANDING), (TURNING - BEHIND, TURNING + AHEAD)
    z = (TOP, TOP + ROOM)
    _floor(builder, x, y, z[0])
    _floor(builder, x, y, z[1])
    _wall(builder, (x[0], y[0]), (x[0], y[1]), z)
    _wall(builder, (x[1], y[0]), (x[1], 0.1), z)
    _wall(builder, (x[1], HALF), (x[1], y[1]), z)
