"""Stamps a run can rely on: read, checked, and replaced by the nominal rate when they cannot be true."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError
from lslam.formats.stamps_files import read_stamps

DEFAULT_RATE_HZ = 10.0

Stamps = NDArray[np.int64]


def nominal_stamps(count: int, rate_hz: float, start_ns: int = 0) -> Stamps:
    """(count,) ns at `rate_hz` from `start_ns`."""
    return start_ns + np.round(np.arange(count) * (1e9 / rate_hz)).astype(np.int64)


def load_stamps(path: Path, problems: list[str]) -> Stamps | None:
    """Stamps of a text file; None, with the reason in `problems`, when it cannot be read."""
    try:
        stamps = read_stamps(path)
    except InputError as error:
        problems.append(f"stamps are not used: {error}")
        return None
    if not len(stamps):
        problems.append(f"stamps are not used: {path} is empty")
        return None
    return stamps


def check_stamps(
    stamps: Stamps, rate_hz: float | None, source: Path | str, problems: list[str]
) -> tuple[Stamps, float]:
    """The stamps if they increase, else nominal ones from the first, and the rate (stated, else from the median step).

    What is wrong is added to `problems` with the line it is on.
    """
    steps = np.diff(stamps)
    rate = rate_hz or measured_rate(stamps)
    wrong = np.flatnonzero(steps <= 0)
    if not len(wrong):
        return stamps, rate
    word = "repeats" if steps[wrong[0]] == 0 else "goes back"
    problems.append(
        f"{source}: time {word} at line {wrong[0] + 2} ({len(wrong)} place{'s' if len(wrong) > 1 else ''}); "
        f"the nominal rate of {rate:g} Hz is used instead"
    )
    return nominal_stamps(len(stamps), rate, int(stamps[0])), rate


def measured_rate(stamps: Stamps) -> float:
    """Scan rate in Hz from the median of the positive steps, 10 when there is none."""
    steps = np.diff(stamps)
    steps = steps[steps > 0]
    if not len(steps):
        return DEFAULT_RATE_HZ
    rate = 1e9 / float(np.median(steps))
    return float(round(rate, 3)) or rate
