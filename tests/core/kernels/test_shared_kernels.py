"""A process that needs a kernel waits for the one that compiles it."""

from __future__ import annotations

from pathlib import Path
from threading import Thread
from typing import Any

from lslam.core.kernels.jit import kernel
from lslam.core.machine import lock

results = []


@kernel
def twice(x: float) -> float:
    return 2.0 * x


@kernel
def once(x: float) -> float:
    return x


def test_a_kernel_that_another_process_compiles_is_waited_for() -> None:
    compiled: Any = twice
    folder = Path(compiled._cache.cache_path)
    folder.mkdir(parents=True, exist_ok=True)
    for kept in folder.glob("*.twice-*"):
        kept.unlink()
    once(1.0)  # the next one takes a fraction of a second
    waiting = Thread(target=lambda: results.append(twice(21.0)), daemon=True)
    with (folder / "twice.lock").open("a") as stream:
        assert lock(stream)
        waiting.start()
        waiting.join(1.0)
        assert results == []
    waiting.join()
    assert results == [42.0]
