"""GPS time of LAS files, from Unix time (LAS 1.4 R15, "GPS Time" and bit 0 of the global encoding)."""

from __future__ import annotations

import numpy as np

from lslam.core.types.arrays import Floats, Longs

_GPS_EPOCH_S = 315_964_800  # Unix time of 1980-01-06
_LAS_OFFSET_S = 1_000_000_000
# s that GPS is ahead of UTC, from the Unix time on at which it grew (IERS, Bulletin C); before 1999 nothing counts as Unix time.
_LEAPS = np.array(
    [
        (915_148_800, 13),
        (1_136_073_600, 14),
        (1_230_768_000, 15),
        (1_341_100_800, 16),
        (1_435_708_800, 17),
        (1_483_228_800, 18),
    ]
)


def gps_time_s(stamps_ns: Longs, is_unix: bool) -> Floats:
    """(N,) adjusted standard GPS time, s since 1980-01-06 less 1e9, of Unix times (N,), ns; of another clock its own seconds.

    >>> gps_time_s(np.array([1_700_000_000_500_000_000]), True).tolist()
    [384035218.5]
    """
    if not is_unix:
        return np.asarray(1e-9 * stamps_ns)
    seconds, rest_ns = np.divmod(stamps_ns, 10**9)
    leaps = _LEAPS[np.maximum(np.searchsorted(_LEAPS[:, 0], seconds, side="right") - 1, 0), 1]
    return np.asarray((seconds - _GPS_EPOCH_S + leaps - _LAS_OFFSET_S) + 1e-9 * rest_ns)


def unix_time_ns(gps_s: Floats) -> Longs:
    """(N,) Unix times, ns, of adjusted standard GPS times (N,), s: the inverse of `gps_time_s`, to the last bits of a double.

    >>> unix_time_ns(np.array([384035218.5])).tolist()
    [1700000000500000000]
    """
    seconds, rest = np.divmod(gps_s, 1.0)
    ahead = seconds.astype(np.int64) + _GPS_EPOCH_S + _LAS_OFFSET_S
    leaps = _LEAPS[np.maximum(np.searchsorted(_LEAPS.sum(axis=1), ahead, side="right") - 1, 0), 1]
    return np.asarray((ahead - leaps) * 10**9 + np.rint(1e9 * rest).astype(np.int64))
