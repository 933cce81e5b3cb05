"""KITTI raw drives: `<date>/<date>_drive_NNNN_{sync,extract}` with `velodyne_points/` and `oxts/`.

A `sync` scan has the number of its camera image and OXTS sample, taken when the scanner looks ahead. Its points are
distorted: KITTI's readme of the raw data asks to untwist them, that of the odometry benchmark says that its scans are
compensated "in contrast to the raw data". Times from the azimuth are relative to that instant, so poses belong to it.

On drive 0005 points lie nearest to the map's planes when all of a sweep's motion is taken out (46 mm for 56 in a bend), and
icp, gicp, vgicp, ndt and loam, .02 to .17 deg apart over 10 m with it left in, agree to .01 to .03 deg. All of them are then .21
deg from OXTS, .14 when OXTS is taken to lag by 14 ms: its yaw is late in bends.
"""

from __future__ import annotations

import os
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.errors import InputError, input_errors
from lslam.core.geometry import geodesy, se3, so3
from lslam.core.types.gnss import GnssStream
from lslam.core.types.imu import ImuStream
from lslam.core.types.sequence import Calibration, Sequence
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats.kitti_layout import (
    ACCEL,
    GYRO,
    POS_ACC,
    ROLL,
    YAW,
    Oxts,
    read_oxts,
    read_raw_cam0_lidar,
    read_rigid,
)
from lslam.io.formats.point_files import SUFFIXES
from lslam.io.formats.sequence_toml import SequenceInfo
from lslam.io.formats.time_columns import read_stamps
from lslam.io.readers import DRIVE, sequence_number
from lslam.io.readers.bag_topics import GNSS, IMU, Companion, why_none
from lslam.io.readers.cameras import kitti_raw_cameras
from lslam.io.readers.folder_sequence import Folder, FolderSequence
from lslam.io.readers.ground_truth import find_ground_truth, oxts_truth, to_lidar
from lslam.io.readers.kitti_odometry import KIND as KITTI_ODOMETRY
from lslam.io.readers.listing import DEFAULT_RATE_HZ, list_scans, load_stamps, nominal_stamps, rows_of
from lslam.io.readers.sidecars import calibration_over, load_streams, vertical_correction

KIND = "kitti-raw"
# OXTS measures every 10 ms: a scan gets one of the two samples about it, mostly the nearer one.
_OXTS_NS = 10_000_000
_EVEN = 21
# Share of a sweep that is over at its start, and when the scanner looks ahead, which is what KITTI ties cameras and OXTS to.
AT_START, AHEAD = 0.0, 0.5
# Sequence -> drive and its first frame (KITTI odometry development kit).
DRIVES = {
    "00": ("2011_10_03", 27, 0),
    "01": ("2011_10_03", 42, 0),
    "02": ("2011_10_03", 34, 0),
    "03": ("2011_09_26", 67, 0),
    "04": ("2011_09_30", 16, 0),
    "05": ("2011_09_30", 18, 0),
    "06": ("2011_09_30", 20, 0),
    "07": ("2011_09_30", 27, 0),
    "08": ("2011_09_30", 28, 1100),
    "09": ("2011_09_30", 33, 0),
    "10": ("2011_09_30", 34, 0),
}
CALIBRATION = "calib_imu_to_velo.txt"
# The IMU in `base_link` as kitti2bag has it, m: on the ground in the middle of the car, axes alike.
T_BASE_IMU = se3.make(np.eye(3), np.array([-2.71 / 2 - 0.05, 0.32, 0.93]))
# The sequence lies so many folders below the data root at most: kitti/dataset/sequences/NN.
_UPWARDS = 4


