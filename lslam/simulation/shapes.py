"""The lines of the ready scenarios, as way-points: loops, eights, a spiral, streets. Lengths are set later by scaling."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Shape = Callable[[np.random.Generator], Floats]

STEP = 1.0  # m between the points of arcs


def rounded(corners: Sequence[tuple[float, float]], radius: float, closed: bool) -> Floats:
    """(N, 2) points along straight lines between `corners`, m, with arcs of `radius` m in them.

    An arc takes at most 0.45 of the shorter of its two sides, so the radius shrinks where corners are close.
    """
    points = np.asarray(corners, np.float64)
    out = [] if closed else [points[:1]]
    for k in range(len(points)) if closed else range(1, len(points) - 1):
        here, before, after = points[k], points[k - 1], points[(k + 1) % len(points)]
        a, b = before - here, after - here
        la, lb = float(np.linalg.norm(a)), float(np.linalg.norm(b))
        a, b = a / la, b / lb
        half = 0.5 * float(np.arccos(np.clip(a @ b, -1, 1)))
        reach = min(radius / np.tan(half), 0.45 * min(la, lb))
        out.append(_arc(here, a, b, half, reach))
    if not closed:
        out.append(points[-1:])
    return np.concatenate(out)


def _arc(corner: Floats, a: Floats, b: Floats, half: float, reach: float) -> Floats:
    """The arc that touches two lines from `corner` along unit vectors `a` and `b`, `reach` m from it."""
    radius = reach * np.tan(half)
    middle = (a + b) / max(float(np.linalg.norm(a + b)), 1e-9)
    centre = corner + middle * radius / np.sin(half)
    start, end = corner + reach * a - centre, corner + reach * b - centre
    turn = np.arctan2(start[0] * end[1] - start[1] * end[0], start @ end)
    count = max(int(abs(turn) * radius / STEP), 3)
    angle = np.arctan2(start[1], start[0]) + np.linspace(0, turn, count + 1)
    return np.asarray(centre + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))


def eight(width: float, depth: float, radius: float) -> Floats:
    """Closed (N, 2): up a street, round the block to its right, up it again, round the block to its left.

    Blocks measure `width` x `depth` m between the middles of the streets.
    """
    w, d = width, depth
    right = rounded([(0, -d / 2 + radius), (0, d / 2), (w, d / 2), (w, -d / 2), (0, -d / 2), (0, 0)], radius, False)
    left = rounded([(0, -d / 2 + radius), (0, d / 2), (-w, d / 2), (-w, -d / 2), (0, -d / 2), (0, 0)], radius, False)
    # Both end where the arc back into the shared street ends; the next lap continues there.
    return np.concatenate([_until_shared(right), _until_shared(left)])


def _until_shared(line: Floats) -> Floats:
    """Without the way along the shared street that the other half goes again."""
    far = np.flatnonzero(np.abs(line[:, 0]) > 1e-6)[-1]
    return line[: far + 1]


def spiral(approach: float, radius: float, turns: float) -> Floats:
    """(N, 2): a straight approach along +x, then `turns` left turns at a nearly constant radius."""
    angle = np.linspace(0, 2 * np.pi * turns, int(2 * np.pi * turns * radius / STEP))
    # The radius shrinks a little, so that it is nearly but not quite a helix.
    r = radius * (1 - 0.06 * angle / angle[-1])
    circle = np.stack([r * np.sin(angle), radius - r * np.cos(angle)], axis=1)
    straight = np.column_stack([np.arange(-approach, -0.5 * STEP, STEP), np.zeros(int(np.ceil(approach / STEP)))])
    return np.concatenate([straight, circle])


def out_and_back(length: float, radius: float) -> Floats:
    """(N, 2): along +x, round a U-turn to the left of `radius` m, and back beside; `length` m in all, 10 m of it straight."""
    straight = max(0.5 * (length - np.pi * radius), 5.0)
    angle = np.linspace(-np.pi / 2, np.pi / 2, max(int(np.pi * radius / STEP), 8) + 1)
    turn = np.array([straight, radius]) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([[[0.0, 0.0]], turn, [[0.0, 2 * radius]]])


_CLOSED = [(0, 0), (190, 0), (235, 25), (235, 150), (120, 150), (120, 95), (0, 95)]
_OPEN = [(0, 0), (125, 0), (125, 105), (260, 125), (300, 190)]
_RESIDENTIAL = [
    (0, 0),
    (95, -6),
    (168, 14),
    (185, 92),
    (150, 168),
    (92, 180),
    (70, 118),
    (-18, 128),
    (-30, 62),
    (-45, 8),
]
_URBAN = [(0, 0), (150, 0), (162, 88), (60, 112), (-8, 100)]
_MOTORWAY = [(0, 0), (380, 0), (760, 95), (1150, 60)]
_WALK = [(0, 0), (38, 2), (52, 24), (36, 48), (4, 44), (-10, 20)]


def _straight(length: float) -> Shape:
    return lambda _: np.array([[0.0, 0.0], [length, 0.0]])


SHAPES: dict[str, tuple[Shape, bool]] = {
    "closed": (lambda _: rounded(_CLOSED, 30.0, True), True),
    "open": (lambda _: rounded(_OPEN, 32.0, False), False),
    "spiral": (lambda _: spiral(45.0, 21.0, 1.75), False),
    "eight": (lambda _: eight(45.0, 37.0, 11.0), True),
    "large-eight": (lambda _: eight(85.0, 70.0, 18.0), True),
    "residential": (lambda _: rounded(_RESIDENTIAL, 14.0, True), True),
    "urban": (lambda _: rounded(_URBAN, 14.0, True), True),
    "walk": (lambda _: rounded(_WALK, 5.0, True), True),
    "straight": (_straight(300.0), False),
    "motorway": (lambda _: rounded(_MOTORWAY, 700.0, False), False),
}
"""Way-points by name, and whether they close; `length` of a scenario scales them."""
