"""What a place descriptor does: it remembers places by keyframe and finds those that look alike."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lslam.core.types.arrays import Longs


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
    """The places seen so far, by keyframe number.

    yaw_error : rad, by which the yaw of a match may be wrong
    """

    yaw_error: float

    def add(self, number: int, points: NDArray[np.float32]) -> None:
        """Describe the cloud (N, 3), m, round keyframe `number`, level with z up; keyframes come once, in any order."""

    def nearest(self, number: int, others: Longs, turn: float = np.pi) -> list[PlaceMatch]:
        """Those of the keyframes `others` that look most like keyframe `number`, the best first; all must be known.

        turn : rad, headings differ by no more
        """
