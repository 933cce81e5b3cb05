"""All policy about compiling: flags, the shared cache folder, and one process compiling at a time.

Kernels are plain loops. `nogil` lets the next scan be prepared meanwhile; no `fastmath`, because sums must not depend
on the machine; no `parallel`, because results must not depend on the number of threads.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar, cast

F = TypeVar("F", bound=Callable[..., Any])
_log = logging.getLogger("lslam")


def cache_folder() -> Path:
    """The user's XDG cache, or a folder of the temporary directory when the home cannot be written."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    for folder in (
        base / "lslam",
        Path(tempfile.gettempdir()) / f"lslam-cache-{os.getuid() if hasattr(os, 'getuid') else 0}",
    ):
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                return folder
        except OSError:
            continue
    return Path(tempfile.mkdtemp(prefix="lslam-cache-"))


def source_digest() -> str:
    """Digest of all kernel sources: numba looks at a kernel's own file only, not at the files of what it calls."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


# Numba reads the variable when it is imported; a folder set by the user is kept, below it each version has its own. The
# processes of a study find the variable as this one leaves it, and the kernels compiled.
_base, _own = Path(os.environ.get("NUMBA_CACHE_DIR") or cache_folder() / "numba"), source_digest()
os.environ["NUMBA_CACHE_DIR"] = str(_base if _base.name == _own else _base / _own)

import numba  # noqa: E402


def kernel(function: F) -> F:
    """Compile `function` on first use and keep the machine code in the cache."""
    compiled: Any = numba.njit(cache=True, nogil=True, error_model="numpy", boundscheck=False)(function)
    _forgive(compiled._cache)
    return cast(F, compiled)


def _forgive(cache: Any) -> None:
    """Let a damaged or full cache cost time, not the run: numba passes on whatever unpickling or writing raises."""
    load, save = cache.load_overload, cache.save_overload

    def load_or_compile(*args: Any) -> Any:
        try:
            return load(*args)
        except Exception as error:
            _log.warning("the kernel cache is damaged (%s): compiling again", type(error).__name__)
            with contextlib.suppress(OSError):
                cache.flush()
            return None

    def save_if_possible(*args: Any) -> None:
        try:
            save(*args)
        except Exception as error:
            _log.debug("a kernel is not kept in the cache: %s", error)

    cache.load_overload, cache.save_overload = load_or_compile, save_if_possible


def inline(function: F) -> F:
    """A small helper of kernels, compiled into its callers and not cached by itself."""
    compiled = numba.njit(nogil=True, error_model="numpy", forceinline=True)(function)
    return cast(F, compiled)


def lock_file() -> Path:
    """Who compiles holds it (`lslam.locks`): others wait instead of compiling the same kernels into the same files."""
    return Path(os.environ["NUMBA_CACHE_DIR"]) / "compile.lock"


@contextlib.contextmanager
def announced(log: logging.Logger, after_s: float = 2.0) -> Iterator[None]:
    """Say that kernels are being compiled when the block takes longer than loading them would."""
    timer = threading.Timer(
        after_s, log.info, ["compiling kernels, once; they are kept in %s", os.environ["NUMBA_CACHE_DIR"]]
    )
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
