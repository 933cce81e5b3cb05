"""Stamps as UTC, where they count from 1970; those of a clock that started with the recording tell no date."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

# Unix time has had 10 digits before the point since 2001-09-09; no sensor has been switched on for so many seconds.
_FIRST_NS = 10**18
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def utc_of(stamps_ns: NDArray[np.int64]) -> list[datetime] | None:
    """The instants of stamps (N,) ns, to the microsecond, or None when they are no Unix time."""
    if not len(stamps_ns) or int(np.min(stamps_ns)) < _FIRST_NS:
        return None
    return [_EPOCH + timedelta(microseconds=int(stamp) // 1000) for stamp in stamps_ns]
