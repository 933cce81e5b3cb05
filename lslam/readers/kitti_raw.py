"""KITTI raw drives: `<date>/<date>_drive_NNNN_{sync,extract}` with `velodyne_points/` and `oxts/`.

`sync` scans go with the camera and OXTS sample of their number, at the instant at which the scanner looks ahead. They are
distorted: KITTI's readme of the raw data asks to untwist them, that of the odometry benchmark says that its scans are
compensated "in contrast to the raw data". Times from the azimuth lie about that instant, so poses belong to it.

On drive 0005 points lie nearest to the map's planes when all of a sweep's motion is taken out (46 mm for 56 in a bend), and
icp, gicp, vgicp, ndt and loam, .02 to .17 deg apart over 10 m with it left in, agree to .01 to .03 deg. All of them are then .21
deg from OXTS, .14 when OXTS is taken to lag by 14 ms: its yaw is late in bends.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError, cause
from lslam.formats.calibration_files import read_raw_cam0_lidar, read_rigid
from lslam.formats.oxts_files import ACCEL, GYRO, POS_ACC, Oxts, read_oxts
from lslam.formats.point_files import SUFFIXES
from lslam.formats.sequence_toml import SequenceInfo
from lslam.readers.folder_sequence import FolderSequence
from lslam.readers.ground_truth import Voice, find_ground_truth, load_poses, oxts_truth, to_lidar
from lslam.readers.listing import DEFAULT_RATE_HZ, list_scans, load_stamps, nominal_stamps, rows_of
from lslam.readers.scan_folder import calibration_in, folder_sequence, stamps_by_rows
from lslam.readers.scan_records import scan_record
from lslam.readers.sidecars import (
    calibration_over,
    compensation_note,
    load_gnss,
    load_imu,
    per_point_folder,
    read_info,
    vertical_correction,
)
from lslam.types.gnss import GnssStream
from lslam.types.imu import ImuStream
from lslam.types.sequence import Calibration
from lslam.types.trajectory import Trajectory

KIND = "kitti-raw"
DRIVE = re.compile(r"\d{4}_\d\d_\d\d_drive_\d{4}(_sync|_extract)?$")
# OXTS measures every 10 ms: a scan gets one of the two samples about it, mostly the nearer one.
_OXTS_NS = 10_000_000
_EVEN = 21
# Share of a sweep that is over at its start, and when the scanner looks ahead, which is what KITTI ties cameras and OXTS to.
AT_START, AHEAD = 0.0, 0.5


def locate(folder: Path) -> tuple[Path, str] | None:
    """The drive in or at `folder` and why it is one; None when this is no KITTI raw layout.

    Raises InputError listing the drives when `folder` is a day that holds several.
    """
    if (folder / "velodyne_points").is_dir():
        return folder, "it has velodyne_points/, as KITTI raw drives do"
    if (folder / "oxts").is_dir():
        raise InputError(f"{folder} is a KITTI raw drive without velodyne_points/: fetch its velodyne data")
    try:
        drives = sorted(p for p in folder.iterdir() if DRIVE.match(p.name) and (p / "velodyne_points").is_dir())
    except OSError as error:
        raise InputError(f"{folder} cannot be read: {cause(error)}") from None
    if len(drives) > 1:
        raise InputError(f"{folder} holds {len(drives)} drives ({', '.join(p.name for p in drives)}): name one")
    return (drives[0], f"{folder} holds this single KITTI raw drive") if drives else None


def open_folder(folder: Path, overrides: SequenceInfo, why: str) -> FolderSequence:
    """Open the drive in `folder`. Raises InputError when it has no scans or a broken `sequence.toml`."""
    info, has_toml = read_info(folder, overrides)
    data = folder / "velodyne_points" / "data"
    # Unsynchronised (`extract`) drives come as text.
    files, left_out = list_scans(data, (*SUFFIXES, ".txt")) if data.is_dir() else ([], [])
    if not files:
        raise InputError(f"{data} holds no scans (*.bin or *.txt): fetch the velodyne data of this drive")
    voice = Voice([f"format {KIND}: {why}", *left_out, *compensation_note(info)], [])
    is_extract = folder.name.endswith("_extract")
    record = scan_record(files, info, voice)
    oxts = _oxts(folder, voice)
    compensated = bool(info.motion_compensated)
    files, stamps, rate, passed = _stamps(folder, info, files, oxts, is_extract, compensated, voice)
    calibration = calibration_over(info, _calibration(folder.parent, voice))
    per_point = per_point_folder(folder, info)
    sweep = None
    if not compensated and per_point is None:
        seconds = _sweeps(folder, files, rate, voice)
        wanted = AT_START if is_extract else AHEAD
        sweep = np.outer(seconds, [-wanted, 1 - wanted])
        if passed is not None and passed != wanted:
            stamps = stamps + np.round(1e9 * (wanted - passed) * seconds).astype(np.int64)
            voice.notes.append(
                "these stamps are of the scanner looking ahead: each scan begins half a sweep earlier" if is_extract else
                "these stamps are of the beginnings of sweeps: the scanner looks ahead half a sweep later"
            )  # fmt: skip
    if info.motion_compensated is None:
        voice.notes.append(
            "motion compensated: no (KITTI's raw drives are distorted; motion_compensated = true in sequence.toml "
            "leaves scans as they are)"
        )
    imu, gnss = _streams(oxts)
    return folder_sequence(
        folder, KIND, info, voice,
        files=files, stamps_ns=stamps, rate_hz=rate, motion_compensated=compensated, calibration=calibration,
        ground_truth=_ground_truth(folder, info, files, stamps, oxts, calibration, voice),
        imu=load_imu(folder, info, voice.problems) or imu, gnss=load_gnss(folder, info, voice.problems) or gnss,
        correction_deg=vertical_correction(info, files, record, voice.notes), sweep_s=sweep,
        sensor=info.sensor or (None if has_toml else "HDL-64E"), record=record,
    )  # fmt: skip


def _oxts(folder: Path, voice: Voice) -> Oxts | None:
    try:
        oxts = read_oxts(folder / "oxts")
    except InputError as error:
        voice.problems.append(f"OXTS is not used: {error}")
        return None
    if oxts is None:
        voice.problems.append(f"{folder / 'oxts'} holds no samples: no ground truth, IMU or GNSS")
        return None
    voice.problems += oxts.problems
    if oxts.stamps_ns is not None and len(oxts.stamps_ns) > 1:
        back = np.flatnonzero(np.diff(oxts.stamps_ns) <= 0)
        if len(back):
            voice.problems.append(
                f"{folder / 'oxts' / 'timestamps.txt'}: time repeats or goes back at line {back[0] + 2} "
                f"({len(back)} place{'s' if len(back) > 1 else ''})"
            )
    return oxts


def _stamps(
    folder: Path, info: SequenceInfo, files: list[Path], oxts: Oxts | None, is_extract: bool, compensated: bool,
    voice: Voice,
) -> tuple[list[Path], NDArray[np.int64], float, float | None]:  # fmt: skip
    """Stamps of the LiDAR; of OXTS by index where a shared excerpt leaves them out; else nominal.

    And the share of the sweep that is over by then, where that is known.
    """
    passed = {"timestamps.txt": AHEAD, "timestamps_start.txt": AT_START}
    names = reversed(passed) if is_extract and not compensated else passed
    paths = [folder / "velodyne_points" / name for name in names]
    if info.stamps is not None:
        paths.insert(0, folder / info.stamps)
    path = next((p for p in paths if p.is_file()), None)
    stamps = load_stamps(path, voice.problems) if path else None
    if path is not None and stamps is not None:
        voice.notes.append(f"scan stamps from {path.name}")
        is_own = info.stamps is None or path != paths[0]
        return *stamps_by_rows(files, stamps, path, info.rate_hz, voice), passed[path.name] if is_own else None
    if oxts is None or oxts.stamps_ns is None or not len(oxts.stamps_ns) or is_extract:
        rate = info.rate_hz or DEFAULT_RATE_HZ
        start = 0 if oxts is None or oxts.stamps_ns is None or not len(oxts.stamps_ns) else int(oxts.stamps_ns[0])
        voice.problems.append(
            f"no stamps of the scans in {folder / 'velodyne_points'}: they are stamped at {rate:g} Hz"
        )
        return files, nominal_stamps(len(files), rate, start), rate, None
    voice.notes.append("no velodyne_points/timestamps*.txt: scan i goes with OXTS sample i and takes its stamp")
    even = oxts.stamps_ns if compensated else _evened(oxts.numbers, oxts.stamps_ns, voice)
    full = np.full(int(oxts.numbers.max()) + 1, -1, np.int64)
    full[oxts.numbers] = even
    source = folder / "oxts" / "timestamps.txt"
    return *stamps_by_rows(files, even if (full < 0).any() else full, source, info.rate_hz, voice), AHEAD


def _evened(numbers: NDArray[np.int64], stamps_ns: NDArray[np.int64], voice: Voice) -> NDArray[np.int64]:
    """Stamps of scans `numbers`, each that of an OXTS sample near to it, as a scanner that turns evenly takes them.

    Its rate wanders by parts in a thousand: each stamp becomes that of the line through the `_EVEN` about it.
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
    voice.notes.append(f"OXTS samples lie 10 ms apart: stamps are evened out, by {1e-6 * off.max():.1f} ms at most")
    return even


