"""One drive and what an odometry would make of it."""

from __future__ import annotations

import pytest
from evaluation_drives import disturb, drive

from lslam.core.types.trajectory import Trajectory


@pytest.fixture(scope="session")
def truth() -> Trajectory:
    """300 scans, about 300 m."""
    return drive()


@pytest.fixture(scope="session")
def estimate(truth: Trajectory) -> Trajectory:
    """`truth` as an odometry would see it."""
    return disturb(truth)
