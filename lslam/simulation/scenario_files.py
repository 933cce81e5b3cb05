"""Scenarios as TOML: those that ship with the package, by name, files of one's own, and overrides by `--set`."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, Field, ValidationError, model_validator

from lslam.core.arrays import Floats
from lslam.core.config.config import read_package_files, setting_value
from lslam.core.config.input import Section
from lslam.core.errors import ConfigError, InputError, UsageError, cause, nearest
from lslam.core.geometry import portable
from lslam.core.printable import toml_text
from lslam.core.untrusted import parse_toml
from lslam.io.formats.kitti_layout import PER_POINT, POINTS
from lslam.simulation.city import Layout
from lslam.simulation.imu import ImuFaults
from lslam.simulation.kinematics import Vibration
from lslam.simulation.lidar_models import LIDARS, LidarMount
from lslam.simulation.returns import Returns

Shape = Callable[[np.random.Generator], Floats]

ARC_M = 1.0  # m between the points of arcs
_CLOSED_CORNERS = [(0, 0), (190, 0), (235, 25), (235, 150), (120, 150), (120, 95), (0, 95)]
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


def round_corners(corners: Sequence[tuple[float, float]], radius: float, closed: bool) -> Floats:
    """(N, 2) points of a polygon through `corners`, m, rounded by arcs of `radius` m.

    An arc takes at most 0.45 of the shorter of its two sides, so the radius shrinks where corners are close.
    """
    points = np.asarray(corners, np.float64)
    out = [] if closed else [points[:1]]
    for k in range(len(points)) if closed else range(1, len(points) - 1):
        here, before, after = points[k], points[k - 1], points[(k + 1) % len(points)]
        a, b = before - here, after - here
        la, lb = float(portable.norm(a)), float(portable.norm(b))
        a, b = a / la, b / lb
        half = 0.5 * float(portable.arccos(np.clip(portable.dot(a, b), -1, 1)))
        reach = min(radius / portable.tan(half), 0.45 * min(la, lb))
        out.append(_arc(here, a, b, half, reach))
    if not closed:
        out.append(points[-1:])
    return np.concatenate(out)


def _arc(corner: Floats, a: Floats, b: Floats, half: float, reach: float) -> Floats:
    """Arc (N, 2) that touches lines from `corner` along units `a`, `b` (2,), `half` their angle, rad, `reach` m from it."""
    radius = reach * portable.tan(half)
    middle = (a + b) / max(float(portable.norm(a + b)), 1e-9)
    centre = corner + middle * radius / portable.sin(half)
    start, end = corner + reach * a - centre, corner + reach * b - centre
    turn = portable.arctan2(start[0] * end[1] - start[1] * end[0], portable.dot(start, end))
    count = max(int(abs(turn) * radius / ARC_M), 3)
    angle = portable.arctan2(start[1], start[0]) + np.linspace(0, turn, count + 1)
    return np.asarray(centre + radius * np.stack([portable.cos(angle), portable.sin(angle)], axis=1))


def eight(width: float, depth: float, radius: float) -> Floats:
    """Closed line (N, 2), m: up a street, round the block to its right, up it again, round the block to its left.

    Blocks measure `width` x `depth` m between the middles of the streets; radius : m, of the turns. The first street is along +y.
    """
    w, d = width, depth
    right = round_corners(
        [(0, -d / 2 + radius), (0, d / 2), (w, d / 2), (w, -d / 2), (0, -d / 2), (0, 0)], radius, False
    )
    left = round_corners(
        [(0, -d / 2 + radius), (0, d / 2), (-w, d / 2), (-w, -d / 2), (0, -d / 2), (0, 0)], radius, False
    )
    # Both end where the arc back into the shared street ends; the next lap continues there.
    return np.concatenate([_half_of_eight(right), _half_of_eight(left)])


def _half_of_eight(line: Floats) -> Floats:
    """Half of an eight without the street that it shares with the other half."""
    far = np.flatnonzero(np.abs(line[:, 0]) > 1e-6)[-1]
    return line[: far + 1]


def spiral(approach: float, radius: float, turns: float) -> Floats:
    """Line (N, 2), m: a straight approach along +x, then `turns` left turns at a nearly constant radius."""
    angle = np.linspace(0, 2 * np.pi * turns, int(2 * np.pi * turns * radius / ARC_M))
    # The radius shrinks a little, so that it is nearly but not quite a helix.
    r = radius * (1 - 0.06 * angle / angle[-1])
    circle = np.stack([r * portable.sin(angle), radius - r * portable.cos(angle)], axis=1)
    straight = np.column_stack([np.arange(-approach, -0.5 * ARC_M, ARC_M), np.zeros(int(np.ceil(approach / ARC_M)))])
    return np.concatenate([straight, circle])


def out_and_back(length: float, radius: float) -> Floats:
    """Line (N, 2), m: along +x, a left U-turn of `radius` m, and back; `length` m in all, 10 m of it straight."""
    straight = max(0.5 * (length - np.pi * radius), 5.0)
    angle = np.linspace(-np.pi / 2, np.pi / 2, max(int(np.pi * radius / ARC_M), 8) + 1)
    turn = np.array([straight, radius]) + radius * np.stack([portable.cos(angle), portable.sin(angle)], axis=1)
    return np.concatenate([[[0.0, 0.0]], turn, [[0.0, 2 * radius]]])


def _straight(length: float) -> Shape:
    """Shape of a straight line of `length` m along +x."""
    return lambda _: np.array([[0.0, 0.0], [length, 0.0]])


SHAPES: dict[str, tuple[Shape, bool]] = {
    "closed": (lambda _: round_corners(_CLOSED_CORNERS, 30.0, True), True),
    "open": (lambda _: round_corners(_OPEN, 32.0, False), False),
    "spiral": (lambda _: spiral(45.0, 21.0, 1.75), False),
    "eight": (lambda _: eight(45.0, 37.0, 11.0), True),
    "large-eight": (lambda _: eight(85.0, 70.0, 18.0), True),
    "residential": (lambda _: round_corners(_RESIDENTIAL, 14.0, True), True),
    "urban": (lambda _: round_corners(_URBAN, 14.0, True), True),
    "walk": (lambda _: round_corners(_WALK, 5.0, True), True),
    "straight": (_straight(300.0), False),
    "motorway": (lambda _: round_corners(_MOTORWAY, 700.0, False), False),
}
"""Way-points by name, and whether they close; `length` of a scenario scales them."""


# `block` and `street` draw their lines from the seed, `out-and-back` is as long as speed and scans need, `stairs` leads through
# a stairwell, `eights` round the middle of a hall and `room` through a room; the other shapes are way-points.
LINES = ("block", "street", "out-and-back", "stairs", "eights", "room", *SHAPES)
# Places that are built round a line of their own.
INDOORS = {"stairwell": "stairs", "hall": "eights", "room": "room"}


class PathSection(Section):
    """Path that is driven or flown.

    shape : a name of `LINES`, scaled to `length` m when that is given (of an out-and-back the least); smoothing : of
        its corners, m
    lane : m to the right of the middle of the street
    heights : of a drone's LiDAR at the start and the end, or of a walker's above the ground, m
    bank : share of a coordinated turn's tilt; swing : strength of what shakes a carried LiDAR, 0 for nothing
    clearance : whether crossing a building or the ground is an error
    """

    shape: str = "straight"
    length: float | None = Field(None, gt=10, le=20_000)
    smoothing: float = Field(1.5, ge=0.5, le=30)
    lane: float = Field(0.0, ge=0, le=20)
    heights: tuple[float, float] = (10.0, 10.0)
    bank: float = Field(1.0, ge=0, le=1)
    swing: float = Field(1.0, ge=0, le=10)
    clearance: bool = True


class WorldSection(Section):
    """Place: its kind, side streets (see `build_town`), and the share of rays that pass a pane.

    relief, swell : m up and down over m; unevenness : m of bumps; slope : least and greatest fall of the whole ground, m/m
    roughness : standard deviation of the surface itself, m, of a car park
    """

    kind: Literal["street", "town", "motorway", "corridor", "carpark", "woods", "hall", "stairwell", "room"] = "town"
    spacing: float = Field(80.0, ge=30, le=1000)
    levels: int = Field(1, ge=0, le=3)
    relief: float = Field(0.35, ge=0, le=20)
    swell: float = Field(100.0, ge=20, le=5000)
    unevenness: float = Field(0.012, ge=0, le=0.5)
    slope: tuple[float, float] = (0.0, 0.0)
    roughness: float = Field(0.0, ge=0, le=0.1)
    glass: float = Field(0.0, ge=0, le=1)

    @model_validator(mode="after")
    def _check_slope(self) -> WorldSection:
        """Raise ValueError for an invalid range of slopes."""
        low, high = self.slope
        if not 0 <= low <= high <= 0.2:
            raise ValueError(f"world.slope = [{low:g}, {high:g}], expected two numbers from 0 to 0.2, in order")
        return self


class TrafficSection(Section):
    """What moves: cars and people per km of street; lanes : m to the left of the middle, cars come towards us there;
    speed : of the cars, m/s; queue_s : s after which two buses and a truck drive off that wait around the start, or nothing.
    """

    cars: float = Field(0.0, ge=0, le=200)
    people: float = Field(0.0, ge=0, le=500)
    lanes: tuple[float, ...] = (1.7,)
    speed: float = Field(9.0, gt=0, le=60)
    queue_s: float | None = Field(None, ge=0, le=600)


class Scenario(Section):
    """A kind of place and a motion through it.

    carrier : car, walker or drone; speed, start_speed : m/s, the latter of a drone 0 or `speed`; lateral : greatest
        acceleration in bends, m/s2: a car and a walker slow down to it, a drone must not exceed it, for the shape `eights` it
        is the greatest thrust; roof : m behind, ahead, aside and below the LiDAR that the car's own roof occupies, or nothing;
        roof_returns : whether the roof returns points, or rays to it are only lost
    overlap : distance beyond one lap of a closed line, m; stand_s : s of standstill before the drive
    lidars : further LiDARs on the same carrier
    """

    name: str
    summary: str
    carrier: Literal["car", "drone", "walker"] = "car"
    lidar: str = "hdl64"
    lidar_height: float = Field(1.73, gt=0.3, le=10)
    speed: float = Field(gt=0, le=40)
    start_speed: float = Field(ge=0, le=40)
    lateral: float = Field(2.5, gt=0, le=60)
    roof: tuple[float, float, float, float] | None = None
    roof_returns: bool = False
    rate_hz: float = Field(10.0, ge=1, le=100)
    overlap: float = Field(0.0, ge=0, le=1000)
    stand_s: float = Field(0.0, ge=0, le=600)
    motion_compensated: bool = False
    lidars: tuple[LidarMount, ...] = ()
    path: PathSection = PathSection()
    world: WorldSection = WorldSection()
    layout: Layout = Layout()
    traffic: TrafficSection = TrafficSection()
    returns: Returns = Returns()
    vibration: Vibration = Vibration()
    imu: ImuFaults = ImuFaults()

    @property
    def real_returns(self) -> Returns | None:
        """Deviations of returns from clean, sharp surfaces; None without any."""
        return self.returns if self.returns.is_on or self.layout.volumes else None

    @model_validator(mode="after")
    def _check_names(self) -> Scenario:
        """Raise ValueError for unknown shapes and LiDARs, and for keys that contradict each other."""
        if self.path.shape not in LINES:
            raise ValueError(f"path.shape = {self.path.shape!r}; {nearest(self.path.shape, LINES)}")
        shape, own = self.path.shape, INDOORS.get(self.world.kind)
        if (own or shape) != shape or (own is None and shape in INDOORS.values()):
            expected = own or next(kind for kind, line in INDOORS.items() if line == shape)
            raise ValueError(
                f"path.shape = {shape!r} in a world.kind = {self.world.kind!r}: expected {expected!r} there"
            )
        for lidar in (self.lidar, *(mount.lidar or self.lidar for mount in self.lidars)):
            if lidar not in LIDARS:
                raise ValueError(f"lidar = {lidar!r}; {nearest(lidar, LIDARS)}")
        names = [POINTS, PER_POINT, *(mount.name for mount in self.lidars)]
        if len(set(names)) < len(names):
            raise ValueError(f"lidars: the names of folders differ, {POINTS} and {PER_POINT} are taken")
        if any(mount.offset_ms * self.rate_hz >= 1000 for mount in self.lidars):
            raise ValueError(f"lidars: an offset_ms is shorter than a sweep, {1000 / self.rate_hz:g} ms")
        if self.carrier != "drone" and min(self.path.heights) < 0.3:
            raise ValueError(f"path.heights = {list(self.path.heights)}: at least 0.3 m above the ground")
        return self


def scenario_names() -> tuple[str, ...]:
    """Names of the scenarios that ship with the package."""
    return tuple(sorted(read_package_files("lslam.simulation", "ready")))


def find_scenario(name: str, settings: Iterable[str] = ()) -> Scenario:
    """Ready scenario `name`, or that of the file `name`.toml, with overrides `settings` ("speed=8", "world.relief=1").
    Raises UsageError: no such scenario; ConfigError: a key that does not exist, or a value that does not fit InputError: a file
    that is missing or no TOML.
    """
    if name.endswith(".toml"):
        return parse_scenario(Path(name).stem, _read_toml(Path(name)), settings, name)
    return parse_scenario(name, _ready(name), settings)


def scenario_text(scenario: Scenario) -> str:
    """Scenario as TOML with every key; `find_scenario` reads it back."""

    return toml_text(scenario.model_dump(mode="json", exclude={"name"}, exclude_none=True))


def _ready(name: str) -> dict[str, Any]:
    """Tree of a scenario that ships with the package. Raises UsageError with the nearest name."""
    if name not in scenario_names():
        raise UsageError(f"no scenario {name!r} and no file NAME.toml; {nearest(name, scenario_names())}")
    return parse_toml(read_package_files("lslam.simulation", "ready")[name])


def _read_toml(path: Path) -> dict[str, Any]:
    """Tree of a TOML file; raises InputError."""
    try:
        return parse_toml(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path} cannot be read: {cause(error)}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is not valid TOML: {error}") from None


def parse_scenario(name: str, tree: dict[str, Any], settings: Iterable[str] = (), where: str | None = None) -> Scenario:
    """Scenario of a TOML tree; with `base = "urban"` it has only the differences from that ready scenario.

    settings : "key=value", which override the tree. Raises ConfigError naming `where`, the key and the nearest known one.
    """
    where = where or f"scenario {name!r}"
    merged = _on_its_base(tree, where)
    for setting in settings:
        key, equals, value = setting.partition("=")
        if not equals:
            raise ConfigError(f"--set {setting}: expected key=value, for example world.relief=1")
        leaf: Any = setting_value(value.strip())
        for part in reversed(key.strip().split(".")):
            leaf = {part: leaf}
        _merge(merged, leaf, Scenario, f"--set {setting}", "")
    try:
        return Scenario.model_validate({**merged, "name": name})
    except ValidationError as error:
        said = [
            f"{'.'.join(str(p) for p in e['loc'][:3])}: {e['msg'].removeprefix('Value error, ')}"
            for e in error.errors()
        ]
        raise ConfigError(f"{where}: " + "; ".join(text.removeprefix(": ") for text in said)) from None


def _on_its_base(tree: dict[str, Any], where: str) -> dict[str, Any]:
    """Tree merged over its base, recursively."""
    own = dict(tree)
    base = own.pop("base", None)
    merged: dict[str, Any] = {} if base is None else _on_its_base(_ready(str(base)), f"scenario {base!r}")
    _merge(merged, own, Scenario, where, "")
    return merged


def _merge(tree: dict[str, Any], more: dict[str, Any], model: type[BaseModel], where: str, prefix: str) -> None:
    """Override keys of `tree` by those of `more`; raises ConfigError naming `where` for keys that `model` lacks."""
    known = [key for key in model.model_fields if prefix or key != "name"]
    for key, value in more.items():
        if key not in known:
            raise ConfigError(f"{where}: unknown key {prefix + key!r}; {nearest(key, known)}")
        inner = model.model_fields[key].annotation
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            if not isinstance(value, dict):
                raise ConfigError(f"{where}: {key!r} is a section, write {key}.key = value")
            _merge(tree.setdefault(key, {}), value, inner, where, f"{key}.")
        elif isinstance(value, dict):
            raise ConfigError(f"{where}: {prefix + key!r} is a value, not a section")
        else:
            tree[key] = value
