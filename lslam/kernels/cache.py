"""Folders for what can be made again. Machine code in them is run, and its index unpickled: nobody else may write there."""

from __future__ import annotations

import logging
import os
import stat
import tempfile
from pathlib import Path

log = logging.getLogger("lslam")


def cache_folder(name: str) -> Path | None:
    """The folder `name` of the user's XDG cache, or of the temporary directory when the home cannot be written.

    None when no folder can be had that is the user's own; what is wrong with it is said.
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
    """Make the folder, for the user alone, or see that it is; raises OSError, a PermissionError without file when it is not.

    Where others can make files too, as in /tmp, it may be no link and no group's; elsewhere a link of the user's may lead
    there, and a group, which a umask of 002 lets in, is shut out from now on.
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
