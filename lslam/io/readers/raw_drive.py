"""IMU and GNSS of a KITTI odometry sequence: the benchmark leaves them out, the raw drive it was cut from has them."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lslam.core.errors import InputError
from lslam.core.types.sequence import Sequence
from lslam.io.formats.calibration_files import read_rigid
from lslam.io.formats.oxts_files import read_oxts
from lslam.io.formats.time_columns import read_stamps
from lslam.io.readers.bag_topics import GNSS, IMU, Companion, why_none
from lslam.io.readers.folder_sequence import FolderSequence
from lslam.io.readers.kitti_odometry import KIND
from lslam.io.readers.kitti_raw import oxts_streams
from lslam.io.readers.lookup import sequence_number

# Sequence -> drive and its first frame (KITTI odometry development kit).
DRIVES = {
    "00": ("2011_10_03", 27, 0), "01": ("2011_10_03", 42, 0), "02": ("2011_10_03", 34, 0), "03": ("2011_09_26", 67, 0),
    "04": ("2011_09_30", 16, 0), "05": ("2011_09_30", 18, 0), "06": ("2011_09_30", 20, 0), "07": ("2011_09_30", 27, 0),
    "08": ("2011_09_30", 28, 1100), "09": ("2011_09_30", 33, 0), "10": ("2011_09_30", 34, 0),
}  # fmt: skip
CALIBRATION = "calib_imu_to_velo.txt"
# The sequence lies so many folders below the data root at most: kitti/dataset/sequences/NN.
_UPWARDS = 4


def with_streams(sequence: Sequence, imu: bool, gnss: bool, data_root: Path | None = None) -> Sequence:
    """The sequence with the streams that are asked for, by `with_imu` and `with_gnss`; those it has stay."""
    if imu:
        sequence = with_imu(sequence, data_root)
    return with_gnss(sequence, data_root) if gnss else sequence


def with_imu(sequence: Sequence, data_root: Path | None = None) -> Sequence:
    """The sequence with an IMU: its own, else, for a KITTI odometry sequence, that of its raw drive.

    The drive is looked for below `data_root`, LSLAM_DATA, the current folder, that of the sequence and those it lies in, as
    `raw/<date>/<drive>_extract` (100 Hz) or `_sync` (10 Hz), with or without `raw` and `<date>`, with
    `calib_imu_to_velo.txt` beside it.

    Raises InputError naming the paths looked at, UsageError when a bag has several to choose from.
    """
    if sequence.imu is not None:
        return sequence
    if not hasattr(sequence, "bag") and not _is_cut(sequence):
        if isinstance(sequence, FolderSequence):
            raise InputError(
                f"{sequence.path} has no IMU: looked for {sequence.path / 'imu.csv'} and `imu` in sequence.toml there; "
                "add it, or run without --imu, by a method that needs none"
            )
        raise InputError(
            f"{sequence.path} ({sequence.kind}) has no IMU: run without --imu, by a method that needs none"
        )
    return _with_oxts(sequence, data_root, IMU, "IMU", "imu.csv")


def with_gnss(sequence: Sequence, data_root: Path | None = None) -> Sequence:
    """The sequence with satellite fixes: its own, else, for a KITTI odometry sequence, those of its raw drive, as `with_imu`.

    Other folders come back as they are. Raises as `with_imu`.
    """
    if sequence.gnss is not None or not (hasattr(sequence, "bag") or _is_cut(sequence)):
        return sequence
    return _with_oxts(sequence, data_root, GNSS, "satellite fixes", "gnss.csv")


def _is_cut(sequence: Sequence) -> bool:
    """Whether a sequence is known to be cut from a raw drive."""
    is_kitti = isinstance(sequence, FolderSequence) and sequence.kind == KIND
    return is_kitti and sequence_number(sequence.path.name) in DRIVES


def _with_oxts(sequence: Sequence, data_root: Path | None, kind: Companion, what: str, file: str) -> Sequence:
    """The sequence with a stream of its raw drive. Raises InputError naming `what` is missing and the `file` with it."""
    if not isinstance(sequence, FolderSequence):
        raise why_none(sequence.bag, kind)  # type: ignore[attr-defined]
    date, number, first = DRIVES[sequence_number(sequence.path.name)]
    roots = [Path(root).expanduser() for root in (data_root, os.environ.get("LSLAM_DATA")) if root]
    places = dict.fromkeys([*roots, sequence.path, *list(sequence.path.parents)[: 1 + _UPWARDS], Path.cwd()])
    folders = [
        place / above / day / f"{date}_drive_{number:04d}_{kind}"
        for kind in ("extract", "sync")
        for above, day in (("raw", date), ("", date), ("raw", ""), ("", ""), ("kitti_raw", date))
        for place in places
    ]
    drive = next((f for f in folders if (f / "oxts" / "data").is_dir()), None)
    if drive is None:
        named = ", ".join(map(str, dict.fromkeys([*roots, Path.cwd()])))
        raise InputError(
            f"{sequence.path} has no {what}, as in KITTI odometry: looked for {sequence.path / file} and for the raw drive "
            f"raw/{date}/{date}_drive_{number:04d}_sync or _extract, with or without raw/ and {date}/, in {named}, that folder "
            f"and the {_UPWARDS} above it; fetch the drive, or run without {kind.wish}"
        )
    beside = [folder / CALIBRATION for folder in (drive.parent, drive, drive.parent / date, drive.parent.parent)]
    calibration = next((path for path in beside if path.is_file()), None)
    if calibration is None:
        raise InputError(f"{beside[0]} is missing: it says how the IMU sits, fetch the calibration of that day")
    oxts = read_oxts(drive / "oxts")
    if oxts is None or oxts.stamps_ns is None or not len(oxts.stamps_ns):
        raise InputError(f"{drive / 'oxts'} holds no samples with stamps (data/*.txt and timestamps.txt)")
    begin_ns, clock = _begin(drive, first)
    stamps_ns = oxts.stamps_ns - begin_ns + int(sequence.stamps_ns[0])
    rate_hz = 1e9 / float(np.median(np.diff(stamps_ns))) if len(stamps_ns) > 1 else 0.0
    source = f"{drive} at {rate_hz:.0f} Hz, its frame {first} by {clock} taken as the first scan"
    imu, gnss = oxts_streams(oxts, stamps_ns)
    T_lidar_imu = read_rigid(calibration)
    # The position that OXTS gives is that of the IMU's origin (devkit readme).
    parts: dict[str, Any] = (
        {"imu": imu, "calibration": replace(sequence.calibration, T_lidar_imu=T_lidar_imu)} if kind is IMU else
        {"gnss": gnss, "calibration": replace(sequence.calibration, T_lidar_gnss=T_lidar_imu)}
    )  # fmt: skip
    problems = list(dict.fromkeys([*sequence.problems, *oxts.problems]))
    return replace(sequence, notes=[*sequence.notes, f"{kind.name} of {source}"], problems=problems, **parts)


def _begin(drive: Path, first: int) -> tuple[int, str]:
    """When the first scan was taken, ns, and which file says so: camera 0 is what KITTI's times.txt counts from."""
    sync = drive.with_name(drive.name.replace("_extract", "_sync"))
    for name in ("image_00", "velodyne_points", "oxts"):
        path = sync / name / "timestamps.txt"
        stamps_ns = read_stamps(path) if path.is_file() else ()
        if len(stamps_ns) > first:
            return int(stamps_ns[first]), f"{name}/{path.name}"
    raise InputError(
        f"{drive} does not say when its frame {first} was taken: image_00/timestamps.txt of {sync} is needed"
    )
