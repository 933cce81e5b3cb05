"""KITTI odometry layout: `sequences/NN/{velodyne/*.bin, calib.txt, times.txt}` and `poses/NN.txt`."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from lslam.core.arrays import Floats, Longs
from lslam.core.errors import InputError
from lslam.core.printable import printable
from lslam.core.types.sequence import Calibration
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats.kitti_layout import read_odometry_calib
from lslam.io.formats.point_records import KITTI
from lslam.io.formats.sequence_toml import SequenceInfo
from lslam.io.readers import sequence_number
from lslam.io.readers.cameras import kitti_cameras
from lslam.io.readers.folder_sequence import Folder, FolderSequence
from lslam.io.readers.ground_truth import find_ground_truth, to_lidar
from lslam.io.readers.listing import DEFAULT_RATE_HZ, list_scans, load_stamps, nominal_stamps
from lslam.io.readers.sidecars import calibration_over, vertical_correction

KIND = "kitti-odometry"


def locate(folder: Path) -> tuple[Path, str] | None:
    """Sequence folder in or at `folder`, and why it is one, or None.

    Raises InputError that lists several, and for a folder `sequences` without any.
    """
    if (folder / "velodyne").is_dir():
        return folder, "it has velodyne/, as KITTI odometry sequences do"
    for sequences in (folder / "sequences", folder / "dataset" / "sequences"):
        if sequences.is_dir():
            drives = sorted(p for p in sequences.iterdir() if (p / "velodyne").is_dir())
            if len(drives) == 1:
                return drives[0], f"{sequences} holds this single KITTI odometry sequence"
            names = ", ".join(p.name for p in drives)
            if drives:
                raise InputError(f"{folder} holds {len(drives)} sequences ({names}): name one, for example {drives[0]}")
            raise InputError(f"{sequences} holds no sequence with a velodyne folder: fetch the velodyne data")
    return None


def open_folder(path: Path, overrides: SequenceInfo, why: str) -> FolderSequence:
    """Open the sequence in `path`; overrides : outrank `sequence.toml`; why : reason for this format, for the notes.

    Raises InputError when it has no scans or a broken `sequence.toml`.
    """
    nothing = f"{path / 'velodyne'} holds no scans (*.bin): fetch the velodyne data of this sequence"
    folder = Folder.begin(path, KIND, why, overrides, list_scans(path / "velodyne"), nothing)
    info, voice, record = folder.info, folder.voice, folder.record
    stamps, rate = _stamps(folder)
    calibration = calibration_over(info, Calibration(T_cam0_lidar=_tr(folder)))
    # The benchmark's points have no times: scans with times are of another sensor.
    has_times = record is not None and "time" in record.names
    has_times_stated = info.per_point is not None or info.point_times not in (None, "none")
    is_benchmark = info.motion_compensated is None and not has_times and not has_times_stated
    compensated = True if is_benchmark else info.motion_compensated
    if is_benchmark:
        voice.notes.append("scans are motion compensated, as in the KITTI odometry benchmark")
    return folder.sequence(
        name=info.name or (f"seq{path.name}" if path.name.isdigit() else printable(path.name)),
        stamps_ns=stamps,
        rate_hz=rate,
        motion_compensated=compensated,
        calibration=calibration,
        ground_truth=_ground_truth(folder, stamps, calibration),
        correction_deg=vertical_correction(info, folder.files, record, voice.notes),
        sensor=info.sensor or (None if folder.has_toml or record != KITTI else "HDL-64E"),
        clock=folder.clock(stamps, rate) if has_times and not compensated else None,
        open_cameras=partial(kitti_cameras, path, folder.files, stamps, calibration.T_cam0_lidar),
    )


def _stamps(folder: Folder) -> tuple[Longs, float]:
    """Stamps (N,), ns, of the scans, by the file of times or else nominal, and the rate, Hz."""
    path = folder.path / (folder.info.stamps or "times.txt")
    stamps = load_stamps(path, folder.voice.problems) if path.is_file() else None
    if stamps is not None:
        return folder.take_rows(path, stamps)
    rate = folder.info.rate_hz or DEFAULT_RATE_HZ
    folder.voice.notes.append(f"no usable {path.name}: scans are stamped at {rate:g} Hz")
    return nominal_stamps(len(folder.files), rate), rate


def _tr(folder: Folder) -> Floats | None:
    """`T_cam0_lidar` (4, 4) of `calib.txt`; None, with a note, when it is missing."""
    path = folder.path / "calib.txt"
    if not path.is_file():
        folder.voice.notes.append(f"{path} is missing: the camera's place is unknown")
        return None
    return folder.calibration(path, _read_tr)


def _read_tr(path: Path) -> Floats:
    """`T_cam0_lidar` (4, 4) of a `calib.txt`. Raises InputError without one."""
    T_cam0_lidar = read_odometry_calib(path)
    if T_cam0_lidar is None:
        raise InputError(f"{path} has no Tr (T_cam0_lidar): poses cannot be carried between camera and LiDAR")
    return T_cam0_lidar


def _ground_truth(folder: Folder, stamps: Longs, calibration: Calibration) -> Trajectory | None:
    """Ground truth of the sequence as LiDAR poses; None without it."""
    number = sequence_number(folder.path.name) or folder.path.name
    usual = [above / "poses" / f"{number}.txt" for above in (folder.path.parent.parent, folder.path.parent)]
    path = next((p for p in usual if p.is_file()), None)
    if folder.info.ground_truth is not None:
        path = find_ground_truth(folder.path, folder.info, folder.voice)
    elif path is None and (folder.path / "poses.txt").is_file():
        folder.voice.notes.append(
            f"{folder.path / 'poses.txt'} (SemanticKITTI) holds SLAM estimates, it is not taken as ground truth"
        )
    truth = folder.truth(path, stamps)
    if truth is None:
        return None
    if truth.frame == "cam0":
        folder.voice.notes.append(f"ground truth {path}: camera 0 poses, carried to the LiDAR with Tr")
    return to_lidar(truth, truth.frame, calibration, folder.voice)
