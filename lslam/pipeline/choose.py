"""The scans a run works on."""

from __future__ import annotations

from lslam.config import Config
from lslam.odometry.base import Odometry
from lslam.readers import select
from lslam.readers.ringed import with_rings
from lslam.types.sequence import Sequence


def choose_scans(sequence: Sequence, odometry: Odometry, config: Config) -> Sequence:
    """What --start, --count and --skip-frames leave, with rings where the method needs them.

    Raises UsageError when nothing is left, InputError naming --rings when there are no rings to be found.
    """
    if getattr(odometry, "needs_rings", False):
        sequence = with_rings(sequence, config.input.rings)
    return select(sequence, config.input.start, config.input.count, config.input.skip_frames)
