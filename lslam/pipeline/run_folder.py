"""Run folder: locked by one process; every file is written under a temporary name and renamed, the status last."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import shutil
import time
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import IO, Any

from lslam.core.errors import InputError, LslamError, OutputError, OutputExistsError, cause, input_errors, output_errors
from lslam.core.kernels.cache import cache_folder
from lslam.core.machine import lock
from lslam.core.printable import file_safe
from lslam.io.formats.atomic import atomic_write
from lslam.io.remote import RemotePath

log = logging.getLogger("lslam")

MANIFEST = "manifest.json"
LOG = "log.txt"
LOCK = ".lock"
KEYFRAMES = "keyframes"
SESSIONS = "sessions"
CHECKPOINT = "checkpoint"
# Among the keyframes of a run that is over: what its pose graph was made of.
ODOMETRY, IMU_START = "odometry.npz", "imu.npz"
REPLIES = "osm_replies"
SPOOL = ".lslam-map-"  # what a map in the making is called, as its merger does
# What a run that goes on needs of what the one before left.
_FOR_RESUMING = (MANIFEST, "config.toml", LOG)
OURS = (
    *(MANIFEST, "config.toml", LOG),
    *("trajectory.tum", "trajectory_kitti.txt", "covariances.npz"),
    *("map.ply", "map.pcd", "map.las", "map.laz", "map.json", "map_mesh.ply", "feature_map.ply", "trajectory.geojson"),
    *("occupancy.npz", "occupancy.ply", "floor_plan.png", "floor_plan.yaml"),
    *("evaluation.json", "trajectory_odometry.tum", "loops.csv", "control.csv", "graph.g2o"),
    *("osm_matches.csv", "buildings.geojson", "buildings.osm"),
    *("timing.csv", "scans.csv", "imu_states.csv", "localization.csv", "sessions.csv", "report.html"),
)
UPLOADED_FROM = "spool"


class RunFolder:
    """Output folder of a run, locked by this process while it is open.

    overwrite : delete an earlier run's files; goes_on : keep its checkpoint and keyframes, delete its results

    Raises OutputExistsError when the folder exists and neither is set, when it exists and is no run folder, or
    when another process has locked it; OutputError when it cannot be written.
    """

    def __init__(self, path: Path, overwrite: bool = False, goes_on: bool = False) -> None:
        self.path = path
        self._lock: IO[str] | None = None
        self._log_handler: _LogFile | None = None
        try:
            _require_free(path, overwrite or goes_on)
            path.mkdir(parents=True, exist_ok=True)
            self._lock = _hold(path)
            self._clear(_FOR_RESUMING if goes_on else ())
        except OSError as error:
            self._let_go()
            raise OutputError(f"output folder {path} cannot be written: {cause(error)}") from None

    def write_text(self, name: str, text: str) -> Path:
        r"""Write one text file atomically; bytes of file names that are no UTF-8 become \udcXX, as JSON writes them."""
        return self.write_bytes(name, text.encode(errors="backslashreplace"))

    def write_bytes(self, name: str, data: bytes) -> Path:
        """Write one file atomically."""
        target = self.path / name
        with atomic_write(target) as stream:
            stream.write(data)
        return target

    def write_manifest(self, manifest: dict[str, Any]) -> None:
        """Write manifest.json."""
        text = json.dumps(manifest, indent=2, ensure_ascii=False, default=str, allow_nan=False)
        self.write_text(MANIFEST, text + "\n")

    def require_space(self, size: int, what: str) -> None:
        """Raise OutputError when the disk has less than `size` bytes left for `what`."""
        with output_errors(f"output folder {self.path}"):
            free = shutil.disk_usage(self.path).free
        if free < size:
            raise OutputError(
                f"the disk of {self.path} has {free / 1e6:.1f} MB left, {what} needs about {size / 1e6:.1f} MB; "
                "free some space or name another folder with --out"
            )

    def write_failure(self, manifest: dict[str, Any]) -> None:
        """Write the manifest of a run that failed; a full disk at this point must not hide the first error."""
        try:
            self.write_manifest(manifest)
        except OutputError as error:
            log.error("%s", error)

    def drop_checkpoint(self) -> None:
        """Delete the checkpoint of a finished run."""
        shutil.rmtree(self.path / CHECKPOINT, ignore_errors=True)

    def keep_odometry(self) -> None:
        """Keep the checkpoint of odometry of a finished run beside the keyframes, for another pose graph.

        The checkpoints stay too, until `drop_checkpoint`: nothing is lost in between.
        """
        files = [*sorted((self.path / CHECKPOINT).glob("odometry-*.npz"))[-1:], self.path / CHECKPOINT / IMU_START]
        if (self.path / KEYFRAMES).is_dir():
            for file in files:
                name = IMU_START if file.name == IMU_START else ODOMETRY
                with contextlib.suppress(FileNotFoundError):
                    _share(file, self.path / KEYFRAMES / name)

    def begin_from(self, run: Path) -> None:
        """Link or copy another run's keyframes and odometry unless they exist. Raises OutputError if it fails."""
        source = run / KEYFRAMES
        if any((self.path / CHECKPOINT).glob("odometry-*.npz")):
            return  # the last of the files that are laid there
        with output_errors(f"output folder {self.path}"):
            for name in (KEYFRAMES, CHECKPOINT):
                (self.path / name).mkdir(exist_ok=True)
            for file in sorted(source.glob("*.npz")):
                place = {ODOMETRY: f"{CHECKPOINT}/odometry-{0:07d}.npz", IMU_START: f"{CHECKPOINT}/{IMU_START}"}
                _share(file, self.path / place.get(file.name, f"{KEYFRAMES}/{file.name}"))

    def __enter__(self) -> RunFolder:
        """Begin to copy lslam's log into log.txt."""
        try:
            self._log_handler = _LogFile(self.path / LOG)
        except OSError as error:
            self._let_go()
            raise OutputError(f"{self.path / LOG} cannot be written: {cause(error)}") from None
        self._log_handler.attach()
        return self

    def __exit__(self, *_: object) -> None:
        """Unlock the folder; remove everything if not even the status could be written."""
        if self._log_handler is not None:
            self._log_handler.detach()
        if not (self.path / MANIFEST).exists():
            # Not even the status could be written: leave nothing that looks like a run.
            with contextlib.suppress(OSError):
                self._clear()
        self._let_go()
        with contextlib.suppress(OSError):
            self.path.rmdir()  # only when it is empty

    def _let_go(self) -> None:
        """Remove the lock file and release the lock."""
        if self._lock is not None:
            with contextlib.suppress(OSError):
                (self.path / LOCK).unlink(missing_ok=True)
            self._lock.close()
            self._lock = None

    def _clear(self, others: Collection[str] = ()) -> None:
        """Remove an earlier run's files except the `others`; with others, keyframes and checkpoints for resuming remain too."""
        for name in OURS:
            if name in others:
                continue
            (self.path / name).unlink(missing_ok=True)
            (self.path / f"{name}.part").unlink(missing_ok=True)
        _clear_spools(self.path)  # of a run that was killed
        if not others:
            _clear_own(self.path / KEYFRAMES, "*.npz")
            _clear_own(self.path / REPLIES, "*.json")
            _clear_own(self.path / SESSIONS, "*.tum")
            self.drop_checkpoint()