def locate(folder: Path) -> tuple[Path, str] | None:
    """Drive in or at `folder`, and why it is one, or None. Raises InputError that lists several drives."""
    if (folder / "velodyne_points").is_dir():
        return folder, "it has velodyne_points/, as KITTI raw drives do"
    if (folder / "oxts").is_dir():
        raise InputError(f"{folder} is a KITTI raw drive without velodyne_points/: fetch its velodyne data")
    with input_errors(folder):
        drives = sorted(p for p in folder.iterdir() if DRIVE.match(p.name) and (p / "velodyne_points").is_dir())
    if len(drives) > 1:
        raise InputError(f"{folder} holds {len(drives)} drives ({', '.join(p.name for p in drives)}): name one")
    return (drives[0], f"{folder} holds this single KITTI raw drive") if drives else None


def open_folder(path: Path, overrides: SequenceInfo, why: str) -> FolderSequence:
    """Open the drive in `path`; overrides : outrank `sequence.toml`; why : reason for this format, for the notes.

    Raises InputError when it has no scans or a broken `sequence.toml`.
    """
    data = path / "velodyne_points" / "data"
    # Unsynchronised (`extract`) drives come as text.
    scans = list_scans(data, (*SUFFIXES, ".txt")) if data.is_dir() else ([], [])
    nothing = f"{data} holds no scans (*.bin or *.txt): fetch the velodyne data of this drive"
    folder = Folder.begin(path, KIND, why, overrides, scans, nothing)
    info, voice = folder.info, folder.voice
    is_extract = path.name.endswith("_extract")
    oxts = _oxts(folder)
    compensated = bool(info.motion_compensated)
    stamps, rate, passed = _stamps(folder, oxts, is_extract)
    calibration = calibration_over(info, _calibration(folder))
    sweep = None
    if not compensated and info.per_point is None:
        seconds = _sweeps(folder, rate)
        wanted = AT_START if is_extract else AHEAD
        sweep = np.outer(seconds, [-wanted, 1 - wanted])
        if passed is not None and passed != wanted:
            stamps = stamps + np.round(1e9 * (wanted - passed) * seconds).astype(np.int64)
            voice.notes.append(
                "these stamps are of the scanner looking ahead: each scan begins half a sweep earlier"
                if is_extract
                else "these stamps are of the beginnings of sweeps: the scanner looks ahead half a sweep later"
            )
    if info.motion_compensated is None:
        voice.notes.append(
            "motion compensated: no (KITTI's raw drives are distorted; motion_compensated = true in sequence.toml "
            "leaves scans as they are)"
        )
    imu, gnss = load_streams(path, info, voice)
    if oxts is not None and oxts.stamps_ns is not None:
        of_oxts = oxts_streams(oxts, oxts.stamps_ns)
        imu, gnss = imu or of_oxts[0], gnss or of_oxts[1]
    return folder.sequence(
        stamps_ns=stamps,
        rate_hz=rate,
        motion_compensated=compensated,
        calibration=calibration,
        ground_truth=_ground_truth(folder, stamps, oxts, calibration),
        imu=imu,
        gnss=gnss,
        correction_deg=vertical_correction(info, folder.files, folder.record, voice.notes),
        sweep_s=sweep,
        sensor=info.sensor or (None if folder.has_toml else "HDL-64E"),
        open_cameras=partial(kitti_raw_cameras, path),
    )


def _oxts(folder: Folder) -> Oxts | None:
    """OXTS packets of the drive; None, with a problem, without valid ones."""
    place, problems = folder.path / "oxts", folder.voice.problems
    try:
        oxts = read_oxts(place)
    except InputError as error:
        problems.append(f"OXTS is not used: {error}")
        return None
    if oxts is None:
        problems.append(f"{place} holds no samples: no ground truth, IMU or GNSS")
        return None
    problems += oxts.problems
    back = np.flatnonzero(np.diff(() if oxts.stamps_ns is None else oxts.stamps_ns) <= 0)
    if len(back):
        problems.append(
            f"{place / 'timestamps.txt'}: time repeats or goes back at line {back[0] + 2} "
            f"({len(back)} place{'s' if len(back) > 1 else ''})"
        )
    return oxts


