"""Going on with a run that was killed or interrupted: what it shares with its resumption, as digests."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lslam.core import __version__
from lslam.core.config import Config
from lslam.core.errors import (
    GateError,
    InputError,
    OutputExistsError,
    RunFailedError,
    RunFinishedError,
    cause,
)
from lslam.core.printable import first_of, printable_tree
from lslam.core.types.imu import WheelStream
from lslam.core.types.sequence import Sequence
from lslam.core.types.trajectory import Trajectory
from lslam.core.untrusted import MISFIT, parse_json, parse_toml
from lslam.io.remote import RemotePath
from lslam.osm.source import extract_digest
from lslam.pipeline.job import is_open
from lslam.pipeline.run_folder import MANIFEST

# Keys that change no byte of the result, or only which of its metrics are shown.
FREE = ("input.threads", "odometry.checkpoint_s", "eval.metrics")
# What it means that a digest of `run_identity` is another.
INPUTS = {
    "input": "the recording or its ground truth is another or was changed",
    "reading": "the recording is read in another way (times, extrinsics, topic)",
    "imu": "the IMU's samples are others",
    "wheels": "the readings of --wheels are others",
    "gnss": "the satellite fixes are others",
    "osm": "the extract of OpenStreetMap is another",
    "poses": "the poses of --poses are others",
    "manual": "the pairs of --loops-file or the points of --control are others",
}


def input_digest(sequence: Sequence, truth: Trajectory | None) -> str:
    """Digest of a recording by its path, number of scans, sizes and times of its files, and the truth's poses; no scan is read.

    Raises InputError when the folder cannot be listed.
    """
    digest = _listing(sequence.path, len(sequence))
    for other in getattr(sequence, "further_lidars", ()):  # further LiDARs, whose folders may lie elsewhere
        if other.scans.path != sequence.path:
            digest.update(_listing(other.scans.path, len(other.scans)).digest())
    truth = sequence.ground_truth if truth is None else truth
    if truth is not None:
        digest.update(truth.stamps_ns.tobytes())
        digest.update(truth.poses.tobytes())
    return digest.hexdigest()


def listing_digest(path: Path) -> str:
    """`input_digest` of an unopened recording, by its listing. Raises InputError when it cannot be listed."""
    return _listing(path, 0).hexdigest()


def _listing(path: Path, scans: int) -> hashlib._Hash:
    """SHA-256 of path, number of scans, and names, sizes and times of all files; raises InputError when not listable."""
    digest = hashlib.sha256(f"{path}\0{scans}\0".encode(errors="surrogateescape"))
    try:
        for name, stat in _files(path):
            line = f"{name}\0{stat.st_size}\0{stat.st_mtime_ns}\n"
            digest.update(line.encode(errors="surrogateescape"))
    except OSError as error:
        raise InputError(f"{error.filename or path} cannot be read: {cause(error)}") from None
    return digest


def imu_digest(sequence: Sequence) -> str:
    """Digest of the IMU's data and mounting. For KITTI odometry these are outside of the recording's folder."""
    digest = hashlib.sha256()
    imu, T_lidar_imu = sequence.imu, sequence.calibration.T_lidar_imu
    for values in () if imu is None else (imu.stamps_ns, imu.accel, imu.gyro):
        digest.update(np.ascontiguousarray(values).tobytes())
    digest.update(b"" if T_lidar_imu is None else np.ascontiguousarray(T_lidar_imu).tobytes())
    return digest.hexdigest()


def job_digest(config: Config, of_input: str, of_imu: str = "") -> str:
    """Digest of a run's configuration, except metrics shown, of input, IMU if used, and lslam's version."""
    tree = config.model_dump(mode="json", exclude={"eval": {"metrics"}})
    content: dict[str, Any] = {"config": tree, "input": of_input, "lslam": __version__}
    if config.imu.use:
        content["imu"] = of_imu
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


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


def run_identity(
    sequence: Sequence,
    truth: Trajectory | None,
    config: Config,
    poses: Trajectory | None = None,
    wheels: WheelStream | None = None,
) -> dict[str, str]:
    """Facts that a run and its resumption must share beside the configuration; for manifest.json.

    poses : of --poses; wheels : the readings of --wheels

    Raises InputError when the recording cannot be listed.
    """
    reading = hashlib.sha256(np.ascontiguousarray(sequence.stamps_ns).tobytes())
    for name, T in sorted(sequence.calibration.extrinsics.items()):
        reading.update(f"{name} {None if T is None else np.asarray(T).tolist()}".encode())
    # Not how the reader was found: a path of the recording itself and one above it are read alike.
    notes = [note for note in sequence.notes if not note.startswith("format ")]
    reading.update(repr((sequence.kind, sequence.motion_compensated, notes)).encode(errors="surrogateescape"))
    gnss = sequence.gnss if config.gnss.mode != "off" else None
    return {
        "input": input_digest(sequence, truth),
        "reading": reading.hexdigest(),
        "imu": imu_digest(sequence) if config.imu.use else "",
        "wheels": "" if wheels is None else _digest(vars(wheels).values()),
        "gnss": _digest(() if gnss is None else vars(gnss).values()),
        "osm": extract_digest(config.osm),
        "poses": _digest(() if poses is None else (poses.stamps_ns, poses.poses)),
        "manual": _content(config.loops.file, config.graph.control),
    }


def _content(*paths: str) -> str:
    """Digest of the content of files; empty without any."""
    try:
        contents = [Path(path).read_bytes() for path in paths if path]
    except OSError as error:
        raise InputError(f"{error.filename} cannot be read: {cause(error)}") from None
    return hashlib.sha256(b"\0".join(contents)).hexdigest() if contents else ""


def _digest(values: Iterable[Any]) -> str:
    """SHA-256, hexadecimal, of the arrays' types and bytes; None counts, too."""
    digest = hashlib.sha256()
    for value in values:
        array = None if value is None else np.ascontiguousarray(value)
        digest.update(
            f"{None if array is None else array.dtype}".encode() + (b"" if array is None else array.tobytes())
        )
    return digest.hexdigest()


