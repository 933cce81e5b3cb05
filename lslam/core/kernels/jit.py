"""All policy about compiling: flags, the shared cache folder, and one process compiling at a time.

Kernels are plain loops. `nogil` lets the next scan be prepared meanwhile; no `fastmath`, because sums must not depend
on the machine; no `parallel`, because results must not depend on the number of threads.
"""

from __future__ import annotations

import contextlib
import gc
import hashlib
import logging
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar, cast

from lslam.core.kernels.cache import cache_folder, own_folder

F = TypeVar("F", bound=Callable[..., Any])
_log = logging.getLogger("lslam")


def source_digest() -> str:
    """Digest of all kernel sources: numba checks the file of a kernel only, not the files of the functions it calls."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parents[2].glob("*/kernels/*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def kernel_folder() -> Path | None:
    """Folder of the machine code; None, and a warning, when there is no safe one."""
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
        _log.warning("%s", error)
        return None


_folder = kernel_folder()
if _folder is None:
    _log.warning("kernels are compiled anew each time: name a folder of your own in XDG_CACHE_HOME to keep them")
    os.environ.pop("NUMBA_CACHE_DIR", None)
else:
    os.environ["NUMBA_CACHE_DIR"] = str(_folder)  # numba reads it when it is imported

import numba  # noqa: E402
from numba.core import event  # noqa: E402


def kernel(function: F) -> F:
    """Compile `function` on first use and keep the machine code in the cache."""
    is_kept = _folder is not None
    compiled: Any = numba.njit(cache=is_kept, nogil=True, error_model="numpy", boundscheck=False)(function)
    if is_kept:
        _forgive(compiled._cache)
    return cast(F, compiled)


def _forgive(cache: Any) -> None:
    """Compile again when the cache is damaged or full: numba passes on every error of unpickling and writing."""
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
    """Compile a small function into the kernels that call it. It is not cached by itself and may not allocate arrays.

    Without numba's runtime the references to its array arguments are not counted at each call. Counting takes two atomic
    operations per array, ten times the cost of a lookup in a hash table.
    """
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "forceinline": True, "_nrt": False}
    compiled = numba.njit(**options)(function)
    return cast(F, compiled)


def inline_with_arrays(function: F) -> F:
    """As `inline`, for functions that allocate arrays. References are counted at each call: for one call per step at most."""
    compiled = numba.njit(nogil=True, error_model="numpy", forceinline=True)(function)
    return cast(F, compiled)


def lock_file() -> Path | None:
    """Lock (`lslam.core.machine`) of the process that compiles; others wait and then load the kernels. None without a cache."""
    return None if _folder is None else _folder / "compile.lock"


@contextlib.contextmanager
def announced(log: logging.Logger, on_first: Callable[[], None] = lambda: None) -> Iterator[None]:
    """Log a line when the first kernel is compiled within the block, and call `on_first`; loading kernels does neither."""
    with event.install_listener("numba:compile", _Announcement(log, on_first)), _rarely_collecting():
        yield


class _Announcement(event.Listener):
    """Listener to numba's compilations, which logs the first one."""

    def __init__(self, log: logging.Logger, on_first: Callable[[], None]) -> None:
        self._log: logging.Logger | None = log
        self._on_first = on_first

    def on_start(self, event: Any) -> None:
        log, self._log = self._log, None
        if log is not None:
            kept = "for this run only" if _folder is None else f"once; they are kept in {_folder}"
            log.info("compiling kernels, %s", kept)
            self._on_first()

    def on_end(self, event: Any) -> None:
        pass


@contextlib.contextmanager
def _rarely_collecting() -> Iterator[None]:
    """Collect garbage rarely: compiling makes millions of objects that stay, and scanning them is a tenth of its time."""
    before = gc.get_threshold()
    gc.set_threshold(100_000, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)