def _stamps(folder: Folder, oxts: Oxts | None, is_extract: bool) -> tuple[Longs, float, float | None]:
    """Stamps of the LiDAR, of OXTS by index, or nominal; rate, Hz; share of the sweep before them. is_extract : no sync drive."""
    info, voice = folder.info, folder.voice
    compensated = bool(info.motion_compensated)
    passed = {"timestamps.txt": AHEAD, "timestamps_start.txt": AT_START}
    names = reversed(passed) if is_extract and not compensated else passed
    paths = [folder.path / "velodyne_points" / name for name in names]
    if info.stamps is not None:
        paths.insert(0, folder.path / info.stamps)
    path = next((p for p in paths if p.is_file()), None)
    stamps = load_stamps(path, voice.problems) if path else None
    if path is not None and stamps is not None:
        voice.notes.append(f"scan stamps from {path.name}")
        is_own = info.stamps is None or path != paths[0]
        return *folder.take_rows(path, stamps), passed[path.name] if is_own else None
    by_oxts = np.zeros(0, np.int64) if oxts is None or oxts.stamps_ns is None else oxts.stamps_ns
    if oxts is None or not len(by_oxts) or is_extract:
        rate = info.rate_hz or DEFAULT_RATE_HZ
        voice.problems.append(
            f"no stamps of the scans in {folder.path / 'velodyne_points'}: they are stamped at {rate:g} Hz"
        )
        return nominal_stamps(len(folder.files), rate, int(by_oxts[0]) if len(by_oxts) else 0), rate, None
    voice.notes.append("no velodyne_points/timestamps*.txt: scan i goes with OXTS sample i and takes its stamp")
    even = by_oxts if compensated else _smooth_stamps(oxts.numbers, by_oxts, folder)
    full = np.full(int(oxts.numbers.max()) + 1, -1, np.int64)
    full[oxts.numbers] = even
    source = folder.path / "oxts" / "timestamps.txt"
    return *folder.take_rows(source, even if (full < 0).any() else full), AHEAD


