"""A part of a run whose scans were registered on one local map."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Segment:
    """Consecutive scans of one local map.

    first, last : numbers of its scans in the recording; scans, registered : how many there are
    frame : of the coordinates of its poses, 0 for those of the trajectory
    tied_by : what ties it to the segments before it in its frame, in words; empty for the first of a frame
    reason : why nothing does, empty where something does or nothing is needed
    """

    number: int
    first: int
    last: int
    scans: int
    registered: int
    frame: int = 0
    tied_by: str = ""
    reason: str = ""

    @property
    def span(self) -> str:
        """Its scans in words."""
        return f"scan {self.first}" if self.first == self.last else f"scans {self.first} to {self.last}"
