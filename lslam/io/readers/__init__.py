"""Readers: each turns a data set on disk, found by what the user typed, into a Sequence.

A new reader is one file with `locate` and `open_folder`, and one line here. Other packages register such a module as entry
point `lslam.readers`; it is tried on folders that no built-in reader accepts. Nothing heavy is imported before the reader is
chosen.
"""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lslam.core.errors import InputError, LslamError, UsageError, cause
from lslam.core.extras import find_plugins, load
from lslam.io.formats.bag_listing import CAPTURES, SUFFIXES, holds_recording, list_bag_files
from lslam.io.remote import RemotePath, as_path

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
_SEQUENCE = re.compile(r"(?:.*/)?(?:seq)?(\d{1,2})$")
_DRIVE_NAME = re.compile(r"(?:(?P<date>\d{4}_\d\d_\d\d)_)?(?:drive_)?(?P<number>\d{4})(?P<kind>_sync|_extract)?$")
DRIVE = re.compile(r"(?P<date>\d{4}_\d\d_\d\d)_drive_(?P<number>\d{4})(?P<kind>_sync|_extract)?$")
_ROOTS = ("", "dataset", "kitti", "kitti/dataset", "raw", "kitti_raw", "kitti/raw")


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

    Arguments override `sequence.toml`, which overrides the defaults of the layout.

    Parameters
    ----------
    name_or_path : a folder, a bag, or a name looked up under `data_root` (or LSLAM_DATA): `seq07`, `07`, a raw drive
    rows, cols : organised clouds: point r * cols + c is of ring r
    rate_hz : nominal scan rate, if stamps are missing
    motion_compensated : whether scans are free of motion distortion
    vertical_correction_deg : rotation of every point about p x z; None leaves it to the reader
    lidar_topic, imu_topic, gnss_topic : topics of a bag to read, if it has several
    lidar_frame : which of the LiDARs that share a topic, by the frame of their messages, or `all`
    point_times : source of the times of points: field, columns, order, azimuth or none; None and auto find out
    extrinsics : T_lidar_imu, as numbers or a file (see `read_transform`)
    imu, gnss : whether the stream is needed: if the recording has none, it is searched elsewhere, as in KITTI's raw drive

    Raises
    ------
    InputError naming the places searched and the fault; UsageError for invalid values.
    """
    if (rows is None) != (cols is None) or min(rows or 1, cols or 1) < 1:
        raise UsageError(f"rows {rows} and cols {cols} of organised clouds go together and are above 0")
    with _readable(name_or_path):
        folder = find_folder(name_or_path, data_root)
        if not isinstance(folder, RemotePath):
            # Absolute, but links kept: `sequences/07` may be one, and its poses lie beside the link.
            folder = Path(os.path.abspath(folder))
    from lslam.io.formats.kitti_layout import read_transform
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
    """Open `folder` by the first reader, built-in or plug-in, that accepts it; raises InputError if none does."""
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
    """The folder opened by the reader; None if the reader does not accept it."""
    located = reader.locate(folder)
    return None if located is None else reader.open_folder(located[0], overrides, located[1])


def _nothing_in(folder: Path) -> str:
    """Message for a folder without a recording, with its content."""
    inside = sorted(p.name for p in folder.iterdir())
    if not inside:
        return f"{folder} is empty: there is no sequence in it"
    shown = ", ".join(inside[:8]) + (", ..." if len(inside) > 8 else "")
    return (
        f"{folder} holds no scans: looked for velodyne/, sequences/, velodyne_points/, bags, captures and *.bin, *.pcd, *.ply, "
        f"*.npy here and in data/, found {shown}"
    )


def find_folder(name_or_path: str | Path, data_root: Path | None = None) -> Path:
    """Folder or bag of a sequence: `name_or_path` itself if it exists, else the name looked up under `data_root`.

    `data_root` is LSLAM_DATA when None; the current folder comes after it. `seq07`, `07` and `kitti/07` find `sequences/07`
    and folders of those names; a drive is found by its name, by `drive_0005` or `0005` when only one has it.
    Raises InputError naming the places searched and similar names.
    """
    text = str(name_or_path)
    path = as_path(name_or_path).expanduser()
    if path.is_dir() or is_recording(path):
        return path
    if path.exists():
        known = ", ".join("*" + suffix for suffix in (*SUFFIXES, *CAPTURES))
        raise InputError(
            f"{path} is a file: give a bag or a capture ({known}) or the folder of the sequence (a KITTI "
            "sequence, a raw drive, or its scans)"
        )
    if isinstance(path, RemotePath):
        raise InputError(f"no sequence {text!r}: no such bucket, object or folder")
    if data_root is None and os.environ.get("LSLAM_DATA"):
        data_root = Path(os.environ["LSLAM_DATA"])
    here = Path.cwd()
    places = [here]
    if data_root is not None:
        root = data_root.expanduser()
        if not root.is_dir():
            raise InputError(f"no sequence {text!r}: the data root {root} does not exist")
        if (root / text).is_dir() or is_recording(root / text):
            return root / text
        places = [root, here]
    matches = next((m for place in places if (m := _sequences(place, text) or _drives(place, text))), [])
    if len(matches) == 1:
        return matches[0]
    if matches:
        raise InputError(f"{text!r} may be any of {', '.join(str(p) for p in matches)}: name one of them")
    if data_root is not None:
        raise InputError(_no_sequence(text, places[0]))
    raise InputError(
        f"no sequence {text!r}: {path} does not exist, nor is it in {here}; names such as seq07 need --data-root or "
        "LSLAM_DATA where their data set is elsewhere"
    )


def is_recording(path: Path) -> bool:
    """Whether `path` is a bag, a folder of its parts, or a packet capture."""
    return bool(list_bag_files(path)) or (path.suffix.lower() in CAPTURES and path.is_file())


def sequence_number(name: str) -> str:
    """Number of a KITTI odometry sequence in a name of the user or of a folder; empty when it is none.

    >>> sequence_number("seq07"), sequence_number("kitti/7"), sequence_number("town")
    ('07', '07', '')
    """
    match = _SEQUENCE.match(name)
    return match.group(1).zfill(2) if match else ""


def _sequences(root: Path, text: str) -> list[Path]:
    """The KITTI odometry sequence below `root` that the text names, in a list; empty without one."""
    number = sequence_number(text)
    if not number:
        return []
    folders = [root / part / name for name in (f"sequences/{number}", f"seq{number}", number) for part in _ROOTS]
    return [p for p in folders if p.is_dir()][:1]


def _drives(root: Path, text: str) -> list[Path]:
    """KITTI raw drives below `root` that match a whole or partial name."""
    wanted = _DRIVE_NAME.match(text.rsplit("/", 1)[-1])
    if not wanted:
        return []
    parts = {name: part for name, part in wanted.groupdict().items() if part is not None}
    return [
        path
        for path in _all_drives(root)
        if (drive := DRIVE.match(path.name)) and parts.items() <= drive.groupdict().items()
    ]


def _all_drives(root: Path) -> list[Path]:
    """All KITTI raw drives below `root`, sorted."""
    places = [root, *(p for part in _ROOTS if (p := root / part).is_dir() and part)]
    days = [d for place in places for d in place.glob("[0-9]*_[0-9]*_[0-9]*") if d.is_dir()]
    candidates = [p for place in [*places, *days] for p in place.glob("*_drive_*") if p.is_dir()]
    return sorted({p for p in candidates if DRIVE.match(p.name)})


def _no_sequence(text: str, root: Path) -> str:
    """Message for a name that no sequence below `root` has, with similar names."""
    sequences = [p for part in _ROOTS for p in (root / part / "sequences").glob("*/")]
    folders = [p.name for p in root.glob("*/") if p.name not in ("sequences", "poses")]
    names = sorted({*(f"seq{p.name}" for p in sequences), *(p.name for p in _all_drives(root)), *folders})
    near = difflib.get_close_matches(text, names, n=3, cutoff=0.5) or names[:12]
    hint = f"; there are {', '.join(near)}" if near else "; it is empty"
    return f"no sequence {text!r}: looked for {Path(text)}, {root / text}, sequences/ and raw drives under {root}{hint}"