def may_go_on(folder: Path, identity: dict[str, str], config: Config) -> bool:
    """Whether there is a run to resume; False when nothing was begun in `folder`.
    Raises RunFinishedError: the run is finished. RunFailedError, GateError: it diverged, or is degraded and `input.strict`
    OutputExistsError: the folder has another run, or a damaged one.
    """
    if not (folder / MANIFEST).is_file():
        return False
    try:
        manifest = parse_json((folder / MANIFEST).read_text(encoding="utf-8"))
        before = parse_toml((folder / "config.toml").read_text(encoding="utf-8"))
        status, version, inputs = str(manifest["status"]), str(manifest["lslam"]), dict(manifest["identity"])
    except (OSError, *MISFIT) as error:
        raise OutputExistsError(
            f"the run in {folder} does not say what it was ({type(error).__name__}: {error}): --overwrite replaces it"
        ) from None
    why = _difference(inputs, version, before, identity, config)
    if why:
        raise OutputExistsError(f"the run in {folder} cannot go on: {why}; --overwrite runs it anew")
    _raise_outcome(folder, status, manifest, config)
    return True


def _difference(
    inputs: dict[str, Any], version: str, tree: dict[str, Any], identity: dict[str, str], config: Config
) -> str:
    """First kind of difference from the earlier run, in words: version, configuration, inputs; empty without any.

    inputs, tree : digests and configuration of the earlier run; identity : digests of this one
    """
    if version != __version__:
        return f"it was begun by lslam {version}, this is {__version__}"
    before, now = map(_flat, (tree, printable_tree(config.model_dump(mode="json"))))
    # What the scene decided of an open key is taken from the run that was begun.
    differing = [key for key in sorted(before | now) if before.get(key) != now.get(key)]
    changed = [key for key in differing if key not in FREE and not is_open(config, key)]
    unknown = set(_flat(printable_tree(Config().model_dump(mode="json")))) - set(before)
    if changed and set(changed) <= unknown:
        return f"it was begun by an earlier lslam, which had no {first_of(changed)}"
    if changed:
        values = [f"{key} was {before.get(key)!r} and is {now.get(key)!r}" for key in changed[:3]]
        return f"the configuration differs: {', '.join(values)}{', ...' if len(changed) > 3 else ''}"
    return "; ".join(text for name, text in INPUTS.items() if inputs.get(name, "") != identity[name])


def _raise_outcome(folder: Path, status: str, manifest: dict[str, Any], config: Config) -> None:
    """Raise the error for a finished run: RunFailedError, GateError or RunFinishedError; nothing for an unfinished one."""
    problems = manifest.get("problems")
    why = "; ".join(map(str, problems)) if isinstance(problems, list) else ""
    state = f"the run in {folder} is finished"
    if status == "diverged":
        raise RunFailedError(f"{state}, it diverged: {why}; --overwrite runs it anew")
    if status == "degraded" and config.input.strict:
        raise GateError(f"--strict: {state} and degraded: {why}")
    if status in ("done", "degraded"):
        raise RunFinishedError(f"{state} ({status}): nothing is left to do")


def _flat(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Values by `section.key`; null values, which TOML lacks, are left out."""
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{prefix}{key}.")
        elif value is not None:
            flat[prefix + key] = value
    return flat
