"""SIGINT and SIGTERM as a wish: the first ends a run after the scan at hand, the second at once."""

from __future__ import annotations

import logging
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Timer, main_thread

log = logging.getLogger("lslam")
SIGNALS = (signal.SIGINT, signal.SIGTERM)
AGAIN_S = 0.05


class GentleStop:
    """Whether somebody asked to stop. Outside `is_gentle` stages a signal raises KeyboardInterrupt right away."""

    def __init__(self) -> None:
        self.is_gentle = False
        self._is_asked = False

    def __call__(self) -> bool:
        """True from the first signal on."""
        return self._is_asked

    def on_signal(self, number: int, _: object) -> None:
        """The handler."""
        if self._is_asked or not self.is_gentle:
            raise KeyboardInterrupt
        self._is_asked = True


@contextmanager
def gentle_stop() -> Iterator[GentleStop]:
    """Install the handlers for the length of the block."""
    stop = GentleStop()
    previous = [(number, signal.signal(number, stop.on_signal)) for number in SIGNALS]
    report = sys.unraisablehook

    def on_lost(lost: sys.UnraisableHookArgs) -> None:
        # Python loses what is raised in a finaliser or a callback of LLVM, where compiling spends its time: raise it again.
        if issubclass(lost.exc_type, KeyboardInterrupt):
            again = Timer(AGAIN_S, signal.pthread_kill, (main_thread().ident, signal.SIGINT))
            again.daemon = True
            again.start()
        else:
            report(lost)

    sys.unraisablehook = on_lost
    try:
        yield stop
    finally:
        sys.unraisablehook = report
        for number, handler in previous:
            signal.signal(number, handler)
