"""Arrays in zip files: packed as much as asked for, the same bytes each time."""

from __future__ import annotations

import gc
import io
import sys
import time
import zipfile
from threading import Thread

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.io.formats.state_files import pack_npz, read_npz


def packed(values: NDArray[np.float32], level: int) -> bytes:
    stream = io.BytesIO()
    pack_npz(stream, {"a": values}, level)
    return stream.getvalue()


@pytest.mark.parametrize("level", [0, 1, 6, 9])
def test_arrays_come_back_and_the_same_bytes_are_written_again(level: int) -> None:
    values = np.sin(np.arange(20_000, dtype=np.float32).round(-1))
    data = packed(values, level)
    assert data == packed(values, level)
    np.testing.assert_array_equal(read_npz(io.BytesIO(data))["a"], values)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        assert [info.date_time for info in archive.infolist()] == [(1980, 1, 1, 0, 0, 0)]


def test_a_higher_level_makes_smaller_files() -> None:
    values = np.repeat(np.random.default_rng(0).integers(0, 99, 20_000), 3).astype(np.float32)
    sizes = [len(packed(values, level)) for level in (0, 1, 9)]
    assert sizes[0] > values.nbytes > sizes[1] > sizes[2]


def test_threads_read_side_by_side_whatever_is_collected_meanwhile() -> None:
    """A collection that lets another thread in: CPython 3.11 mixes up what both parse, a SystemError."""
    stream = io.BytesIO()
    pack_npz(stream, {f"a{k}": np.full(3, k) for k in range(20)}, 0)
    before, often, failures = gc.get_threshold(), sys.getswitchinterval(), list[BaseException]()

    def let_others_in(phase: str, info: dict[str, int]) -> None:
        time.sleep(1e-5)

    def read() -> None:
        try:
            for _ in range(5):
                assert read_npz(io.BytesIO(stream.getvalue()))["a7"][0] == 7
        except BaseException as error:
            failures.append(error)

    gc.callbacks.append(let_others_in)
    gc.set_threshold(1)
    sys.setswitchinterval(1e-6)
    try:
        threads = [Thread(target=read) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        gc.set_threshold(*before)
        sys.setswitchinterval(often)
        gc.callbacks.remove(let_others_in)
    assert failures == []
