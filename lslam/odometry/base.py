"""What every odometry method offers the front end, and how one does that registers on a map of earlier scans."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar, Protocol, runtime_checkable

from lslam.core.arrays import Floats
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanEquations, ScanResult, StageClock
from lslam.core.types.state import State, Stateful
from lslam.odometry.scan_outcome import judge, to_scan_result
from lslam.odometry.uncertainty import PoseUncertainty
from lslam.registration.preprocessing.features import Features
from lslam.registration.registration import Registration
from lslam.registration.result import RegistrationResult


class Traits(Protocol):
    """What all methods have in common: scan + motion prior -> pose, scan after scan.

    Properties that a method does not set have the default values here. `prepare` knows nothing of earlier scans, so the front end
    runs it for the next scan while `register` works on this one.
    """

    # How it deskews, in words; empty: not at all.
    deskew: str = ""
    # It gets scans whose `rings` are filled in (`input.rings`).
    needs_rings: bool = False
    # It predicts by itself: an IMU is of no use to it but where a scan fails.
    ignores_prior: bool = False
    # It can register a sweep again along a course that later scans told as well.
    follows_course: bool = False

    def prepare(self, scan: Scan) -> Any:
        """Computation on one scan that needs no earlier scan; the result goes to `register`. Here nothing is computed: None."""
        return None

    def warm_up(self) -> None:
        """Compile kernels and load packages, so that the first scan need not wait for them. Here nothing."""
        return


class Registering(Traits, Protocol):
    """A method that registers a scan and learns from it at once."""

    def register(self, scan: Scan, prepared: Any, prior: MotionPrior) -> ScanResult:
        """Pose of the scan at its stamp; a failed registration returns the prior with status `bridged`."""
        ...


@runtime_checkable
class FeatureSource(Traits, Protocol):
    """A method that sees features, of which a map can be made."""

    def features_of(self, prepared: Any, motion: MotionPrior) -> Features:
        """The features of a prepared scan, deskewed to the pose at the stamp by `motion`."""
        ...


@runtime_checkable
class Deskewing(Traits, Protocol):
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
class WindowMethod(Deskewing, Protocol):
    """A method whose scans stay open while a motion model estimates their poses together."""

    def equations(self, stamp_ns: int, result: RegistrationResult) -> tuple[ScanEquations, ...]:
        """Normal equations of a scan's points about the pose of its registration; empty where that failed."""
        ...

    def equations_at(self, poses: Mapping[int, Floats]) -> tuple[ScanEquations, ...]:
        """Normal equations of scans at other poses (4, 4), by their stamps; scans that are no longer open have none."""
        ...

    def finalise(self, poses: Mapping[int, Floats]) -> None:
        """Learn the poses (4, 4) of the scans that are estimated together, by their stamps; all others are closed."""
        ...


Odometry = Registering | Deskewing


@runtime_checkable
class Resumable(Traits, Protocol):
    """A method that can leave off after any scan and go on later as if nothing had been, to the last bit."""

    def state(self) -> State:
        """All that earlier scans left behind, in plain values and arrays that no one changes until they are written."""
        ...

    def restore(self, state: State) -> None:
        """Set all that `state` gave, in an object made by the same configuration."""
        ...


class AligningMethod(Traits):
    """A method that aligns a scan by itself, or by a package, and is judged by limits of the section `registration`."""

    limits: RegistrationConfig

    @abstractmethod
    def align(self, prepared: Any, T_prior: Floats) -> RegistrationResult:
        """Align what `prepare` made of a scan, from the prior (4, 4); the prior itself where there is nothing to align with."""

    @abstractmethod
    def enter(self, prepared: Any, result: ScanResult) -> None:
        """Learn from a scan with its `prepared` points, whether its alignment was accepted or not."""

    def register(self, scan: Scan, prepared: Any, prior: MotionPrior) -> ScanResult:
        """Align the scan, judge and enter it; `bridged` by the prior where it is rejected."""
        clock = StageClock()
        with clock.stage("register"):
            alignment = self.align(prepared, prior.pose)
        with clock.stage("update"):
            result = replace(judge(scan, alignment, prior.pose, self.limits), stages=clock.seconds)
            self.enter(prepared, result)
        return result


class MapMethod(Traits, Stateful):
    """Adapter from scans and motion priors to `Registration`; is_scan_to_scan : the map is the last scan alone."""

    is_searching = True
    STATE: ClassVar[tuple[str, ...]] = ("registration", "_uncertainty")

    def __init__(self, registration: Registration, *, is_scan_to_scan: bool) -> None:
        self.registration, self._is_scan_to_scan = registration, is_scan_to_scan
        self._uncertainty = self._fresh_uncertainty()

    @property
    def map_age(self) -> float:
        """Mean age, in scans, of the points of the map."""
        return self._uncertainty.map_age

    def update(self, scan: Scan, prior: MotionPrior, result: RegistrationResult) -> ScanResult:
        """Enter the scan into the map at the pose of its result. Returns its record with covariances."""
        began = time.perf_counter()
        result = self.insert(scan.stamp_ns, prior, result)
        record = to_scan_result(scan, result, *self._uncertainty.covariances(result, scan.stamp_ns, prior))
        return replace(record, stages={**result.stages, "update": time.perf_counter() - began})

    def insert(self, stamp_ns: int, prior: MotionPrior, result: RegistrationResult) -> RegistrationResult:
        """Enter a scan that was registered from `prior` into the map; the result says whether the sensor is at rest."""
        return self.registration.update(result)

    def information_of(self, prior: MotionPrior) -> Floats | None:
        """(6, 6) information of the prior for the normal equations; None, since it is the initial guess only."""
        return None

    def restart(self) -> None:
        """Begin again with an empty map."""
        self.registration = self.registration.fresh()
        self._uncertainty = self._fresh_uncertainty()

    def _fresh_uncertainty(self) -> PoseUncertainty:
        """The accumulated covariance of a run that begins."""
        return PoseUncertainty(is_scan_to_scan=self._is_scan_to_scan)
