"""Trajectory files: KITTI, TUM, EuRoC and CSV with named columns, read and written side by side.

| format | line | time | rotation | frame |
|---|---|---|---|---|
| `kitti` | 12 numbers, the upper 3x4 of a pose, row-major, or 16; behind a scan's number or time | `times.txt` | matrix | cam0 |
| `tum` | `stamp tx ty tz qx qy qz qw`, or without rotation | s, or by size | xyzw | in a comment: `# frame: lidar` |
| `euroc` | `ns, p, q_w q_x q_y q_z, ...` | ns | wxyz | imu |
| `csv` | columns named in the header | by the name, or by size | by name | unknown |

Stamps go between text and int64 ns without passing through a float. Matrices are kept as the file states them, so that
numbers agree with tools that do the same. A new format is a module with `fits_NAME`, `read_NAME` and `write_NAME`, and a line
here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lslam.core.errors import InputError, UsageError, nearest
from lslam.io.remote import as_path

if TYPE_CHECKING:
    from lslam.core.types.trajectory import Trajectory
    from lslam.io.formats.text_tables import TextTable


@dataclass(frozen=True)
class TrajectoryFormat:
    """One trajectory format; its module is imported on first use.

    module : with `fits_NAME(first line)`, `read_NAME(table, times)` and `write_NAME(path, trajectory)`
    frame : the body whose poses it holds by convention, empty where the file says
    has_stamps : whether a file holds them
    """

    name: str
    module: str
    frame: str = ""
    has_stamps: bool = True

    @property
    def fits(self) -> Callable[[str], bool]:
        """Whether a file with this first line of data may be of the format."""
        return self._function("fits")

    @property
    def read(self) -> Callable[[TextTable, Path | None], Trajectory]:
        """Read the trajectory of a table; `times` names a file of stamps."""
        return self._function("read")

    @property
    def write(self) -> Callable[[Path, Trajectory], None]:
        """Write a file, atomically."""
        return self._function("write")

    def _function(self, verb: str) -> Callable[..., Any]:
        """Function of the format's module: `verb` is fits, read or write."""
        function: Callable[..., Any] = getattr(import_module(self.module), f"{verb}_{self.name}")
        return function


# Asked in this order whether they fit.
FORMATS = {
    one.name: one
    for one in (
        TrajectoryFormat("kitti", "lslam.io.formats.trajectory_lines", frame="cam0", has_stamps=False),
        TrajectoryFormat("tum", "lslam.io.formats.trajectory_lines"),
        TrajectoryFormat("euroc", "lslam.io.formats.trajectory_csv", frame="imu"),
        TrajectoryFormat("csv", "lslam.io.formats.trajectory_csv"),
    )
}


def read_trajectory(path: str | Path, format: str | None = None, times: str | Path | None = None) -> Trajectory:  # noqa: A002
    """Read poses T_world_body.

    path : the file, or a run folder, whose `trajectory.tum` is read
    format : one of FORMATS; detected from the first line when None
    times : file with one stamp in seconds per line, for KITTI poses; when None, `times.txt` beside the file is taken, or
        the one of the same sequence in KITTI's layout; without any, stamps count poses at 10 Hz and `has_stamps` is False
    Raises InputError naming file and line: missing, empty, short lines, NaN, no rotation, stamps that do not increase. UsageError
    for an unknown `format`.
    """
    from lslam.io.formats.text_tables import read_table

    path = as_path(path)
    if path.is_dir():
        if not (path / "trajectory.tum").is_file():
            raise InputError(f"{path} is a folder without trajectory.tum: name a run folder or a trajectory file")
        path = path / "trajectory.tum"
    table = read_table(path)
    if format is not None and format not in FORMATS:
        raise UsageError(f"no trajectory format {format!r}; {nearest(format, FORMATS)}")
    if not table.first:
        raise InputError(f"{path} holds no poses: the file is empty or all comments")
    if not table.rows:
        raise InputError(f"{path} has a header but no poses")
    kind = FORMATS[format] if format else next(kind for kind in FORMATS.values() if kind.fits(table.first))
    return kind.read(table, None if times is None else Path(times))
