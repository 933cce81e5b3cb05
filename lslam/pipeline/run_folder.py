"""The folder of one run: created whole or not at all, every file written beside its name and renamed, status last."""

from __future__ import annotations

import json
import logging
import shutil
import time
from collections.abc import Iterable
from pathlib import Path
from typing import IO, Any

from lslam.errors import OutputError, OutputExistsError
from lslam.formats.atomic import atomic_write

log = logging.getLogger("lslam")

MANIFEST = "manifest.json"
LOCK = ".lock"


class RunFolder:
    """A run's output folder, held by this process while it is open.

    Raises OutputExistsError when the folder is there and `overwrite` is False, when it is there and is no run folder, or
    when another run holds it; OutputError when it cannot be written.
    """

    def __init__(self, path: Path, overwrite: bool = False) -> None:
        self.path = path
        self._lock: IO[str] | None = None
        self._log_handler: logging.Handler | None = None
        exists = path.exists()
        if exists and not path.is_dir():
            raise OutputExistsError(f"output {path} is a file; name a folder with --out")
        if exists and any(path.iterdir()) and not overwrite:
            raise OutputExistsError(
                f"output folder {path} exists; name another with --out or replace it with --overwrite"
            )
        if exists and any(path.iterdir()) and not (path / MANIFEST).exists() and not (path / LOCK).exists():
            raise OutputExistsError(f"output folder {path} is not a run of lslam; --overwrite replaces runs only")
        try:
            path.mkdir(parents=True, exist_ok=True)
            self._hold()
            if exists:
                self._clear()
        except OSError as error:
            raise OutputError(f"output folder {path} cannot be written: {error.strerror or error}") from None

    def write_text(self, name: str, text: str) -> Path:
        """Write one text file atomically."""
        return self.write_bytes(name, text.encode())

    def write_bytes(self, name: str, data: bytes) -> Path:
        """Write one file atomically."""
        target = self.path / name
        with atomic_write(target) as stream:
            stream.write(data)
        return target

    def write_manifest(self, manifest: dict[str, Any]) -> None:
        """Write manifest.json."""
        self.write_text(MANIFEST, json.dumps(manifest, indent=2, ensure_ascii=False, default=str) + "\n")

    def require_space(self, size: int, what: str) -> None:
        """Raise OutputError when the disk has not `size` bytes left for `what`."""
        left = shutil.disk_usage(self.path).free
        if left < size:
            raise OutputError(
                f"the disk of {self.path} has {left / 1e6:.0f} MB left, {what} needs about {size / 1e6:.0f} MB; "
                "free some space or name another folder with --out"
            )

    def __enter__(self) -> RunFolder:
        """Copy lslam's log into log.txt while the folder is held."""
        handler = logging.FileHandler(self.path / "log.txt", encoding="utf-8")
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
        logging.getLogger("lslam").addHandler(handler)
        self._log_handler = handler
        return self

    def __exit__(self, *_: object) -> None:
        """Let go of the folder."""
        if self._log_handler is not None:
            logging.getLogger("lslam").removeHandler(self._log_handler)
            self._log_handler.close()
        if self._lock is not None:
            (self.path / LOCK).unlink(missing_ok=True)
            self._lock.close()

    def _hold(self) -> None:
        stream = (self.path / LOCK).open("a")
        try:
            import fcntl

            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except ImportError:
            pass
        except OSError:
            stream.close()
            raise OutputExistsError(
                f"output folder {self.path} is in use by another run; name another with --out"
            ) from None
        self._lock = stream

    def _clear(self) -> None:
        """Remove an earlier run's files, nothing else."""
        for name in _known_files(self.path):
            (self.path / name).unlink(missing_ok=True)


def _known_files(path: Path) -> Iterable[str]:
    known = (
        MANIFEST, "config.toml", "log.txt", "trajectory.tum", "trajectory_kitti.txt", "covariances.npz", "map.ply",
        "map.pcd", "map.json", "evaluation.json", "timing.csv", "scans.csv", "report.html",
    )  # fmt: skip
    return [*known, *(p.name for p in path.glob("*.part"))]


def default_folder(sequence: str, method: str, now: float | None = None) -> Path:
    """runs/<sequence>-<method>-<time>."""
    stamp = time.strftime("%Y%m%d-%H%M%S", time.localtime(now))
    return Path("runs") / f"{sequence}-{method}-{stamp}"
