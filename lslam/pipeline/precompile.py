"""Cold start: a second process compiles what the first comes to last, on a core that would be idle meanwhile.

The compiler has one lock for all threads of a process. Both keep their kernels in the same cache, and load what is there.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from lslam.core.config import Config
from lslam.core.kernels import jit
from lslam.core.machine import available_cores


@contextmanager
def helped(config: Config) -> Iterator[Callable[[], None]]:
    """What starts the second process, and has effect once; it ends with the block, whether it was done or not.

    Without a second core, or a cache that both can reach, nothing starts.
    """
    started: list[subprocess.Popen[bytes]] = []

    def start() -> None:
        if started or available_cores() < 2 or jit.lock_file() is None or not sys.executable:
            return
        words = [word for word, is_wanted in (("map", config.map.write), ("loops", config.loops.use)) if is_wanted]
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


def main(words: list[str]) -> None:
    """Compile the optimiser's step and the ground's kernels, and those of the map and of loop candidates where named."""
    from lslam.backend.loops import find_loops
    from lslam.maps import crispness, merge
    from lslam.registration import optimiser
    from lslam.registration.preprocessing import ground

    optimiser.warm_up()
    ground.warm_up()
    if "map" in words:
        merge.warm_up()
        crispness.warm_up()
    if "loops" in words:
        find_loops.warm_up_candidates(Config().loops)


if __name__ == "__main__":
    main(sys.argv[1:])
