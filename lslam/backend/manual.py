"""What a person knows of a recording, pairs of scans and control points: read from CSV, resolved to scans and keyframes."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from collections.abc import Sequence as Many
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, cast

import numpy as np

from lslam.backend.georeferencing import require_crs
from lslam.core.arrays import Floats, Longs
from lslam.core.config import Config
from lslam.core.errors import InputError, UsageError, cause, nearest
from lslam.core.geometry.crs_names import parse_crs
from lslam.core.geometry.geodesy import crs_of
from lslam.core.geometry.se3 import poses_at
from lslam.core.types.constraint import ControlPoint, ControlResidual, Instant, KnownPair, Manual, NamedPair
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.sequence import Selection, Sequence
from lslam.core.types.trajectory import Keyframe
from lslam.core.untrusted import whole_number
from lslam.io.formats.atomic import write_text
from lslam.io.formats.text_tables import seconds_to_ns, separator_of, split_cells
from lslam.maps.georeference import to_wgs84

# What a run writes into the column is its own verdict, and says nothing here: its loops.csv can be edited and given back.
VERDICTS, OWN_VERDICTS = ("known", "forbidden"), ("accepted", "rejected")
# Names of the columns of a position.
X, Y, Z = ("x", "easting", "east", "lon", "longitude"), ("y", "northing", "north", "lat", "latitude"), ("z", "height")


@dataclass(frozen=True)
class _Row:
    """One line of a table: its cells by column, its file and line number."""

    path: Path
    line: int
    cells: dict[str, str]

    @property
    def place(self) -> str:
        """The place, for messages."""
        return f"{self.path.name}, line {self.line}"

    def error(self, what: str) -> InputError:
        """An InputError that begins with file and line."""
        return InputError(f"{self.path}, line {self.line}: {what}")

    def text(self, *names: str) -> str:
        """Text of the first non-empty cell of the columns `names`; empty without one."""
        return next((self.cells[name] for name in names if self.cells.get(name)), "")

    def number(self, *names: str) -> float | None:
        """The finite number in the first non-empty of the columns `names`; None where they are empty. Raises InputError."""
        text = self.text(*names)
        if not text:
            return None
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not np.isfinite(value):
            raise self.error(f"{names[0]} = {text!r} is no number")
        return value

    def require(self, *names: str) -> float:
        """The finite number in the first non-empty of the columns `names`. Raises InputError without one."""
        value = self.number(*names)
        if value is None:
            raise self.error(f"{' or '.join(names)} is empty")
        return value

    def size(self, *names: str) -> float | None:
        """A number above zero, None where the cell is empty; raises InputError for others."""
        value = self.number(*names)
        if value is not None and value <= 0:
            raise self.error(f"{names[0]} = {value:g} must be above 0")
        return value

    def instant(self, suffix: str = "") -> Instant:
        """The scan by number, or its stamp in s or ns, of the columns with `suffix`; raises InputError when they are empty."""
        scan, seconds, ns = (self.text(name + suffix) for name in ("scan", "stamp", "stamp_ns"))
        if scan:
            number = whole_number(scan)
            if number is None:
                raise self.error(f"scan{suffix} = {scan!r} is no number of a scan")
            return Instant(self.place, scan=number)
        if not (seconds or ns):
            raise self.error(f"scan{suffix} or stamp{suffix} is empty")
        return Instant(self.place, stamp_ns=seconds_to_ns(seconds or ns, self.path, self.line, 10**9 if seconds else 1))


def read_named_pairs(path: Path) -> list[NamedPair]:
    """Pairs by `scan_a` and `scan_b`, or `stamp_a` and `stamp_b`, s, whose `verdict` is known or forbidden.

    `x_m`, `y_m` : approximate position of the second in the frame of the first; `within_m` : largest distance from it. Rows with
    a run's own verdict are skipped. Raises InputError naming file and line.
    """
    pairs = []
    for row in _rows(path, (("scan_a", "stamp_a", "stamp_ns_a"), ("scan_b", "stamp_b", "stamp_ns_b"), ("verdict",))):
        verdict = row.text("verdict").lower()
        if verdict in OWN_VERDICTS:
            continue
        if verdict not in VERDICTS:
            raise row.error(f"verdict {verdict!r}: known or forbidden; {nearest(verdict, VERDICTS)}")
        place = np.array([row.number("x_m", "x") or 0.0, row.number("y_m", "y") or 0.0])
        kind = cast(Literal["known", "forbidden"], verdict)
        pairs.append(NamedPair(row.instant("_a"), row.instant("_b"), kind, place, row.size("within_m", "within")))
    if not pairs:
        raise InputError(f"{path} names no pair: write known or forbidden into its column verdict")
    return pairs


def read_control_points(path: Path) -> list[ControlPoint]:
    """Points by `scan` or `stamp`, s, with `x`, `y`, `z`, `sigma`, m, and `crs`, as EPSG:25832.

    `sigma_z` : of the height, if different; `lidar_x`, `lidar_y`, `lidar_z` : the point in the LiDAR frame, m, if it is not the
    sensor itself. Raises InputError naming file and line.
    """
    points = []
    for row in _rows(path, (("scan", "stamp", "stamp_ns"), X, Y, Z, ("sigma", "sigma_m"), ("crs",))):
        try:
            epsg, height_epsg = parse_crs(row.text("crs"))
        except UsageError:
            raise row.error(
                f"crs = {row.text('crs')!r}: EPSG and a number, for example EPSG:25832, or EPSG:25832+7837 with heights"
            ) from None
        try:
            crs_of(epsg, height_epsg)
        except UsageError as error:
            raise row.error(str(error).replace("--crs", "crs")) from None
        sigma = row.size("sigma", "sigma_m")
        if sigma is None:
            raise row.error("sigma is empty: a point without it holds nothing")
        spread = np.array([sigma, sigma, row.size("sigma_z", "sigma_z_m") or sigma])
        position = np.array([row.require(*X), row.require(*Y), row.require(*Z)])
        points.append(ControlPoint(row.instant(), position, spread, epsg, _lidar_point(row), height_epsg))
    if not points:
        raise InputError(f"{path} has no control points below its header")
    return points


def write_control(path: Path, residuals: Iterable[ControlResidual]) -> None:
    """Write the residual of each control point, surveyed minus solved, m, east, north and up, as CSV; raises OutputError."""
    rows = ["point,stamp_ns,east_m,north_m,up_m,sigma_m,sigma_up_m,sigmas,lat_deg,lon_deg,height_m"]
    for one in residuals:
        (east, north, up), (sigma, _, sigma_up) = one.residual.tolist(), one.point.sigma.tolist()
        name = one.point.at.source.replace(",", "")
        lat, lon, height = one.place
        off = f"{east:.4f},{north:.4f},{up:.4f},{sigma:g},{sigma_up:g},{one.size:.2f}"
        rows.append(f"{name},{one.stamp_ns},{off},{lat:.9f},{lon:.9f},{height:.4f}")
    write_text(path, "\n".join(rows) + "\n")


def _lidar_point(row: _Row) -> Floats:
    """(3,) m, the point in the LiDAR frame, zero if its columns are empty.

    Raises InputError where only some of the three are given.
    """
    values = [row.number(f"lidar_{axis}", f"lidar_{axis}_m") for axis in "xyz"]
    if any(value is None for value in values) and any(value is not None for value in values):
        raise row.error("lidar_x, lidar_y and lidar_z go together")
    return np.array([value or 0.0 for value in values])


def _is_comment(line: str, names: set[str]) -> bool:
    """Whether a line begins with # and is no header that does."""
    text = line.strip()
    return text.startswith("#") and not names & {word.strip().lower() for word in re.split("[;,\\s]", text.lstrip("#"))}