def _share(file: Path, target: Path) -> None:
    """Link the file under another name, or copy it; files of a run are replaced, never changed."""
    if not file.is_file():
        raise FileNotFoundError(file)
    part = target.with_name(f"{target.name}.part")
    part.unlink(missing_ok=True)
    try:
        os.link(file, part)
    except OSError:
        shutil.copyfile(file, part)
    os.replace(part, target)


def _clear_own(folder: Path, names: str) -> None:
    """Remove the files that a run keeps in a folder of its own, and the folder when nothing else is in it."""
    for file in (*folder.glob(names), *folder.glob(f"{names}.part")):
        file.unlink()
    with contextlib.suppress(OSError):
        folder.rmdir()


class _LogFile(logging.FileHandler):
    """Handler of log.txt: messages shown to the user and everything from INFO on, also for Python callers without logging."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, encoding="utf-8", errors="backslashreplace")
        self.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
        self._level_before = log.level

    def attach(self) -> None:
        """Attach to the logger; its level is lowered meanwhile."""
        self._level_before = log.level
        if log.getEffectiveLevel() > logging.INFO:
            log.setLevel(logging.INFO)
        log.addHandler(self)

    def detach(self) -> None:
        """Detach from the logger and restore its level."""
        log.removeHandler(self)
        log.setLevel(self._level_before)
        with contextlib.suppress(OSError):  # a full disk shows up where results are written
            self.close()

    def handleError(self, record: logging.LogRecord) -> None:
        """Ignore errors: a full disk must not print a traceback per line, and the results' own error follows."""


def check_target(path: Path, overwrite: bool) -> None:
    """Raise what `RunFolder` would for an existing folder, without locking or writing."""
    with output_errors(f"output folder {path}"):
        _require_free(path, overwrite)


def require_new(path: Path, overwrite: bool, flag: str = "--out") -> None:
    """Raise OutputExistsError for a file that is there and may not be replaced; flag : by which another one is named."""
    if path.exists() and not overwrite:
        raise OutputExistsError(f"{path} exists; name another file with {flag} or replace it with --overwrite")


def require_run(path: Path) -> None:
    """Raise InputError unless `path` is the folder of a run."""
    if not path.is_dir():
        raise InputError(f"{path} is no folder of a run: name what `lslam run` wrote")
    with input_errors(f"{path} is no folder of a run: {MANIFEST}"):
        (path / MANIFEST).stat()


def require_odometry(path: Path) -> None:
    """Raise InputError unless the run in `path` has the files for `RunFolder.begin_from`."""
    if not (path / KEYFRAMES / ODOMETRY).is_file():
        if (path / CHECKPOINT).is_dir():
            raise InputError(
                f"the run in {path} is not finished: go on with lslam run SEQUENCE --out {path} --resume first"
            )
        raise InputError(
            f"{path} kept no state of its odometry, as runs with odometry.checkpoint_s = 0 and those of an earlier lslam: run "
            "the sequence again"
        )


