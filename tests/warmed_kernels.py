"""Which kernels were called with which arrays: what a method compiles."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
import pytest

Call = tuple[str, tuple[Any, ...]]


def recorded(monkeypatch: pytest.MonkeyPatch, module: ModuleType, *names: str) -> set[Call]:
    """The calls to come of these kernels, each with type, dimensions and layout of its arrays."""
    calls: set[Call] = set()

    def watched(name: str, kernel: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arrays: Any) -> Any:
            calls.add((name, tuple((str(a.dtype), a.ndim, a.flags.c_contiguous) for a in map(np.asarray, arrays))))
            return kernel(*arrays)

        return call

    for name in names:
        monkeypatch.setattr(module, name, watched(name, getattr(module, name)))
    return calls
