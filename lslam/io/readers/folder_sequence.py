"""Base of all folder readers: sequences whose scans are files of one folder."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats, Longs
from lslam.core.errors import InputError, input_errors
from lslam.core.printable import printable
from lslam.core.types.scan import Scan, Span
from lslam.core.types.sequence import readable
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats.point_cloud import PointCloud
from lslam.io.formats.point_files import check_size, read_array, read_bytes, read_points, record_of
from lslam.io.formats.point_records import KITTI, PointRecord, name_columns, parse_record
from lslam.io.formats.sequence_toml import LENGTHS, SequenceInfo
from lslam.io.formats.state_files import DAMAGE, HEADERS
from lslam.io.readers.cameras import folder_cameras
from lslam.io.readers.ground_truth import Voice, load_poses
from lslam.io.readers.listing import check_stamps
from lslam.io.readers.point_clock import PointClock, open_clock, read_samples
from lslam.io.readers.point_times import Sample, azimuth_times
from lslam.io.readers.scan_stamps import rows_of_scans
from lslam.io.readers.sequence_on_disk import SequenceOnDisk, in_metres, settle_unit
from lslam.io.readers.sidecars import compensation_note, load_streams, per_point_folder, read_info, stated_times

_PER_POINT: dict[str, Any] = {"t": np.float32, "ring": np.uint16}
_LOOKED_AT = 3


@dataclass(kw_only=True)
class FolderSequence(SequenceOnDisk):
    """A recording of point files.

    files : one per scan; correction_deg : rotation of every point about p x z, 0 for none
    rows, cols : organised clouds, point r * cols + c has ring r; per_point : folder of `<stem>.npz` with `t` and `ring`
    sweep_s : (N, 2) begin and end of each sweep, s from its stamp, when per-point times follow from the azimuth; else None
    record : of the points, for files without named fields
    """

    files: list[Path]
    correction_deg: float = 0.0
    rows: int | None = None
    cols: int | None = None
    per_point: Path | None = None
    sweep_s: Floats | None = None
    record: PointRecord | None = None

    def _read(self, index: int) -> Scan:
        """Read a scan file. Raises InputError naming the file, also where it contradicts `sequence.toml`."""
        path = self.files[index]
        stamp = int(self.stamps_ns[index])
        cloud = in_metres(read_points(path, self.record), self.unit_m)
        times, rings, fault = None, cloud.rings, ""
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
        cloud = replace(cloud, rings=rings)
        if self.per_point is None and self.clock is not None:
            cloud, times, shift_ns, fault, _ = self.clock.read(cloud, stamp)
            stamp += shift_ns
        if self.correction_deg and len(cloud):
            from lslam.core.kernels.transform import rotate_up

            angle = math.radians(self.correction_deg)
            rotate_up(cloud.points, math.sin(angle), math.cos(angle))
        return Scan(cloud.points, stamp, index, cloud.intensity, times, cloud.rings, fault, cloud.labels)


@dataclass
class Folder:
    """Folder of scans while it is opened: files, `record`, stated facts, and the lists for notes and problems."""

    path: Path
    kind: str
    files: list[Path]
    info: SequenceInfo
    has_toml: bool
    voice: Voice
    record: PointRecord | None

    @classmethod
    def begin(
        cls, path: Path, kind: str, why: str, overrides: SequenceInfo, scans: tuple[list[Path], list[str]], nothing: str
    ) -> Folder:
        """Open a folder. Raises InputError: `nothing` if there are no scans, else about `sequence.toml` or points."""
        info, has_toml = read_info(path, overrides)
        files, left_out = scans
        if not files:
            raise InputError(nothing)
        voice = Voice([f"format {kind}: {why}", *left_out, *compensation_note(info)], [])
        return cls(path, kind, files, info, has_toml, voice, scan_record(files, info, voice))

    def read(self, file: Path) -> PointCloud:
        """The points of a scan file."""
        return read_points(file, self.record)

    def calibration(self, path: Path, read: Callable[[Path], Floats | None]) -> Floats | None:
        """Result of `read` on a calibration file; None, with a problem, where it cannot be read."""
        try:
            return read(path)
        except InputError as error:
            self.voice.problems.append(f"calibration is not used: {error}")
            return None

    def take_rows(self, source: Path, stamps: Longs) -> tuple[Longs, float]:
        """Drop scans without a stamp in `source`. Returns the increasing stamps of the others and the rate, Hz."""
        self.files, stamps = rows_of_scans(source, stamps, self.files, self.voice)
        return check_stamps(stamps, self.info.rate_hz, source, self.voice.problems)

    def clock(self, stamps: Longs, rate_hz: float) -> PointClock | None:
        """Reader of the files' per-point times, learnt on a few scans."""
        if self.record == KITTI:
            return None
        samples = read_samples(len(self.files), lambda k: Sample(self.read(self.files[k]), int(stamps[k])))
        return open_clock(list(samples.values()), rate_hz, self.info, self.voice.notes, self.voice.problems)

    def truth(self, path: Path | None, stamps: Longs) -> Trajectory | None:
        """Poses in the file `path`, of the stated body, else of the body that the file names; None without a file.

        stamps : ns, of the scans, for rows without a time; an unreadable file is a problem, and None
        """
        truth = None if path is None else load_poses(path, stamps, self.files, self.voice)
        return None if truth is None else replace(truth, frame=self.info.ground_truth_frame or truth.frame)

    def sequence(self, **parts: Any) -> FolderSequence:
        """Sequence of `parts`, see `FolderSequence`, and the stated facts, in m; IMU and fixes are read unless in `parts`."""
        info, problems = self.info, self.voice.problems
        if "imu" not in parts:
            parts["imu"], parts["gnss"] = load_streams(self.path, info, self.voice)
        sequence = FolderSequence(
            **{
                "name": info.name or printable(self.path.name),
                "path": self.path,
                "kind": self.kind,
                "files": self.files,
                "motion_compensated": info.motion_compensated,
                "record": self.record,
                "rows": info.rows,
                "cols": info.cols,
                "per_point": per_point_folder(self.path, info),
                "rings": info.rings or info.rows,
                "sensor": info.sensor,
                "unit_m": LENGTHS.get(info.point_unit or ""),
                "stated_times": stated_times(info),
                "notes": self.voice.notes,
                "problems": problems,
                **parts,
                **({"open_cameras": partial(folder_cameras, self.path, info.cameras)} if info.cameras else {}),
            }
        )
        return settle_unit(sequence)