def _sweeps(folder: Path, files: list[Path], rate: float, voice: Voice) -> NDArray[np.float64]:
    """Duration of each sweep, s, from KITTI's start and end stamps, else one period."""
    voice.notes.append("per-point times from the azimuth: the HDL-64E turns clockwise and a scan starts behind")
    ends = [folder / "velodyne_points" / f"timestamps_{which}.txt" for which in ("start", "end")]
    nominal = np.full(len(files), 1 / rate)
    if not all(p.is_file() for p in ends):
        return nominal
    start, end = (load_stamps(p, voice.problems) for p in ends)
    if start is None or end is None or len(start) != len(end):
        return nominal
    rows, _ = rows_of(files, len(start))
    seconds = (end - start) * 1e-9
    return np.asarray(
        np.where((rows >= 0) & (seconds[rows] > 0.5 / rate) & (seconds[rows] < 2 / rate), seconds[rows], 1 / rate)
    )


def _calibration(day: Path, voice: Voice) -> Calibration:
    matrices = []
    for name, read in (("imu_to_velo", read_rigid), ("velo_to_cam", lambda path: read_raw_cam0_lidar(path.parent))):
        path = day / f"calib_{name}.txt"
        if not path.is_file():
            voice.notes.append(f"{path} is missing")
        matrices.append(calibration_in(path, read, voice) if path.is_file() else None)
    T_lidar_imu, T_cam0_lidar = matrices
    # The OXTS position is that of the IMU's origin (devkit readme), so both extrinsics are one.
    return Calibration(T_cam0_lidar, T_lidar_imu, T_lidar_imu)


def _streams(oxts: Oxts | None) -> tuple[ImuStream | None, GnssStream | None]:
    if oxts is None or oxts.stamps_ns is None:
        return None, None
    imu = ImuStream(oxts.stamps_ns, oxts.values[:, ACCEL].copy(), oxts.values[:, GYRO].copy())
    return imu, GnssStream(oxts.stamps_ns, oxts.values[:, :3].copy(), oxts.values[:, POS_ACC].copy())


def _ground_truth(
    folder: Path, info: SequenceInfo, files: list[Path], stamps: NDArray[np.int64], oxts: Oxts | None,
    calibration: Calibration, voice: Voice,
) -> Trajectory | None:  # fmt: skip
    if info.ground_truth is not None:
        path = find_ground_truth(folder, info, voice)
        truth = load_poses(path, stamps, files, voice) if path else None
        return to_lidar(truth, info.ground_truth_frame or truth.frame, calibration, voice) if truth else None
    return None if oxts is None else oxts_truth(oxts, stamps, calibration.T_lidar_imu, voice)
