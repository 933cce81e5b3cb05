"""When two runs are the same run: the digest of configuration, input and version."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lslam.config import Config
from lslam.errors import InputError, cause
from lslam.remote import RemotePath
from lslam.types.sequence import Sequence
from lslam.types.trajectory import Trajectory
from lslam.version import __version__


def input_digest(sequence: Sequence, truth: Trajectory | None) -> str:
    """Digest of a recording without reading its scans: path, number of scans, size and time of every file, the truth's poses.

    Raises InputError when the folder cannot be listed.
    """
    digest = _listing(sequence.path, len(sequence))
    truth = sequence.ground_truth if truth is None else truth
    if truth is not None:
        digest.update(truth.stamps_ns.tobytes())
        digest.update(truth.poses.tobytes())
    return digest.hexdigest()


def listing_digest(path: Path) -> str:
    """Likewise of a recording that is not opened: what is in it follows from its files.

    Raises InputError when it cannot be listed.
    """
    return _listing(path, 0).hexdigest()


def _listing(path: Path, scans: int) -> hashlib._Hash:
    digest = hashlib.sha256(f"{path}\0{scans}\0".encode(errors="surrogateescape"))
    try:
        for name, stat in _files(path):
            line = f"{name}\0{stat.st_size}\0{stat.st_mtime_ns}\n"
            digest.update(line.encode(errors="surrogateescape"))
    except OSError as error:
        raise InputError(f"{error.filename or path} cannot be read: {cause(error)}") from None
    return digest


def imu_digest(sequence: Sequence) -> str:
    """Digest of what the IMU measured and where it sits: for KITTI odometry that lies outside of the recording's folder."""
    digest = hashlib.sha256()
    imu, T_lidar_imu = sequence.imu, sequence.calibration.T_lidar_imu
    for values in () if imu is None else (imu.stamps_ns, imu.accel, imu.gyro):
        digest.update(np.ascontiguousarray(values).tobytes())
    digest.update(b"" if T_lidar_imu is None else np.ascontiguousarray(T_lidar_imu).tobytes())
    return digest.hexdigest()


def job_digest(config: Config, of_input: str, of_imu: str = "") -> str:
    """Digest of a run: its resolved configuration, its input, the IMU if it uses one, and lslam's version.

    Which metrics are shown makes no other run.
    """
    known = config.model_dump(mode="json", exclude={"eval": {"metrics"}})
    said: dict[str, Any] = {"config": known, "input": of_input, "lslam": __version__}
    if config.imu.use:
        said["imu"] = of_imu
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()


def _files(path: Path) -> Iterator[tuple[str, os.stat_result]]:
    """Every file of a recording in a fixed order, links followed: KITTI's velodyne folders often are links."""
    if path.is_file():
        yield path.name, path.stat()
        return
    if isinstance(path, RemotePath):
        yield from path.files()
        return
    # Plain words instead of paths: of thousands of files they take a third of the time, in every run of a study.
    for folder, inner, names in os.walk(path, followlinks=True):
        inner.sort()
        place = os.path.relpath(folder, path)
        for name in sorted(names):
            file = os.path.join(folder, name)
            if os.path.isfile(file):
                yield os.path.normpath(os.path.join(place, name)), os.stat(file)
