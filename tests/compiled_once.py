"""What several workers need compiled is compiled by one of them: the others wait for it, and load it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lslam.core.kernels import jit  # noqa: F401  # which tells numba where its cache is
from lslam.core.machine import lock
from lslam.pipeline import precompile

# isort: split
from numba.core.caching import FunctionCache
from numba.core.compiler_lock import global_compiler_lock
from numba.core.dispatcher import Dispatcher


def compile_once() -> None:
    """Hold a lock of each kernel that is kept while it is compiled or loaded. What a kernel calls never calls it."""
    compile_here = Dispatcher.compile

    def compiled(kernel: Any, signature: Any) -> Any:
        if not isinstance(kernel._cache, FunctionCache):
            return compile_here(kernel, signature)
        # numba's own lock first: a thread that waits for it must not hold what the one that has it asks for.
        folder = Path(kernel._cache.cache_path)
        folder.mkdir(parents=True, exist_ok=True)
        with global_compiler_lock, (folder / f"{kernel.py_func.__qualname__}.lock").open("a") as stream:
            lock(stream, wait=True)
            return compile_here(kernel, signature)

    Dispatcher.compile = compiled
    # The process that would help a run to compile takes longer to start than most kernels, and does it beside the other workers.
    precompile.available_cores = lambda: 1  # type: ignore[attr-defined]
