"""The trajectory formats by name. A new one is a file with `fits_NAME`, `read_NAME` and `write_NAME` and a line here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lslam.core.types.trajectory import Trajectory
    from lslam.io.formats.text_tables import TextTable


@dataclass(frozen=True)
class TrajectoryFormat:
    """One format; its functions are imported when they are asked for.

    module : with `fits_NAME(first line)`, `read_NAME(table, times)` and `write_NAME(path, trajectory)`
    frame : the body whose poses it holds by convention, empty where the file says
    has_stamps : whether a file holds them; is_written : whether there is `write_NAME`
    """

    name: str
    module: str
    frame: str = ""
    has_stamps: bool = True
    is_written: bool = True

    @property
    def fits(self) -> Callable[[str], bool]:
        """Whether a file whose first line of data is this one may be of the format."""
        return self._function("fits")

    @property
    def read(self) -> Callable[[TextTable, Path | None], Trajectory]:
        """The trajectory of a table; the last argument names a file of stamps."""
        return self._function("read")

    @property
    def write(self) -> Callable[[Path, Trajectory], None]:
        """Write a file, atomically."""
        return self._function("write")

    def _function(self, verb: str) -> Callable[..., Any]:
        found: Callable[..., Any] = getattr(import_module(self.module), f"{verb}_{self.name}")
        return found


# Asked in this order whether they fit.
FORMATS = {
    one.name: one
    for one in (
        TrajectoryFormat("kitti", "lslam.io.formats.trajectory_lines", frame="cam0", has_stamps=False),
        TrajectoryFormat("tum", "lslam.io.formats.trajectory_lines"),
        TrajectoryFormat("euroc", "lslam.io.formats.trajectory_csv", frame="imu"),
        TrajectoryFormat("csv", "lslam.io.formats.trajectory_csv", is_written=False),
    )
}
WRITTEN = tuple(name for name, one in FORMATS.items() if one.is_written)
