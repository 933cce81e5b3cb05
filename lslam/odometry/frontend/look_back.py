"""The first scan of a run, registered on a map of those that follow."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from lslam.core.geometry import se3
from lslam.core.types.arrays import Floats
from lslam.core.types.motion_prior import MotionPrior
from lslam.odometry.base import Deskewing
from lslam.odometry.frontend.segments import Tracked


def first_pose(decided: list[Tracked], initial_scans: int, create: Callable[[], Deskewing]) -> Floats:
    """(4, 4) pose of the first scan on the map of the later ones, the initial ones left out.

    The second scan is registered on a map of the first alone. One scan shows surfaces along its rings only: their tilt is known
    badly, and its error stays between the first pose and all others. A map of many scans has none of it.

    create : makes the method with an empty map
    The pose stays where fewer than `initial_scans` later ones make a map, that does not hold the first in all directions, or an
    initial one was not registered, or taken at rest: their poses are one.
    """
    first, later = decided[0], [k for k in range(initial_scans, len(decided)) if _is_placed(decided[k])]
    if len(later) < initial_scans or not all(_is_placed(tracked) for tracked in decided[:initial_scans]):
        return first.result.T_world_lidar
    priors, empty, target = _priors(decided), create(), create()
    # Backwards, so that a map of the last scans alone has the nearest ones.
    for k in reversed(later):
        # On an empty map a scan is not registered: it enters where it lies.
        scan, prepared = decided[k].loaded.scan, decided[k].loaded.prepared
        assert scan is not None
        target.update(scan, priors[k], empty.register(scan, prepared, priors[k]))
    assert first.loaded.scan is not None
    result = target.register(first.loaded.scan, first.loaded.prepared, priors[0], is_near=True)
    return result.T_world_lidar if result.is_accepted and len(result.degenerate) == 0 else first.result.T_world_lidar


def _priors(decided: list[Tracked]) -> list[MotionPrior]:
    """The motion within each sweep about its pose, without what an IMU says of that: it has had its say.

    A scan that was taken before the speed was known moved as the first one that knows it.
    """
    sweeps = [tracked.sweep for tracked in decided]
    usual = next((sweep for sweep in sweeps if len(sweep.times) > 1), sweeps[0])
    out = []
    for tracked in decided:
        sweep = tracked.sweep if len(tracked.sweep.times) > 1 else usual
        change = tracked.result.T_world_lidar @ se3.inverse(sweep.pose)
        out.append(replace(sweep, poses=change @ sweep.poses, covariance=None, link=None))
    return out


def _is_placed(tracked: Tracked) -> bool:
    """Whether a scan was registered, of a sensor that moved, on the first map of the run."""
    result = tracked.result
    return (
        tracked.loaded.scan is not None and result.status == "ok" and result.segment == 0 and not result.is_stationary
    )
