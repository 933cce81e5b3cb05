"""LZF against an independent decoder in plain Python and hand-made streams."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lzf_compressor import compress

from lslam.io.kernels import decompress


def reference(data: bytes) -> bytes:
    out = bytearray()
    i = 0
    while i < len(data):
        control, i = data[i], i + 1
        if control < 32:
            out += data[i : i + control + 1]
            i += control + 1
            continue
        length = control >> 5
        if length == 7:
            length, i = length + data[i], i + 1
        distance, i = ((control & 31) << 8 | data[i]) + 1, i + 1
        for _ in range(length + 2):
            out.append(out[-distance])
    return bytes(out)


def packed(data: bytes) -> bytes:
    plain = np.frombuffer(data, np.uint8).copy()
    target = np.empty(len(data) + len(data) // 32 + 16, np.uint8)
    size = compress(plain, target, np.full(65536, -1, np.int64))
    return target[:size].tobytes()


def unpacked(data: bytes, size: int) -> bytes | None:
    out = np.empty(size, np.uint8)
    n = decompress(np.frombuffer(data, np.uint8).copy(), out)
    return None if n < 0 else out[:n].tobytes()


# Few different bytes make repeats, which plain random bytes never have.
@given(st.one_of(st.binary(max_size=3000), st.lists(st.sampled_from(b"abc"), max_size=3000).map(bytes)))
@settings(max_examples=100)
def test_round_trip_and_reference(data: bytes) -> None:
    small = packed(data)
    assert reference(small) == data
    assert unpacked(small, len(data)) == data


def test_long_runs_shrink() -> None:
    assert len(packed(bytes(100_000))) < 2_000
    assert unpacked(packed(bytes(100_000)), 100_000) == bytes(100_000)


def test_overlapping_reference_is_a_run() -> None:
    # One literal 'a', then 8 bytes from one byte back: (6 << 5), offset 0.
    assert unpacked(b"\x00a\xc0\x00", 9) == b"a" * 9


@pytest.mark.parametrize("broken", [b"\x05ab", b"\x20\x00", b"\x00a\xe0", b"\x00a\x20", b"\x00a\xc0\x00"])
def test_broken_streams_are_refused(broken: bytes) -> None:
    assert unpacked(broken, 8) is None
