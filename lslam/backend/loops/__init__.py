"""Loop closure detection: candidates by gating and descriptors, verification by registration.

A place descriptor remembers places by keyframe and finds those that look alike. A new one is one file with `create` and one line
here; others register an entry point `lslam.descriptors`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, cast

from lslam.core.extras import factory, require

# A command line that names a descriptor wrongly is answered without numpy.
if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from lslam.core.arrays import Longs
    from lslam.core.config.backend import LoopsConfig

GROUP = "lslam.descriptors"
# name -> (module with `create(config) -> PlaceDescriptor`, one line for people)
DESCRIPTORS = {
    "scan-context": ("lslam.backend.loops.scan_context", "a polar image of heights (Kim and Kim 2018)"),
}


def require_descriptor(name: str) -> None:
    """Raise UsageError with the nearest name when there is no such descriptor."""
    require(GROUP, DESCRIPTORS, name, "place descriptor")


def create_descriptor(config: LoopsConfig) -> PlaceDescriptor:
    """The descriptor `loops.descriptor` names. Raises UsageError with the nearest name when there is none."""
    return cast("PlaceDescriptor", factory(GROUP, DESCRIPTORS, config.descriptor, "place descriptor")(config))


@dataclass(frozen=True)
class PlaceMatch:
    """A keyframe that looks alike.

    distance : 0 alike to 1, compared with `loops.max_descriptor_distance`
    yaw : rad; turning the query's cloud by it about z turns it as the match's
    """

    number: int
    distance: float
    yaw: float


class PlaceDescriptor(Protocol):
    """The places seen so far, by keyframe number; yaw_error : rad, largest error of a match's yaw."""

    yaw_error: float

    def add(self, number: int, points: NDArray[np.float32]) -> None:
        """Describe the cloud (N, 3), m, round keyframe `number`, level with z up; keyframes come once, in any order."""

    def nearest(self, number: int, others: Longs, turn: float = math.pi) -> list[PlaceMatch]:
        """Matches of keyframe `number` among the keyframes `others`, the most similar first; all must have been added.

        turn : rad, largest difference of their headings
        """
