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

from lslam.kernels.cache import cache_folder, own_folder

F = TypeVar("F", bound=Callable[..., Any])
_log = logging.getLogger("lslam")


def source_digest() -> str:
    """Digest of all kernel sources: numba looks at a kernel's own file only, not at the files of what it calls."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def kernel_folder() -> Path | None:
    """Where machine code is kept; None when there is no folder that is safe, and why is said."""
    base, own = os.environ.get("NUMBA_CACHE_DIR"), source_digest()
    if base is None:
        folder = cache_folder("numba")
        return None if folder is None else folder / own
    # A folder set by the user is kept, below it each version has its own. The processes of a study find the variable as this
    # one leaves it, and the kernels compiled.
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
    """A small helper of kernels, compiled into its callers and not cached by itself. It makes no arrays.

    Without numba's runtime, the arrays that it takes are not counted at each call: two atomic operations for every one of
    them, which cost ten times a lookup in a hash table.
    """
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "forceinline": True, "_nrt": False}
    compiled = numba.njit(**options)(function)
    return cast(F, compiled)


def inline_with_arrays(function: F) -> F:
    """As `inline`, for one that makes arrays of its own. Its calls count references: for what is called once per step."""
    compiled = numba.njit(nogil=True, error_model="numpy", forceinline=True)(function)
    return cast(F, compiled)


def lock_file() -> Path | None:
    """Who compiles holds it (`lslam.locks`): others wait instead of compiling the same kernels into the same files."""
    return None if _folder is None else _folder / "compile.lock"


@contextlib.contextmanager
def announced(log: logging.Logger, on_first: Callable[[], None] = lambda: None) -> Iterator[None]:
    """Say that kernels are being compiled in the block when the first one is: not when they are loaded, however slowly.

    on_first : called then, too
    """
    with event.install_listener("numba:compile", _Announcement(log, on_first)), _rarely_collecting():
        yield


class _Announcement(event.Listener):
    """Hears of every function that numba begins to compile."""

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
    """Compiling makes millions of objects that stay: looking at them again and again is a tenth of its time."""
    before = gc.get_threshold()
    gc.set_threshold(100_000, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)
