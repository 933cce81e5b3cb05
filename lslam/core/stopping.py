"""SIGINT and SIGTERM as a wish: a run looks for it wherever its loops turn; what has no such places ends where it is."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from itertools import dropwhile
from threading import Timer, current_thread, main_thread
from types import FrameType
from typing import NoReturn, TypeVar

from lslam.core.errors import InterruptedRunError

T = TypeVar("T")

SIGNALS = (signal.SIGINT, signal.SIGTERM)
AGAIN_S = 0.01
# Nothing is raised in these: a kernel that gives back an array would end as a SystemError, LLVM would free a module twice.
_FOREIGN = ("numba", "llvmlite")
_BETWEEN_PASSES = "numba.core.compiler_machinery"  # of one kernel: where compiling can be left
_DEEP = 10


class Interrupt(KeyboardInterrupt):
    """What a signal raises; not KeyboardInterrupt itself, for which Python that was in `exec` ends with -2 for any exit code."""


class Stop:
    """Record of a request to stop.

    While `is_gentle`, the first signal only sets it; otherwise, and on the second signal, Interrupt is raised in the running
    Python code, but never in a kernel or in LLVM. may_force : whether a second signal is treated so
    """

    def __init__(self, may_force: bool = True) -> None:
        self.is_gentle = False
        self._may_force = may_force
        self._is_asked = self._is_forced = self._comes_again = False
        self._number: int = signal.SIGINT

    def __call__(self) -> bool:
        """True from the first signal on."""
        return self._is_asked

    def check(self) -> None:
        """Raise Interrupt if a stop was requested: for loops that know nothing of runs, whose callers clean up."""
        if self._is_asked:
            raise Interrupt

    def on_signal(self, number: int, frame: FrameType | None) -> None:
        """Handler of the signal `number` at `frame`: record it, and raise Interrupt if that is due and safe there."""
        if self._comes_again:
            self._comes_again = False
        else:
            self._is_forced = self._is_asked and self._may_force
            self._is_asked, self._number = True, number
        if self.is_gentle and not self._is_forced:
            return
        names = [(str(f.f_globals.get("__name__")), f) for f in _outwards(frame)]
        if any(name == __name__ for name, _ in names[:_DEEP]):  # in `on_loss`, where it would be lost once more
            self._come_again()
            return
        left = dropwhile(lambda named: _package(named[0]) not in _FOREIGN, names)
        caller = next((f for name, f in left if _can_raise_in(name)), None)
        if caller is None:
            raise Interrupt
        _raise_after(caller)

    def on_loss(
        self, hook_arguments: sys.UnraisableHookArgs, report: Callable[[sys.UnraisableHookArgs], object]
    ) -> None:
        """Hook for exceptions that Python cannot raise (in finalisers and callbacks of LLVM): an Interrupt is sent again.

        report : the hook for all others
        """
        if issubclass(hook_arguments.exc_type, KeyboardInterrupt):
            self._come_again()
        else:
            report(hook_arguments)

    def _come_again(self) -> None:
        """Send the signal once more in a moment, since it cannot be handled safely now."""
        self._comes_again = True
        again = Timer(AGAIN_S, signal.pthread_kill, (main_thread().ident, self._number))
        again.daemon = True
        again.start()


_current: Stop | None = None


def current() -> Stop:
    """The `Stop` that handles signals now; without one, a `Stop` that never stops."""
    return _current or Stop()


@contextmanager
def handle_signals(numbers: Sequence[int] = SIGNALS, may_force: bool = True) -> Iterator[Stop]:
    """Handle signals in the block by a `Stop`, the outer or main thread's if there is one; may_force : as of `Stop`."""
    global _current
    if _current is not None or current_thread() is not main_thread():
        stop = current()
        try:
            yield stop
        finally:
            stop.is_gentle = False
        return
    _current = stop = Stop(may_force)
    previous = [(number, signal.signal(number, stop.on_signal)) for number in numbers]
    report = sys.unraisablehook
    sys.unraisablehook = lambda lost: stop.on_loss(lost, report)
    try:
        yield stop
    finally:
        _current = None
        sys.unraisablehook = report
        for number, handler in previous:
            if signal.getsignal(number) == stop.on_signal:  # not what was decided in the block
                signal.signal(number, handler)


_asked: ContextVar[tuple[Callable[[], bool], str]] = ContextVar("asked", default=(lambda: False, ""))


@contextmanager
def asking(should_stop: Callable[[], bool], message: str) -> Iterator[None]:
    """In the block, in this thread, `check_stop` calls `should_stop`; message : of the error when that returns True."""
    token = _asked.set((should_stop, message))
    try:
        yield
    finally:
        _asked.reset(token)


def check_stop() -> None:
    """Raise InterruptedRunError when the run at hand was asked to stop: for loops that take long, once a turn."""
    should_stop, said = _asked.get()
    if should_stop():
        raise InterruptedRunError(said)


def checking(items: Iterable[T]) -> Iterator[T]:
    """The items, with a `check_stop` before each."""
    for item in items:
        check_stop()
        yield item


def is_too_late() -> None:
    """Ignore signals from now on: the process is about to end, and its exit code is decided."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def is_interrupt(error: BaseException) -> bool:
    """Whether `error` comes from a signal: an Interrupt, or an error that foreign code raised in place of it."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, KeyboardInterrupt):
        cause = cause.__cause__
    return cause is not None


def _outwards(frame: FrameType | None) -> Iterator[FrameType]:
    """The frame and its callers, innermost first."""
    while frame is not None:
        yield frame
        frame = frame.f_back


def _package(name: str) -> str:
    """The top-level package of a module's name."""
    return name.partition(".")[0]


def _can_raise_in(name: str) -> bool:
    """Whether an exception raised in code of the module `name` does no harm, unlike in numba, LLVM or the standard library."""
    package = _package(name)
    return name == _BETWEEN_PASSES or (package not in _FOREIGN and package not in sys.stdlib_module_names)


def _raise_after(caller: FrameType) -> None:
    """Raise Interrupt in the frame `caller`, at its next line or its end."""

    def interrupt(*_: object) -> NoReturn:
        raise Interrupt

    caller.f_trace = interrupt
    sys.settrace(lambda *_: None)  # frames are looked at from now on; Python forgets it when one raises
