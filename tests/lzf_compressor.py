"""LZF compression, for PCD files that readers shall read."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.kernels.jit import kernel

Bytes = NDArray[np.uint8]


@kernel
def compress(source: Bytes, target: Bytes, table: Any) -> Any:
    """Compress `source` into `target` (at least n + n / 32 + 1 bytes); `table` is 65,536 int64 of -1. Returns the size."""
    n = np.int64(source.shape[0])
    i: Any = np.int64(0)
    o: Any = np.int64(0)
    literal: Any = np.int64(0)
    while i < n:
        match, length = np.int64(-1), np.int64(0)
        if i + 2 < n:
            a, b, c = np.int64(source[i]), np.int64(source[i + 1]), np.int64(source[i + 2])
            slot = ((a << 16 | b << 8 | c) * 2654435761 >> 12) & 65535
            seen = table[slot]
            table[slot] = i
            if seen >= 0 and i - seen <= 8192:
                while length < 264 and i + length < n and source[seen + length] == source[i + length]:
                    length += 1
                match = seen
        if length < 3:
            i += 1
            literal += 1
            if literal == 32 or i == n:
                o = _flush(source, target, i, o, literal)
                literal = 0
            continue
        if literal:
            o = _flush(source, target, i, o, literal)
            literal = 0
        offset, code = i - match - 1, length - 2
        if code < 7:
            target[o] = (code << 5) | (offset >> 8)
        else:
            target[o] = (7 << 5) | (offset >> 8)
            o += 1
            target[o] = code - 7
        target[o + 1] = offset & 255
        o += 2
        i += length
    return o


@kernel
def _flush(source: Bytes, target: Bytes, end: Any, o: Any, count: Any) -> Any:
    target[o] = count - 1
    for k in range(count):
        target[o + 1 + k] = source[end - count + k]
    return o + 1 + count
