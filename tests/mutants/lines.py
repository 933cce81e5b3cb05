"""A pytest plugin: which lines of lslam each test file runs, and how long it takes, written to $MUTANTS_LINES as JSON."""

from __future__ import annotations

import inspect
import json
import os
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

ROOT = str(Path.cwd() / "lslam") + os.sep
_lines: dict[str, set[tuple[str, int]]] = defaultdict(set)
_seconds: dict[str, float] = defaultdict(float)
_current: set[tuple[str, int]] = set()


def _enter(frame: FrameType, event: str, argument: Any) -> Any:
    """What runs on import is no test's own: only functions are looked at."""
    is_function = frame.f_code.co_flags & inspect.CO_OPTIMIZED
    return _line if is_function and frame.f_code.co_filename.startswith(ROOT) else None


def _line(frame: FrameType, event: str, argument: Any) -> Any:
    if event == "line":
        _current.add((frame.f_code.co_filename, frame.f_lineno))
    return _line


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    global _current
    name, began = str(item.path.relative_to(Path.cwd())), time.perf_counter()
    _current = _lines[name]
    threading.settrace(_enter)
    sys.settrace(_enter)
    try:
        return (yield)  # type: ignore[return-value]
    finally:
        sys.settrace(None)
        _seconds[name] += time.perf_counter() - began


def pytest_sessionfinish() -> None:
    told: dict[str, Any] = {}
    for name, lines in _lines.items():
        files = defaultdict(list)
        for file, line in sorted(lines):
            files[str(Path(file).relative_to(Path.cwd()))].append(line)
        told[name] = {"seconds": _seconds[name], "lines": files}
    Path(os.environ["MUTANTS_LINES"]).write_text(json.dumps(told))
