"""A run folder in storage: it is filled in a folder of the cache and uploaded, its manifest last, when the run has ended."""

from __future__ import annotations

import hashlib
import logging
import shutil
from pathlib import Path

from lslam.core.errors import LslamError, OutputError, OutputExistsError
from lslam.core.kernels.cache import cache_folder
from lslam.io.remote import RemotePath
from lslam.pipeline.run_folder import CHECKPOINT, KEYFRAMES, LOCK, MANIFEST, OURS, REPLIES

log = logging.getLogger("lslam")
SPOOL = "spool"


def spool_of(place: RemotePath) -> Path:
    """Where the run folder of `place` is filled, the same for every attempt on this machine. Raises OutputError."""
    folder = cache_folder(SPOOL)
    if folder is None:
        raise OutputError(f"{place} needs a folder to be filled in: name a folder of your own in XDG_CACHE_HOME")
    return folder / f"{place.name}-{hashlib.sha256(str(place).encode()).hexdigest()[:12]}"


def check_place(place: RemotePath, may_replace: bool) -> None:
    """Raise OutputExistsError for a run that is not to be replaced, and for objects that no run has put there."""
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
    """The run in `folder` to `place`, where there is a manifest only as long as all of it is there; then drop `folder`.

    Raises StorageError saying where the results are meanwhile.
    """
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
    return path.name != LOCK and path.suffix != ".part" and path.parts[0] != CHECKPOINT
