"""What every odometry method offers the front end."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

from lslam.core.types.arrays import Floats
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanEquations, ScanResult
from lslam.core.types.state import State
from lslam.registration.preprocessing.features import Features
from lslam.registration.result import RegistrationResult


class Traits:
    """What a method declares of itself; the usual values, which it inherits."""

    # How it deskews, in words; empty: not at all.
    deskew: str = ""
    # It gets scans whose `rings` are filled in (`input.rings`).
    needs_rings: bool = False
    # It predicts by itself: an IMU is of no use to it but where a scan fails.
    ignores_prior: bool = False
    # It can register a sweep again along a course that later scans told as well.
    follows_course: bool = False

    def warm_up(self) -> None:
        """Nothing to compile."""


class Method(Protocol):
    """What all methods have in common, the attributes of `Traits` among it.

    Scan + motion prior -> pose, scan after scan.

    `prepare` knows nothing of earlier scans, so the front end runs it for the next scan while `register` works on this one.
    """

    deskew: str
    needs_rings: bool
    ignores_prior: bool
    follows_course: bool

    def prepare(self, scan: Scan) -> Any:
        """Whatever can be made of one scan by itself."""
        ...

    def warm_up(self) -> None:
        """Compile or load what the first scan would otherwise wait for."""
        ...


class Registering(Method, Protocol):
    """A method that registers a scan and learns from it at once."""

    def register(self, scan: Scan, prepared: Any, prior: MotionPrior) -> ScanResult:
        """Pose of the scan at its stamp; a failed registration returns the prior with status `bridged`."""
        ...


@runtime_checkable
class FeatureSource(Method, Protocol):
    """A method that sees features, of which a map can be made."""

    def features_of(self, prepared: Any, motion: MotionPrior) -> Features:
        """What `prepare` made of a scan, as seen from the pose at the stamp when the sensor moved as `motion` says."""
        ...


@runtime_checkable
class Deskewing(Method, Protocol):
    """A method that takes the motion within a sweep from the prior, or begins there and estimates it.

    Its `register` only aligns, so that the front end can call it again with the motion that the first alignment found,
    unless the result has a motion of its own; `update` then takes the scan in.
    is_searching : whether it looks for scans farther off than a good prior can be
    """

    is_searching: bool

    def register(self, scan: Scan, prepared: Any, prior: MotionPrior, is_near: bool = False) -> RegistrationResult:
        """Pose of the scan at its stamp, the prior's where registration failed. Learns nothing.

        is_near : nothing is searched away from a prior that is nearly right
        """
        ...

    def update(self, scan: Scan, prior: MotionPrior, result: RegistrationResult) -> ScanResult:
        """Learn from a scan that was registered from `prior`, at the pose of its result; the record of the scan."""
        ...

    def restart(self) -> None:
        """Forget all scans."""
        ...


@runtime_checkable
class Windowed(Deskewing, Protocol):
    """A method whose scans stay open while a motion model estimates their poses together."""

    def equations(self, stamp_ns: int, result: RegistrationResult) -> tuple[ScanEquations, ...]:
        """What the points of a scan say of its pose where `register` found it; nothing where that failed."""
        ...

    def equations_at(self, poses: Mapping[int, Floats]) -> tuple[ScanEquations, ...]:
        """Likewise of scans at other poses (4, 4), by their stamps; nothing of those that are no longer open."""
        ...

    def settle(self, poses: Mapping[int, Floats]) -> None:
        """Learn the poses (4, 4) of the scans that are estimated together, by their stamps; all others are closed."""
        ...


Odometry = Registering | Deskewing


@runtime_checkable
class Resumable(Method, Protocol):
    """A method that can leave off after any scan and go on later as if nothing had been, to the last bit."""

    def state(self) -> State:
        """All that earlier scans left behind, in plain values and arrays that no one changes until they are written."""
        ...

    def restore(self, state: State) -> None:
        """Go on where `state` was taken, in an object made by the same configuration."""
        ...
