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
        found: Callable[..., Any] = getattr(import_module(self.module), f"{verb}_{self.name}")
        return found


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
