"""Files that several modules read are made by the first worker to ask for them."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from lslam.core.machine import one_at_a_time


class MadeOnce:
    """Calls `make`, which writes to `folder`, unless a worker has done it; whoever asks meanwhile waits. All only read there."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __call__(self, name: str, make: Callable[[], object]) -> None:
        with one_at_a_time(self.folder / f"{name}.lock", f"makes {name}"):
            if not (done := self.folder / f"{name}.done").exists():
                make()
                done.touch()


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> MadeOnce:
    base = tmp_path_factory.getbasetemp()
    return MadeOnce((base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "made-once")
