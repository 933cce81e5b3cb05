"""Kernels of a run, compiled or loaded by a table of kernels per part of a run.

At a cold start a second process compiles ahead what the first needs later, on an idle core: a process, since the compiler has
one lock for all threads. Both share one cache, and no kernel is compiled twice. The modules that have kernels are imported when
these are, so that the second process begins before its parent has imported them.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Protocol

from lslam.core.kernels.cache import is_cold, kernel_folder
from lslam.core.machine import available_cores, lock, rarely_collecting

if TYPE_CHECKING:
    from lslam.core.config import Config

# Kernels, by method, that are ready before the first scan as configured by default; for the line that counts them.
COUNTS = {"icp": 10}


@dataclass(frozen=True)
class Kernels:
    """Kernels of one part of a run.

    applies : whether a run as configured calls them
    warm_up : compiles or loads them; ahead : those of them that a second process compiles
    is_of_scans : called before all scans are registered, and then no more; the others are called after that only
    """

    applies: Callable[[Config], bool]
    warm_up: Callable[[Config], object] = lambda config: None
    ahead: Callable[[Config], object] | None = None
    is_of_scans: bool = False


def warm_up(*modules: str) -> Callable[[Config], None]:
    """Function that compiles or loads the kernels of modules of lslam, each by its own `warm_up`."""

    def load(config: Config) -> None:
        for module in modules:
            import_module(f"lslam.{module}").warm_up()

    return load


def _last_of_method(config: Config) -> None:
    """Compile the kernels that a method needs last: optimiser, its target, ground."""
    from lslam.odometry import create_odometry
    from lslam.registration import optimiser
    from lslam.registration.preprocessing import ground
    from lslam.registration.voxel_target import VoxelTarget

    optimiser.warm_up()
    target = getattr(getattr(create_odometry(config), "registration", None), "target", None)
    if isinstance(target, VoxelTarget):
        target.warm_up()
    ground.warm_up()


def _loops(config: Config) -> None:
    """Compile or load the kernels of loop detection."""
    from lslam.backend.loops import find_loops

    find_loops.warm_up(config.loops)


_map = warm_up("maps.merge", "maps.crispness")
_imu, _wheels = warm_up("odometry.frontend.inertial_start"), warm_up("odometry.inertial.wheel_motion")
KERNELS = {
    # A method has a `warm_up` of its own.
    "method": Kernels(lambda config: True, ahead=_last_of_method, is_of_scans=True),
    "imu": Kernels(lambda config: config.imu.use, _imu, is_of_scans=True),
    "wheels": Kernels(lambda config: bool(config.wheels.source), _wheels, is_of_scans=True),
    "loops": Kernels(lambda config: config.loops.use or bool(config.localize.map), _loops, _loops),
    "walls": Kernels(lambda config: bool(config.osm.extract), warm_up("osm.wall_match")),
    "map": Kernels(lambda config: config.map.write, _map, _map),
    "colours": Kernels(lambda config: config.map.write and config.map.colour, warm_up("maps.colour")),
}


class HasKernels(Protocol):
    """Object with kernels of its own."""

    def warm_up(self) -> None:
        """Compile or load the object's kernels."""
        ...


def load_kernels(config: Config, trackers: Iterable[HasKernels]) -> None:
    """Compile or load the kernels that registering scans calls; trackers : those that do it."""
    for tracker in trackers:
        tracker.warm_up()
    load_parts(config, [name for name, part in KERNELS.items() if part.is_of_scans])


def load_parts(config: Config, names: Iterable[str]) -> None:
    """Compile or load the kernels of these parts, as far as a run as configured calls them."""
    for name in names:
        if KERNELS[name].applies(config):
            KERNELS[name].warm_up(config)


_helpers: list[subprocess.Popen[bytes]] = []


def start_helper(config: Config, *, if_cold: bool = False) -> None:
    """Start the second process, which compiles kernels, once; if_cold : only where no kernel is compiled yet.

    Without a second core, or a shared cache, nothing starts.
    """
    if (
        _helpers
        or available_cores() < 2
        or not sys.executable
        or kernel_folder() is None
        or (if_cold and not is_cold())
    ):
        return
    words = [name for name, part in KERNELS.items() if part.ahead and part.applies(config)]
    command = [sys.executable, "-P", "-m", "lslam.pipeline.precompile", config.model_dump_json(), *words]
    nowhere = subprocess.DEVNULL
    with contextlib.suppress(OSError):  # the first process compiles everything then
        _helpers.append(subprocess.Popen(command, stdin=nowhere, stdout=nowhere, stderr=nowhere))


@contextlib.contextmanager
def helper_process() -> Iterator[None]:
    """Context at whose end the second process, if one was started, ends."""
    try:
        yield
    finally:
        while _helpers:
            process = _helpers.pop()
            process.kill()
            process.wait()


def main(config: Config, names: Iterable[str]) -> None:
    """Compile the second process's share of the kernels of the named parts, unless another process does."""
    folder = kernel_folder()
    if folder is None:
        return
    with (folder / "compile.lock").open("a") as stream:
        if lock(stream):
            compile_ahead(config, names)


def compile_ahead(config: Config, names: Iterable[str]) -> None:
    """Compile the second process's share of the kernels of the named parts."""
    with rarely_collecting():
        for name in names:
            ahead = KERNELS[name].ahead
            if ahead is not None:
                ahead(config)


if __name__ == "__main__":
    from lslam.core.config import Config

    main(Config.model_validate_json(sys.argv[1]), sys.argv[2:])