def _rows(path: Path, columns: Many[tuple[str, ...]]) -> Iterator[_Row]:
    """Lines below the header, which has one column of each of `columns`; raises InputError for another one."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read: {cause(error)}") from None
    names = {name for one in columns for name in one}
    numbered = [(n, line) for n, line in enumerate(lines, 1) if line.strip() and not _is_comment(line, names)]
    if not numbered:
        raise InputError(f"{path} is empty")
    separator = separator_of(numbered[0][1])
    table = [split_cells(line.strip(), separator) for _, line in numbered]
    header = [name.strip().lstrip("#").strip().lower() for name in table[0]]
    missing = [names for names in columns if not any(name in header for name in names)]
    if missing:
        raise InputError(
            f"{path}, line {numbered[0][0]}: no column {' or '.join(missing[0])}; the file has {', '.join(header)}"
        )
    if len(set(header)) < len(header):
        raise InputError(f"{path}, line {numbered[0][0]}: a column stands there twice: {', '.join(header)}")
    for (number, _), cells in zip(numbered[1:], table[1:], strict=True):
        if len(cells) > len(header):
            raise InputError(f"{path}, line {number}: {len(cells)} columns where the header has {len(header)}")
        yield _Row(path, number, dict(zip(header, cells, strict=False)))


# Beyond the first and the last scan a control point's stamp is that of a pose only as far as seconds are rounded.
ROUNDING_NS = 5_000_000


@dataclass(frozen=True)
class KeyframePairs:
    """Named pairs between keyframes, the older first."""

    known: list[KnownPair]
    forbidden: list[tuple[int, int]]
    problems: list[str] = field(default_factory=list)


def read_manual(config: Config, sequence: Sequence) -> Manual:
    """The files that `loops.file` and `graph.control` name. Raises InputError, also for scans that the sequence lacks.

    Raises UsageError for coordinates that PROJ does not know.
    """
    pairs = read_named_pairs(Path(config.loops.file)) if config.loops.file else []
    points = read_control_points(Path(config.graph.control)) if config.graph.control else []
    numbers = sequence.indices if isinstance(sequence, Selection) else np.arange(len(sequence))
    period = int(1e9 / sequence.rate_hz) if sequence.rate_hz > 0 else 0
    require_instants([end for pair in pairs for end in (pair.first, pair.second)], numbers, sequence.stamps_ns, period)
    require_instants([point.at for point in points], numbers, sequence.stamps_ns)
    for point in points:
        require_crs(to_wgs84(point.position[None], point.epsg, point.height_epsg, config.gnss.geoid)[0], config.gnss)
    return Manual(tuple(pairs), tuple(points))


def require_instants(instants: Iterable[Instant], numbers: Longs, stamps_ns: Longs, slack: int = ROUNDING_NS) -> None:
    """Raise InputError for a scan number that a run has not, or a stamp outside of its time.

    numbers, stamps_ns : (N,) of its scans; slack : ns, that a stamp may lie before the first and behind the last
    """
    span = int(stamps_ns[0]) - slack, int(stamps_ns[-1]) + slack
    for instant in instants:
        if instant.scan is not None and instant.scan not in numbers:
            raise InputError(
                f"{instant.source}: scan {instant.scan} is none of the run's, which are {numbers[0]} to {numbers[-1]}"
            )
        if instant.stamp_ns is not None and not span[0] <= instant.stamp_ns <= span[1]:
            raise InputError(
                f"{instant.source}: the stamp {1e-9 * instant.stamp_ns:.3f} s is none of the run's, which are "
                f"{1e-9 * span[0]:.3f} to {1e-9 * span[1]:.3f} s"
            )


def stamp_of(instant: Instant, results: Many[ScanResult]) -> int:
    """Stamp of an instant, ns, clipped to the time of the run."""
    stamps = {result.index: result.stamp_ns for result in results}
    stamp = stamps[instant.scan] if instant.scan is not None else instant.stamp_ns
    assert stamp is not None
    return int(np.clip(stamp, results[0].stamp_ns, results[-1].stamp_ns))


def keyframe_pairs(pairs: Many[NamedPair], results: Many[ScanResult], keyframes: Many[Keyframe]) -> KeyframePairs:
    """The pairs by their nearest keyframes, and a sentence for each pair whose two scans have the same nearest keyframe."""
    stamps = np.array([k.stamp_ns for k in keyframes])
    found = KeyframePairs([], [])
    for pair in pairs:
        ends = []
        for instant in (pair.first, pair.second):
            stamp = stamp_of(instant, results)
            ends.append((int(np.abs(stamps - stamp).argmin()), stamp))
        (a, _), (b, _) = ends
        numbers = {(known.a, known.b) for known in found.known}
        if a == b:
            found.problems.append(f"{pair.first.source}: both scans belong to one keyframe: there is no loop to close")
        elif pair.verdict == "forbidden":
            found.forbidden.append((min(a, b), max(a, b)))
        elif (min(a, b), max(a, b)) in numbers:
            found.problems.append(f"{pair.first.source}: the pair is named twice, it counts once")
        else:
            found.known.append(_keyframe_pair(pair, ends, results, keyframes))
    found.problems.extend(
        f"{known.source}: the pair is known and forbidden: it holds, and nothing else is closed there"
        for known in found.known
        if (known.a, known.b) in found.forbidden
    )
    return found


def _keyframe_pair(
    pair: NamedPair, ends: list[tuple[int, int]], results: Many[ScanResult], keyframes: Many[Keyframe]
) -> KnownPair:
    """The pair of keyframes nearest to the two scans; odometry moves the expected position from the scans to these.

    ends : keyframe number and stamp, ns, of both scans
    """
    (first, at_first), (second, at_second) = ends
    stamps = np.array([r.stamp_ns for r in results])
    poses = np.stack([r.T_world_lidar for r in results])
    of_first, of_second = poses_at(stamps, poses, np.array([at_first, at_second]))
    shift = of_first[:3, :3] @ np.array([*pair.place, 0.0])
    shift += keyframes[second].T_world_lidar[:3, 3] - of_second[:3, 3]
    shift -= keyframes[first].T_world_lidar[:3, 3] - of_first[:3, 3]
    a, b = min(first, second), max(first, second)
    if a != first:
        shift = -shift
    return KnownPair(a, b, keyframes[a].T_world_lidar[:3, :3].T @ shift, pair.within, pair.first.source)