def _require_free(path: Path, overwrite: bool) -> None:
    """Raise OutputExistsError unless `path` is absent, empty, or an unlocked run that may be overwritten."""
    if not path.exists():
        return
    if not path.is_dir():
        raise OutputExistsError(f"output {path} is a file; name a folder with --out")
    if not any(path.iterdir()):
        return
    if _is_in_use(path):
        raise _in_use(path)
    if not overwrite:
        raise OutputExistsError(
            f"output folder {path} exists; --resume goes on with a run that was interrupted, --overwrite replaces it, or "
            "name another with --out"
        )
    if not (path / MANIFEST).exists() and not (path / LOCK).exists():
        raise OutputExistsError(f"output folder {path} is not a run of lslam; --overwrite replaces runs only")


def _in_use(path: Path) -> OutputExistsError:
    """The error about a folder that another process has locked."""
    return OutputExistsError(f"output folder {path} is in use by another run; name another with --out")


def _is_in_use(path: Path) -> bool:
    """Whether another process has locked the folder."""
    try:
        with (path / LOCK).open("r") as stream:
            return not lock(stream)
    except OSError:
        return False


def _hold(path: Path) -> IO[str]:
    """Lock the folder; raises OutputExistsError if another process holds it. A lock file removed meanwhile is opened again."""
    while True:
        stream = (path / LOCK).open("a")
        if not lock(stream):
            stream.close()
            raise _in_use(path)
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(stream.fileno()), os.stat(path / LOCK)):
                return stream
        stream.close()


@contextlib.contextmanager
def lock_folder(path: Path) -> Iterator[None]:
    """Lock a finished run's folder for changes. Raises OutputExistsError while another process works in it.

    Remains of a killed process are removed. Raises OutputError where nothing can be written.
    """
    with output_errors(path):
        stream = _hold(path)
    try:
        _clear_spools(path)
        yield
    finally:
        with contextlib.suppress(OSError):
            (path / LOCK).unlink(missing_ok=True)
        stream.close()


def _clear_spools(path: Path) -> None:
    """Delete temporary folders that a killed process left in a run folder."""
    for folder in path.glob(f"{SPOOL}*"):
        shutil.rmtree(folder, ignore_errors=True)


def default_folder(sequence: str, method: str, now: float | None = None) -> Path:
    """runs/<sequence>-<method>-<time>, with a number appended when two runs start in the same second."""
    stamp = time.strftime("%Y%m%d-%H%M%S", time.localtime(now))
    name = file_safe(sequence)
    folder = Path("runs") / f"{name}-{method}-{stamp}"
    number = 2
    while folder.exists():
        folder = folder.with_name(f"{name}-{method}-{stamp}-{number}")
        number += 1
    return folder


def spool_of(place: Path) -> Path:
    """Local folder in which the run for `place` is written: `place` itself, or for storage a folder in the cache, the same for
    every attempt. Raises OutputError.
    """
    if not isinstance(place, RemotePath):
        return place
    folder = cache_folder(UPLOADED_FROM)
    if folder is None:
        raise OutputError(f"{place} needs a folder to be filled in: name a folder of your own in XDG_CACHE_HOME")
    return folder / f"{place.name}-{hashlib.sha256(str(place).encode()).hexdigest()[:12]}"


def check_place(place: RemotePath, may_replace: bool) -> None:
    """Raise OutputExistsError for a run in storage that may not be replaced, and for objects that belong to no run."""
    inside = {path.name for path in place.glob("*")}
    if place.is_file() or inside - {*OURS, KEYFRAMES, REPLIES}:
        raise OutputExistsError(f"output folder {place} is not a run of lslam; --overwrite replaces runs only")
    # Without a manifest it is what an upload left that was broken off.
    if MANIFEST in inside and not may_replace:
        raise OutputExistsError(
            f"output folder {place} exists; --resume keeps a run that is finished, --overwrite replaces it, or name another "
            "with --out"
        )


def upload(folder: Path, place: RemotePath) -> None:
    """Upload the run to `place`, manifest last, delete `folder`. Raises StorageError naming the results' folder."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and _is_result(path.relative_to(folder))]
    names = [path.relative_to(folder).as_posix() for path in files]
    try:
        (place / MANIFEST).unlink(missing_ok=True)
        for name, path in zip(names, files, strict=True):
            if name != MANIFEST:
                (place / name).upload(path)
        for name, _ in place.files():
            if name not in names:  # of the run that is replaced
                (place / name).unlink(missing_ok=True)
        (place / MANIFEST).upload(folder / MANIFEST)
    except LslamError as error:
        raise type(error)(f"{error}; the results are in {folder}, and --resume uploads them") from None
    log.info("uploaded %d files, %.1f MB, to %s", len(files), sum(p.stat().st_size for p in files) / 1e6, place)
    shutil.rmtree(folder, ignore_errors=True)


def _is_result(path: Path) -> bool:
    """Whether a file of a run folder is a result, to be uploaded."""
    return path.name != LOCK and path.suffix != ".part" and path.parts[0] != CHECKPOINT
