"""What ends a run on its way: somebody who asks to stop, and a second signal."""

from __future__ import annotations

from collections.abc import Callable

from lslam.pipeline.watch import Watch


def interrupted(stage: str, after: int) -> Watch:
    """Asks to stop after so many scans of a stage."""
    left, now = [after], [""]

    def step() -> None:
        left[0] -= now[0] == stage

    return Watch(lambda name, total: now.__setitem__(0, name), step, lambda outcome: None, lambda: left[0] <= 0)


def die_at(scan: int) -> Callable[[int], None]:
    """Something that ends the run at once when a scan is read, as the second signal does."""

    def on_read(index: int) -> None:
        if index == scan:
            raise KeyboardInterrupt

    return on_read
