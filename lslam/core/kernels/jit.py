"""All policy about compiling: flags, the shared cache folder, and one process at a time compiling a kernel.

Kernels are plain loops. `nogil` lets the next scan be prepared meanwhile; no `fastmath`, because sums must not depend
on the machine; no `parallel`, because results must not depend on the number of threads.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar, cast

from lslam.core.kernels.cache import kernel_folder

F = TypeVar("F", bound=Callable[..., Any])
_log = logging.getLogger("lslam")


_folder = kernel_folder()
if _folder is None:
    _log.warning("kernels are compiled anew each time: name a folder of your own in XDG_CACHE_HOME to keep them")
    os.environ.pop("NUMBA_CACHE_DIR", None)
else:
    os.environ["NUMBA_CACHE_DIR"] = str(_folder)  # numba reads it when it is imported
# It tries and drops a lot, and would colour each error.
os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")

import numba  # noqa: E402
from numba.core import event  # noqa: E402
from numba.core.registry import CPUDispatcher  # noqa: E402
from numba.core.runtime.nrt import rtsys  # noqa: E402


class _OnFirst(event.Listener):
    """Listener that calls a function when numba compiles for the first time; loading kernels does not count."""

    def __init__(self, call: Callable[[], None]) -> None:
        self._call, self.has_called = call, False

    def on_start(self, event: Any) -> None:
        """Call the function at the first event."""
        if not self.has_called:
            self.has_called = True
            self._call()

    def on_end(self, event: Any) -> None:
        """Does nothing; numba's listeners have to have it."""


def _hasten() -> None:
    """Shorten numba's compilation, when something is to be compiled."""
    from lslam.core.kernels.haste import hasten  # with parts of numba that loading kernels does without

    hasten()


# Without an entry for C, which nobody calls.
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
_compiled = _OnFirst(_hasten)
_register: Callable[..., None] = event.register
_register("numba:compile", _compiled)
# Called with the name of a kernel, and whether it is compiled or loaded; else it is about to be compiled, here or elsewhere.
_when_ready: list[Callable[[str, bool], None]] = []


def did_compile() -> bool:
    """Whether this process has compiled a kernel, and not only loaded some."""
    return _compiled.has_called


def kernel(function: F) -> F:
    """Compile `function` on first use and keep the machine code in the cache."""
    is_kept = _folder is not None
    options: dict[str, Any] = {"cache": is_kept, "boundscheck": False} | _OPTIONS
    compiled: Any = numba.njit(**options)(function)
    if is_kept:
        _share(compiled)
    return cast(F, compiled)


def _share(dispatcher: Any) -> None:
    """Let one process compile a kernel while others that need it wait, and then load it.

    With a damaged or full cache the kernel is compiled again, since numba ignores errors of reading and writing.
    """
    cache, held = dispatcher._cache, contextlib.ExitStack()
    save, name = cache.save_overload, dispatcher.py_func.__qualname__

    def look_up(signature: Any, context: Any) -> Any:
        try:
            # numba's own would import the compiler's libraries first, a fifth of the time that one scan takes from the shell.
            rtsys.initialize(context)
            with cache._guard_against_spurious_io_errors():
                return cache._load_overload(signature, context)
        except Exception as error:
            _log.warning("the kernel cache is damaged (%s): compiling again", type(error).__name__)
            with contextlib.suppress(OSError):
                cache.flush()
            return None

    def load_or_wait(*args: Any) -> Any:
        kept = look_up(*args)
        if kept is None:
            _tell(name, False)
            held.close()  # numba's own lock is held here: of this process, no other thread compiles
            with contextlib.suppress(OSError, ImportError):  # where there are no locks, several compile
                _wait_for(held, Path(cache.cache_path), name)
            kept = look_up(*args)
        if kept is not None:
            held.close()
            _tell(name, True)
        return kept

    def save_if_possible(*args: Any) -> None:
        try:
            save(*args)
        except Exception as error:
            _log.debug("a kernel is not kept in the cache: %s", error)
        held.close()
        _tell(name, True)

    cache.load_overload, cache.save_overload = load_or_wait, save_if_possible


def _wait_for(locks: contextlib.ExitStack, folder: Path, name: str) -> None:
    """Take the lock file of kernel `name`, waiting for the process that compiles it; `locks` releases it."""
    import fcntl

    folder.mkdir(parents=True, exist_ok=True)
    fcntl.flock(locks.enter_context((folder / f"{name}.lock").open("a")), fcntl.LOCK_EX)


def _tell(name: str, is_ready: bool) -> None:
    """Report that a kernel is being compiled, or is ready."""
    for call in _when_ready:
        call(name, is_ready)


def inline(function: F) -> F:
    """Compile a small function into the kernels that call it. It is not cached by itself and may not allocate arrays.

    Without numba's runtime the references to its array arguments are not counted at each call. Counting takes two atomic
    operations per array, ten times the cost of a lookup in a hash table.
    """
    return _compile_inline(function, _nrt=False)


def inline_with_arrays(function: F) -> F:
    """As `inline`, for functions that allocate arrays. References are counted at each call: for one call per step at most."""
    return _compile_inline(function)


class _InlineDispatcher(CPUDispatcher):
    """Compiled function that can be called from kernels only; a call from Python runs its source."""

    def __call__(self, *args: Any) -> Any:
        return self.py_func(*args)


def _compile_inline(function: F, **more: bool) -> F:
    """Compile a function for use inside kernels, without an entry point for Python; more : numba's options."""
    options: dict[str, Any] = _OPTIONS | {"forceinline": True, "no_cpython_wrapper": True} | more
    compiled: Any = numba.njit(**options)(function)
    compiled.__class__ = _InlineDispatcher
    return cast(F, compiled)


@contextlib.contextmanager
def announce_compiling(log: logging.Logger, on_first: Callable[[], None] = lambda: None) -> Iterator[None]:
    """Log a line when the first kernel is compiled inside the block, and call `on_first`; loading kernels does neither."""

    def announce() -> None:
        log.info(
            "compiling kernels, %s",
            "for this run only" if _folder is None else f"once; they are kept in {_folder}",
            extra={"event": {"event": "compile"}},
        )
        on_first()

    with event.install_listener("numba:compile", _OnFirst(announce)):
        yield


@contextlib.contextmanager
def count_kernels(log: logging.Logger, total: int | None, every_s: float = 2.0) -> Iterator[None]:
    """Log, at most every `every_s` s inside the block, which kernel is being compiled, and how many of `total` are ready.

    Loading from the cache is not logged.
    """
    done, last = 0, -math.inf

    def ready(name: str, is_ready: bool) -> None:
        nonlocal done, last
        done += is_ready
        if not is_ready and time.monotonic() - last >= every_s:
            last = time.monotonic()
            of = None if total is None else max(done + 1, total)
            facts = {"event": "compile", "kernel": name, "done": done, "of": of}
            text = f"{name} ({done + 1}{'' if of is None else f' of {of}'})"
            log.info("compiling kernels, once: %s", text, extra={"event": facts})

    _when_ready.append(ready)
    try:
        yield
    finally:
        _when_ready.remove(ready)
