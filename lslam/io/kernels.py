"""Compiled loops of this room: LZF, the compression inside `binary_compressed` PCD files (format of Marc Lehmann's liblzf)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.kernels.jit import kernel

Bytes = NDArray[np.uint8]


@kernel
def decompress(source: Bytes, target: Bytes) -> Any:
    """Decompress LZF bytes `source` into `target`; returns the bytes written, -1 if `source` is broken or `target` too small."""
    i: Any = np.int64(0)
    o: Any = np.int64(0)
    n, m = np.int64(source.shape[0]), np.int64(target.shape[0])
    while i < n:
        control = np.int64(source[i])
        i += 1
        if control < 32:
            length = control + 1
            if i + length > n or o + length > m:
                return -1
            for _ in range(length):
                target[o] = source[i]
                o += 1
                i += 1
            continue
        length = control >> 5
        if length == 7:
            if i >= n:
                return -1
            length += np.int64(source[i])
            i += 1
        if i >= n:
            return -1
        back = o - ((control & 31) << 8) - np.int64(source[i]) - 1
        i += 1
        length += 2
        if back < 0 or o + length > m:
            return -1
        # Byte by byte: the reference may overlap what is being written (run-length coding).
        for _ in range(length):
            target[o] = target[back]
            o += 1
            back += 1
    return o
