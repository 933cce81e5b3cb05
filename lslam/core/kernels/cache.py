"""Folders for files that can be made again. Machine code from them is executed: only the user may write there."""

from __future__ import annotations

import hashlib
import logging
import os
import stat
import tempfile
from pathlib import Path

log = logging.getLogger("lslam")


def cache_folder(name: str) -> Path | None:
    """The folder `name` of the user's XDG cache, or of the temporary directory when the home cannot be written.

    None, with a warning, when neither folder belongs to the user alone.
    """
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    shared = Path(tempfile.gettempdir()) / f"lslam-cache-{os.getuid() if hasattr(os, 'getuid') else 0}"
    for folder in (base / "lslam", shared):
        try:
            own_folder(folder)
            return own_folder(folder / name)
        except PermissionError as error:
            if error.filename is None:  # ours
                log.warning("%s", error)
        except OSError:
            continue
    return None


def own_folder(folder: Path) -> Path:
    """Make the folder with access for the user alone, or check that an existing one belongs to the user.

    In a directory that others can write to, as /tmp, it may neither be a link nor be group-writable. Elsewhere a link of the
    user's is followed, and group write permission, which a umask of 002 gives, is removed.

    Raises OSError; a PermissionError without a file name when the folder is not the user's own.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if hasattr(os, "getuid"):
        is_public = bool(folder.parent.stat().st_mode & stat.S_IWOTH)
        facts, target = os.lstat(folder), os.stat(folder)
        refused = f"{folder} is not used as a cache: "
        if os.getuid() != facts.st_uid or os.getuid() != target.st_uid:
            raise PermissionError(f"{refused}it belongs to another user")
        if is_public and stat.S_ISLNK(facts.st_mode):
            raise PermissionError(f"{refused}it is a link")
        if target.st_mode & (stat.S_IWOTH | (stat.S_IWGRP if is_public else 0)):
            raise PermissionError(f"{refused}other users can write in it")
        if target.st_mode & stat.S_IWGRP:
            folder.chmod(stat.S_IMODE(target.st_mode) & ~stat.S_IWGRP)
    with tempfile.TemporaryFile(dir=folder):
        return folder


def kernel_sources(package: Path) -> list[Path]:
    """Files with kernels below the package's folder: a room has a folder of them, or one file."""
    return sorted([*package.glob("*/kernels/*.py"), *package.glob("*/kernels.py")])


def source_digest() -> str:
    """Digest of all kernel sources: numba checks the file of a kernel only, not the files of the functions it calls."""
    digest = hashlib.sha256()
    for path in kernel_sources(Path(__file__).parents[2]):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def kernel_folder() -> Path | None:
    """Folder of the machine code; None, with a warning, when there is no safe one."""
    base, own = os.environ.get("NUMBA_CACHE_DIR"), source_digest()
    if base is None:
        folder = cache_folder("numba")
        return None if folder is None else folder / own
    # Each version has its own folder below one that the user sets. The processes of a study inherit the variable as it is set
    # here, and with it the compiled kernels.
    folder = Path(base) if Path(base).name == own else Path(base) / own
    try:
        return own_folder(folder)
    except OSError as error:
        log.warning("%s", error)
        return None


def is_cold() -> bool:
    """Whether the folder of machine code exists and is empty: kernels will have to be compiled."""
    folder = kernel_folder()
    return folder is not None and not any(folder.glob("*/*.nbi"))
