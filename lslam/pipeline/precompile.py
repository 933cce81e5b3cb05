"""Kernels of a run, compiled or loaded before its first scan, by a table of kernels per part of a run.

At a cold start a second process compiles the kernels that the first needs last, on an idle core. A process is needed since
the compiler has one lock for all threads. Both share one cache.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol

from lslam.backend.loops import find_loops
from lslam.core.config import Config
from lslam.core.kernels import jit
from lslam.core.machine import available_cores
from lslam.maps import colour, crispness, merge
from lslam.odometry.frontend import inertial_start
from lslam.odometry.inertial import wheel_motion
from lslam.osm import wall_match
from lslam.registration import optimiser
from lslam.registration.preprocessing import ground


@dataclass(frozen=True)
class Kernels:
    """Kernels of one part of a run.

    is_called : whether a run as configured calls them
    warm_up : compiles or loads them; ahead : those of them that a second process compiles
    is_of_scans : not called where all scans are registered
    """

    is_called: Callable[[Config], bool]
    warm_up: Callable[[Config], object] = lambda config: None
    ahead: Callable[[Config], object] | None = None
    is_of_scans: bool = False


def _of_map(config: Config) -> None:
    merge.warm_up()
    crispness.warm_up()


def _last_of_method(config: Config) -> None:
    optimiser.warm_up()
    ground.warm_up()


KERNELS = {
    # A method has a `warm_up` of its own.
    "method": Kernels(lambda config: True, ahead=_last_of_method, is_of_scans=True),
    "loops": Kernels(
        lambda config: config.loops.use or bool(config.localize.map),
        lambda config: find_loops.warm_up(config.loops),
        lambda config: find_loops.warm_up_candidates(config.loops),
    ),
    "walls": Kernels(lambda config: bool(config.osm.extract), lambda config: wall_match.warm_up()),
    "map": Kernels(lambda config: config.map.write, _of_map, _of_map),
    "colours": Kernels(lambda config: config.map.write and config.map.colour, lambda config: colour.warm_up()),
    "imu": Kernels(lambda config: config.imu.use, lambda config: inertial_start.warm_up(), is_of_scans=True),
    "wheels": Kernels(
        lambda config: bool(config.wheels.source), lambda config: wheel_motion.warm_up(), is_of_scans=True
    ),
}


class Warmed(Protocol):
    """Object with kernels of its own."""

    def warm_up(self) -> None:
        """Compile or load them."""
        ...


def load_kernels(config: Config, trackers: Iterable[Warmed], *, is_over: bool = False) -> None:
    """Compile or load the kernels that a run calls.

    trackers : those that process its scans; is_over : all of these are registered
    """
    for tracker in () if is_over else trackers:
        tracker.warm_up()
    for part in KERNELS.values():
        if part.is_called(config) and not (is_over and part.is_of_scans):
            part.warm_up(config)


@contextmanager
def helped(config: Config) -> Iterator[Callable[[], None]]:
    """Context with a function that starts the second process once; the process ends with the block.

    Without a second core, or a shared cache, nothing starts.
    """
    started: list[subprocess.Popen[bytes]] = []

    def start() -> None:
        if started or available_cores() < 2 or jit.lock_file() is None or not sys.executable:
            return
        words = [name for name, part in KERNELS.items() if part.ahead and part.is_called(config)]
        command = [sys.executable, "-P", "-m", "lslam.pipeline.precompile", *words]
        nowhere = subprocess.DEVNULL
        try:
            started.append(subprocess.Popen(command, stdin=nowhere, stdout=nowhere, stderr=nowhere))
        except OSError:  # the first process compiles everything then
            return

    try:
        yield start
    finally:
        for process in started:
            process.kill()
            process.wait()


def main(names: list[str]) -> None:
    """Compile the second process's share of the kernels of the named parts."""
    for name in names:
        ahead = KERNELS[name].ahead
        if ahead is not None:
            ahead(Config())


if __name__ == "__main__":
    main(sys.argv[1:])
