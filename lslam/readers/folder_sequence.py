"""A sequence whose scans are files of one folder: what all folder readers give."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError, cause
from lslam.formats.array_headers import HEADERS
from lslam.formats.point_cloud import PointCloud
from lslam.formats.point_files import read_bin, read_points
from lslam.formats.point_records import KITTI, PointRecord
from lslam.formats.state_files import DAMAGE
from lslam.readers.point_clock import PointClock
from lslam.readers.point_times import TimeRule, azimuth_times
from lslam.readers.point_units import in_metres
from lslam.types.gnss import GnssStream
from lslam.types.imu import ImuStream
from lslam.types.scan import Scan, Span
from lslam.types.sequence import Calibration, Scans, StatedTimes
from lslam.types.trajectory import Trajectory


@dataclass
class FolderSequence(Scans):
    """A `Sequence` over point files. See `lslam.types.sequence` for the attributes every sequence has.

    files : one per scan; correction_deg : rotation of every point about p x z, 0 for none
    rows, cols : organised clouds, point r * cols + c has ring r; per_point : folder of `<stem>.npz` with `t` and `ring`
    clock : how the files' own per-point times are read, None when they have none or are not to be used
    sweep_s : (N, 2) begin and end of each sweep, s from its stamp, when per-point times follow from the azimuth; else None
    record : of the points, where the files do not name their fields; unit_m : of coordinates, None where nobody states it
    rings : number of beams, if known; sensor : its name, if known
    """

    name: str
    path: Path
    kind: str
    files: list[Path]
    stamps_ns: NDArray[np.int64]
    rate_hz: float
    motion_compensated: bool | None = None
    calibration: Calibration = field(default_factory=Calibration)
    ground_truth: Trajectory | None = None
    imu: ImuStream | None = None
    gnss: GnssStream | None = None
    notes: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    stated_times: StatedTimes = field(default_factory=StatedTimes)
    correction_deg: float = 0.0
    rows: int | None = None
    cols: int | None = None
    per_point: Path | None = None
    clock: PointClock | None = None
    sweep_s: NDArray[np.float64] | None = None
    rings: int | None = None
    sensor: str | None = None
    record: PointRecord | None = None
    unit_m: float | None = None

    def __len__(self) -> int:
        return len(self.files)

    @property
    def time_rule(self) -> TimeRule | None:
        """How per-point times are meant; None where `clock` is."""
        return None if self.clock is None else self.clock.rule

    def scan(self, index: int) -> Scan:
        """Read scan `index`; an empty file gives an empty scan.

        Raises InputError naming the file when it cannot be read or contradicts `sequence.toml`, IndexError beyond the end.
        """
        if not 0 <= index < len(self.files):
            raise IndexError(f"scan {index} of {len(self.files)}")
        path = self.files[index]
        stamp = int(self.stamps_ns[index])
        is_kitti = path.suffix.lower() == ".bin" and self.record in (None, KITTI)
        cloud = in_metres(_split(read_bin(path)) if is_kitti else read_points(path, self.record), self.unit_m)
        cloud, times = self._times_and_rings(path, cloud, index)
        fault = ""
        if self.per_point is None and self.clock is not None:
            cloud, times, shift_ns, fault, _ = self.clock.read(cloud, stamp)
            stamp += shift_ns
        if self.correction_deg and len(cloud):
            from lslam.kernels.transform import rotate_up

            angle = math.radians(self.correction_deg)
            rotate_up(cloud.points, math.sin(angle), math.cos(angle))
        return Scan(cloud.points, stamp, index, cloud.intensity, times, cloud.rings, fault=fault)

    def _times_and_rings(
        self, path: Path, cloud: PointCloud, index: int
    ) -> tuple[PointCloud, NDArray[np.float32] | None]:
        times: NDArray[np.float32] | None = None
        rings = cloud.rings
        if self.per_point is not None and len(cloud):
            # Compensated scans have no times: nobody shall deskew them a second time.
            names = ("ring",) if self.motion_compensated else ("t", "ring")
            times, rings = _read_per_point(self.per_point / f"{path.stem}.npz", len(cloud), names)
        elif self.sweep_s is not None:
            times = azimuth_times(cloud.points, Span(*self.sweep_s[index].tolist()))
        if rings is None and self.rows is not None and self.cols is not None and len(cloud):
            if self.rows * self.cols != len(cloud):
                raise InputError(f"{path}: {len(cloud)} points are not {self.rows} rows of {self.cols} columns")
            rings = np.repeat(np.arange(self.rows, dtype=np.uint16), self.cols)
        return replace(cloud, rings=rings), times


def _split(raw: NDArray[np.float32]) -> PointCloud:
    from lslam.kernels.transform import split

    points = np.empty((len(raw), 3), np.float32)
    intensity = np.empty(len(raw), np.float32)
    split(raw, points, intensity)
    return PointCloud(points, intensity)


def _read_per_point(
    path: Path, count: int, names: tuple[str, ...]
) -> tuple[NDArray[np.float32] | None, NDArray[np.uint16] | None]:
    """Times and rings of a scan's points, (count,) each, of which `names` are read."""
    try:
        with HEADERS, path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            held = {name: file[name] for name in names if name in file}
    except (OSError, *DAMAGE) as error:
        raise InputError(f"{path}, named by per_point of sequence.toml, cannot be read: {cause(error)}") from None
    for name, values in held.items():
        if values.shape != (count,):
            raise InputError(f"{path}: {name} has shape {values.shape} for a scan of {count} points")
    times, rings = held.get("t"), held.get("ring")
    return (
        None if times is None else np.asarray(times, np.float32),
        None if rings is None else np.asarray(rings, np.uint16),
    )