def _read_per_point(
    path: Path, count: int, names: tuple[str, ...]
) -> tuple[NDArray[np.float32] | None, NDArray[np.uint16] | None]:
    """Times and rings (count,) of a scan that are in `names` and the file, else None; InputError for a damaged file."""
    with (
        input_errors(f"{path}, named by per_point of sequence.toml,", *DAMAGE),
        HEADERS,
        path.open("rb") as stream,
        np.load(stream, allow_pickle=False) as file,
    ):
        held = {name: np.asarray(file[name], _PER_POINT[name]) for name in names if name in file}
    for name, values in held.items():
        if values.shape != (count,):
            raise InputError(f"{path}: {name} has shape {values.shape} for a scan of {count} points")
    return held.get("t"), held.get("ring")


def scan_record(files: list[Path], info: SequenceInfo, voice: Voice) -> PointRecord | None:
    """The record of `.bin` files and plain arrays, None for files with named fields. Raises InputError if none or several fit."""
    suffix = files[0].suffix.lower()
    if suffix not in (".bin", ".npy"):
        return None
    some = np.unique(np.linspace(0, len(files) - 1, min(len(files), _LOOKED_AT)).astype(int)).tolist()
    read = read_bytes if suffix == ".bin" else read_array
    raw = {files[k]: data for k, data in readable(some, lambda k: read(files[k]))}
    tables = [table for table in raw.values() if not table.dtype.names]
    if suffix == ".npy" and not tables:
        return None
    if info.bin_record is not None:
        record = parse_record(info.bin_record)
        misfits = [path for path, data in raw.items() if suffix == ".bin" and len(data) % record.size]
        if 2 * len(misfits) > len(raw):
            check_size(misfits[0], raw[misfits[0]], record)
        voice.notes.append(f"points of {len(record.names)} columns, {record}, as stated")
        return record
    if suffix == ".bin":
        record, reason = record_of(raw)
        sentence = f"points of {record.size} bytes, {record}, by their values: {reason}"
    else:
        if len({table.shape[1] for table in tables}) > 1 or tables[0].shape[1] < 4:
            return None
        names = name_columns(tables)
        record = PointRecord(names, (tables[0].dtype.str,) * len(names))
        sentence = f"points of {len(names)} columns, {' '.join(names)}, by their values"
    if record.names != KITTI.names or (suffix == ".bin" and record != KITTI):
        unread = record.unread()
        voice.notes.append(sentence + (f"; {unread}, nothing says what they are" if unread else ""))
    return record
