"""Files that one process at a time locks; two open files of one process exclude each other as well."""

from __future__ import annotations

import logging
import threading
import time
from pathlib import Path

import pytest

from lslam.core.machine import lock, one_at_a_time


def test_a_held_lock_makes_others_wait_with_a_message(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "lslam")
    path = tmp_path / "new" / "some.lock"
    order = []
    inside = threading.Event()

    def other() -> None:
        inside.wait()
        with one_at_a_time(path, "works"):
            order.append("second")

    thread = threading.Thread(target=other)
    thread.start()
    with one_at_a_time(path, "works"):
        inside.set()
        time.sleep(0.2)
        order.append("first")
    thread.join(10)
    assert order == ["first", "second"]
    assert caplog.messages == ["waiting for another process that works"]


def test_what_cannot_be_locked_does_not_stop_the_work(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    done = []
    with one_at_a_time(tmp_path / "file" / "below" / "some.lock", "works"):
        done.append(1)
    assert done


def test_lock_returns_whether_it_was_acquired(tmp_path: Path) -> None:
    with (tmp_path / "a").open("a") as first, (tmp_path / "a").open("a") as second:
        assert lock(first)
        assert not lock(second)
        first.close()
        assert lock(second)
