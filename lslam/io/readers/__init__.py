"""Readers: each turns a data set on disk into a Sequence.

A new reader is one file with `locate` and `open_folder`, and one line here. Other packages register such a module as entry
point `lslam.readers`; it is tried on folders that no built-in reader accepts. Nothing heavy is imported before the reader is
chosen.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lslam.core.errors import InputError, LslamError, UsageError, cause
from lslam.core.extras import find_plugins, load
from lslam.io.formats.bag_listing import holds_recording
from lslam.io.readers.lookup import find_folder
from lslam.io.remote import RemotePath

if TYPE_CHECKING:
    from lslam.core.types.sequence import Sequence
    from lslam.io.formats.sequence_toml import SequenceInfo

GROUP = "lslam.readers"
# Tried in this order: a KITTI layout is also a folder with scans somewhere in it.
READERS = {
    "bag": "lslam.io.readers.bag",
    "pcap": "lslam.io.readers.pcap",
    "kitti-odometry": "lslam.io.readers.kitti_odometry",
    "kitti-raw": "lslam.io.readers.kitti_raw",
    "scan-folder": "lslam.io.readers.scan_folder",
}


def open_sequence(
    name_or_path: str | Path,
    *,
    data_root: Path | None = None,
    rows: int | None = None,
    cols: int | None = None,
    rate_hz: float | None = None,
    motion_compensated: bool | None = None,
    vertical_correction_deg: float | None = None,
    lidar_topic: str | None = None,
    lidar_frame: str | None = None,
    imu_topic: str | None = None,
    gnss_topic: str | None = None,
    point_times: str | None = None,
    extrinsics: str | None = None,
    imu: bool = False,
    gnss: bool = False,
) -> Sequence:
    """Open a recorded sequence without reading its scans.

    Parameters
    ----------
    name_or_path : a folder, a bag, or a name looked up under `data_root` (or LSLAM_DATA): `seq07`, `07`, a raw drive
    rows, cols : organised clouds: point r * cols + c is of ring r
    rate_hz : nominal scan rate, where stamps are missing
    motion_compensated : whether scans are free of motion distortion
    vertical_correction_deg : rotation of every point about p x z; None leaves it to the reader
    lidar_topic, imu_topic, gnss_topic : which topics of a bag are read, where it has several
    lidar_frame : which of the LiDARs that share a topic, by the frame of their messages, or `all`
    point_times : what tells the times of points: field, columns, order, azimuth or none; None and auto find out
    extrinsics : T_lidar_imu, as numbers or a file (see `read_transform`)
        What is given wins over `sequence.toml`, which wins over what the layout implies.
    imu, gnss : whether the stream is needed: if the recording has none, it is searched elsewhere, as in KITTI's raw drive

    Raises
    ------
    InputError naming where it looked and what is wrong; UsageError for values that make no sense.
    """
    if (rows is None) != (cols is None) or min(rows or 1, cols or 1) < 1:
        raise UsageError(f"rows {rows} and cols {cols} of organised clouds go together and are above 0")
    with _readable(name_or_path):
        folder = find_folder(name_or_path, data_root)
        if not isinstance(folder, RemotePath):
            # Absolute, but links kept: `sequences/07` may be one, and its poses lie beside the link.
            folder = Path(os.path.abspath(folder))
    from lslam.io.formats.calibration_files import read_transform
    from lslam.io.formats.sequence_toml import SequenceInfo, is_rate

    if rate_hz is not None and not is_rate(rate_hz):
        raise UsageError(f"a scan rate of {rate_hz} Hz makes no sense")
    topics: dict[str, Any] = {
        "lidar_topic": lidar_topic,
        "lidar_frame": lidar_frame,
        "imu_topic": imu_topic,
        "gnss_topic": gnss_topic,
    }
    overrides = SequenceInfo(
        rows=rows,
        cols=cols,
        rate_hz=rate_hz,
        motion_compensated=motion_compensated,
        vertical_correction_deg=vertical_correction_deg,
        point_times=None if point_times == "auto" else point_times,
        T_lidar_imu=None if extrinsics is None else read_transform(extrinsics),
        **topics,
    )
    with _readable(name_or_path):
        sequence = _open(folder, overrides)
    from lslam.io.readers.kitti_raw import with_streams

    given = [f"--{key.replace('_', '-')}" for key, name in topics.items() if name is not None]
    if given and sequence.kind != "bag":
        raise UsageError(f"{', '.join(given)} is for bags: {folder} is {sequence.kind}")
    sequence = with_streams(sequence, imu, gnss, data_root)
    if sequence.kind == "bag" or sequence.kind not in READERS:
        return sequence
    return _merge_lidars(sequence, overrides)


@contextmanager
def _readable(name: str | Path) -> Iterator[None]:
    """Turn an OSError of the block into an InputError that names the file or the requested path."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{error.filename or name} cannot be read: {cause(error)}") from None


def _merge_lidars(sequence: Sequence, overrides: SequenceInfo) -> Sequence:
    """Sequence merged with the LiDARs in the table `lidars` of its `sequence.toml`. Raises InputError when one is missing."""
    from lslam.io.formats.sequence_toml import FILE_NAME, SequenceInfo
    from lslam.io.readers.sidecars import read_info
    from lslam.registration.preprocessing.views import FurtherLidar, MergedLidars

    folder = sequence.path if sequence.path.is_dir() else sequence.path.parent
    of_all = SequenceInfo(motion_compensated=overrides.motion_compensated)
    others = []
    for name, T in (read_info(folder, overrides)[0].lidars or {}).items():
        if not (folder / name).exists():
            raise InputError(f"{folder / name}, named by lidars of {folder / FILE_NAME}, does not exist")
        others.append(FurtherLidar(name, _open(folder / name, of_all), T))
    return MergedLidars(sequence, others) if others else sequence


def _open(folder: Path, overrides: SequenceInfo) -> Sequence:
    has_recording = holds_recording(folder)
    for kind, dotted in READERS.items():
        if kind in ("bag", "pcap") and not has_recording:  # their modules are many
            continue
        sequence = _opened_by(import_module(dotted), folder, overrides)
        if sequence is not None:
            return sequence
    nothing = _nothing_in(folder)
    for entry in find_plugins(GROUP, READERS).values():
        try:
            sequence = _opened_by(load(entry, "reader"), folder, overrides)
        except LslamError as error:
            nothing += f"; {error}"
        except Exception as error:
            nothing += f"; reader {entry.name!r} failed on it: {type(error).__name__}: {error}"
        else:
            if sequence is not None:
                return sequence
    raise InputError(nothing)


def _opened_by(reader: Any, folder: Path, overrides: SequenceInfo) -> Sequence | None:
    located = reader.locate(folder)
    return None if located is None else reader.open_folder(located[0], overrides, located[1])


def _nothing_in(folder: Path) -> str:
    inside = sorted(p.name for p in folder.iterdir())
    if not inside:
        return f"{folder} is empty: there is no sequence in it"
    shown = ", ".join(inside[:8]) + (", ..." if len(inside) > 8 else "")
    return (
        f"{folder} holds no scans: looked for velodyne/, sequences/, velodyne_points/, bags, captures and *.bin, *.pcd, *.ply, "
        f"*.npy here and in data/, found {shown}"
    )
