"""What every odometry method offers the front end."""

from __future__ import annotations

from typing import Any, Protocol

from lslam.types.motion_prior import MotionPrior
from lslam.types.scan import Scan
from lslam.types.scan_result import ScanResult


class Odometry(Protocol):
    """Scan + motion prior -> pose, scan after scan.

    `prepare` knows nothing of earlier scans, so the front end runs it for the next scan while `register` works on this one.
    """

    def prepare(self, scan: Scan) -> Any:
        """Whatever can be made of one scan by itself."""
        ...

    def register(self, scan: Scan, prepared: Any, prior: MotionPrior) -> ScanResult:
        """Pose of the scan at its start; a failed registration returns the prior with status `bridged`."""
        ...

    def warm_up(self) -> None:
        """Compile or load what the first scan would otherwise wait for."""
        ...