def _smooth_stamps(numbers: Longs, stamps_ns: Longs, folder: Folder) -> Longs:
    """Stamps of scans `numbers` with the jitter of OXTS samples removed, since the scanner turns evenly.

    The scanner's rate drifts by a thousandth or so, so a line is fitted to the `_EVEN` stamps about each.
    """
    if len(stamps_ns) < 3:
        return stamps_ns
    even = np.empty_like(stamps_ns)
    for k in range(len(stamps_ns)):
        first = max(min(k - _EVEN // 2, len(stamps_ns) - _EVEN), 0)
        near = slice(first, first + _EVEN)
        x, y = numbers[near] - numbers[k], stamps_ns[near] - stamps_ns[k]
        even[k] = stamps_ns[k] + round(np.polyfit(x, y, 1)[1])
    off = np.abs(even - stamps_ns)
    if not 0 < off.max() <= _OXTS_NS:
        return stamps_ns
    folder.voice.notes.append(
        f"OXTS samples lie 10 ms apart: stamps are evened out, by {1e-6 * off.max():.1f} ms at most"
    )
    return even


def _sweeps(folder: Folder, rate: float) -> Floats:
    """Duration of each sweep, s, from KITTI's start and end stamps, else one period."""
    folder.voice.notes.append("per-point times from the azimuth: the HDL-64E turns clockwise and a scan starts behind")
    ends = [folder.path / "velodyne_points" / f"timestamps_{which}.txt" for which in ("start", "end")]
    nominal = np.full(len(folder.files), 1 / rate)
    if not all(p.is_file() for p in ends):
        return nominal
    start, end = (load_stamps(p, folder.voice.problems) for p in ends)
    if start is None or end is None or len(start) != len(end):
        return nominal
    rows, _ = rows_of(folder.files, len(start))
    seconds = ((end - start) * 1e-9)[rows]
    return np.where((rows >= 0) & (seconds > 0.5 / rate) & (seconds < 2 / rate), seconds, nominal)


def _calibration(folder: Folder) -> Calibration:
    """Calibration of the drive's day; a missing file is noted."""
    matrices = []
    for name, read in (("imu_to_velo", read_rigid), ("velo_to_cam", lambda path: read_raw_cam0_lidar(path.parent))):
        path = folder.path.parent / f"calib_{name}.txt"
        if not path.is_file():
            folder.voice.notes.append(f"{path} is missing")
        matrices.append(folder.calibration(path, read) if path.is_file() else None)
    T_lidar_imu, T_cam0_lidar = matrices
    # The OXTS position is that of the IMU's origin (devkit readme), so both extrinsics are one.
    return Calibration(T_cam0_lidar, T_lidar_imu, T_lidar_imu, _frames(T_lidar_imu))


def _frames(T_lidar_imu: Floats | None) -> dict[str, Floats]:
    """Further frame of the car: the middle of the car on the ground."""
    return {} if T_lidar_imu is None else {"base_link": T_lidar_imu @ se3.inverse(T_BASE_IMU)}


def oxts_streams(oxts: Oxts, stamps_ns: Longs) -> tuple[ImuStream, GnssStream]:
    """IMU and fixes of OXTS at `stamps_ns` (N,)."""
    imu = ImuStream(stamps_ns, oxts.values[:, ACCEL].copy(), oxts.values[:, GYRO].copy())
    return imu, GnssStream(stamps_ns, oxts.values[:, :3].copy(), oxts.values[:, POS_ACC].copy())


def _ground_truth(folder: Folder, stamps: Longs, oxts: Oxts | None, calibration: Calibration) -> Trajectory | None:
    """LiDAR poses from the ground truth file that is stated, else from OXTS; None without either."""
    if folder.info.ground_truth is None:
        return None if oxts is None else oxts_truth(oxts, stamps, calibration.T_lidar_imu, folder.voice)
    truth = folder.truth(find_ground_truth(folder.path, folder.info, folder.voice), stamps)
    return None if truth is None else to_lidar(truth, truth.frame, calibration, folder.voice)


def with_streams(sequence: Sequence, imu: bool, gnss: bool, data_root: Path | None = None) -> Sequence:
    """Sequence with the required streams, by `with_imu` and `with_gnss`; existing ones stay."""
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
    if not hasattr(sequence, "bag") and not _is_drive_part(sequence):
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
    if sequence.gnss is not None or not (hasattr(sequence, "bag") or _is_drive_part(sequence)):
        return sequence
    return _with_oxts(sequence, data_root, GNSS, "satellite fixes", "gnss.csv")


def _is_drive_part(sequence: Sequence) -> bool:
    """Whether a sequence is known to be a part of a raw drive."""
    is_kitti = isinstance(sequence, FolderSequence) and sequence.kind == KITTI_ODOMETRY
    return is_kitti and sequence_number(sequence.path.name) in DRIVES


def _with_oxts(sequence: Sequence, data_root: Path | None, kind: Companion, what: str, file: str) -> Sequence:
    """Sequence with a stream of its raw drive. Raises InputError naming `what` is missing, and the `file` that holds it."""
    if not isinstance(sequence, FolderSequence):
        raise why_none(sequence.bag, kind)  # type: ignore[attr-defined]
    first = DRIVES[sequence_number(sequence.path.name)][2]
    missing = f"{sequence.path} has no {what}, as in KITTI odometry: looked for {sequence.path / file} and"
    drive, calibration = _drive_of(sequence.path, data_root, missing, kind.wish)
    oxts, oxts_ns = _samples(drive)
    begin_ns, clock = _begin(drive, first)
    stamps_ns = oxts_ns - begin_ns + int(sequence.stamps_ns[0])
    rate_hz = 1e9 / float(np.median(np.diff(stamps_ns))) if len(stamps_ns) > 1 else 0.0
    source = f"{drive} at {rate_hz:.0f} Hz, its frame {first} by {clock} taken as the first scan"
    imu, gnss = oxts_streams(oxts, stamps_ns)
    T_lidar_imu = read_rigid(calibration)
    known = replace(sequence.calibration, frames={**_frames(T_lidar_imu), **sequence.calibration.frames})
    # The position that OXTS gives is that of the IMU's origin (devkit readme).
    parts: dict[str, Any] = (
        {"imu": imu, "calibration": replace(known, T_lidar_imu=T_lidar_imu)}
        if kind is IMU
        else {"gnss": gnss, "calibration": replace(known, T_lidar_gnss=T_lidar_imu)}
    )
    problems = list(dict.fromkeys([*sequence.problems, *oxts.problems]))
    return replace(sequence, notes=[*sequence.notes, f"{kind.name} of {source}"], problems=problems, **parts)


def start_on_earth(folder: Path, data_root: Path | None = None) -> tuple[Floats, float]:
    """Position and heading of the LiDAR of a KITTI odometry sequence at its first scan, by OXTS of the raw drive (`with_imu`).

    (3,) latitude, longitude (deg) and height (m), and heading, deg clockwise from north. `folder` may not exist.
    Raises InputError naming the paths searched.
    """
    drive, calibration = _drive_of(folder, data_root, "no OXTS: looked", "it")
    first = DRIVES[sequence_number(folder.name)][2]
    oxts, oxts_ns = _samples(drive)
    sample = oxts.values[np.abs(oxts_ns - _begin(drive, first)[0]).argmin()]
    T_enu_imu = se3.make(so3.from_euler_rpy(sample[None, ROLL : YAW + 1])[0], np.zeros(3))
    T_enu_lidar = T_enu_imu @ se3.inverse(read_rigid(calibration))
    place = geodesy.from_local(T_enu_lidar[None, :3, 3], sample[:3])[0]
    return place, 90.0 - float(np.degrees(np.arctan2(T_enu_lidar[1, 0], T_enu_lidar[0, 0])))


def _drive_of(folder: Path, data_root: Path | None, missing: str, wish: str) -> tuple[Path, Path]:
    """Raw drive of the sequence in `folder`, and calibration file. Raises InputError: `missing`, and to run without `wish`."""
    date, number, _ = DRIVES[sequence_number(folder.name)]
    roots = [Path(root).expanduser() for root in (data_root, os.environ.get("LSLAM_DATA")) if root]
    places = dict.fromkeys([*roots, folder, *list(folder.parents)[: 1 + _UPWARDS], Path.cwd()])
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
            f"{missing} for the raw drive "
            f"raw/{date}/{date}_drive_{number:04d}_sync or _extract, with or without raw/ and {date}/, in {named}, that folder "
            f"and the {_UPWARDS} above it; fetch the drive, or run without {wish}"
        )
    beside = [folder / CALIBRATION for folder in (drive.parent, drive, drive.parent / date, drive.parent.parent)]
    calibration = next((path for path in beside if path.is_file()), None)
    if calibration is None:
        raise InputError(f"{beside[0]} is missing: it says how the IMU sits, fetch the calibration of that day")
    return drive, calibration


def _samples(drive: Path) -> tuple[Oxts, Longs]:
    """OXTS samples of a drive and their stamps, ns; raises InputError without any."""
    oxts = read_oxts(drive / "oxts")
    if oxts is None or oxts.stamps_ns is None or not len(oxts.stamps_ns):
        raise InputError(f"{drive / 'oxts'} holds no samples with stamps (data/*.txt and timestamps.txt)")
    return oxts, oxts.stamps_ns


def _begin(drive: Path, first: int) -> tuple[int, str]:
    """Time of frame `first`, ns, and the file that has it; times.txt counts from camera 0's image. InputError without any."""
    sync = drive.with_name(drive.name.replace("_extract", "_sync"))
    for name in ("image_00", "velodyne_points", "oxts"):
        path = sync / name / "timestamps.txt"
        stamps_ns = read_stamps(path) if path.is_file() else ()
        if len(stamps_ns) > first:
            return int(stamps_ns[first]), f"{name}/{path.name}"
    raise InputError(
        f"{drive} does not say when its frame {first} was taken: image_00/timestamps.txt of {sync} is needed"
    )
