"""Signals that Python would lose: raised where nothing can be raised, they come again."""

from __future__ import annotations

import os
import signal
import time
import types
from collections.abc import Iterator
from typing import Any

import numba
import numpy as np
import pytest
from numba.core import event

from lslam.core.kernels.jit import kernel
from lslam.core.stopping import Interrupt, handle_signals


class Hit:
    """Gets a signal while it is finalised, where Python ignores what is raised."""

    def __init__(self, number: signal.Signals) -> None:
        self.number = number

    def __del__(self) -> None:
        os.kill(os.getpid(), self.number)
        for _ in range(1000):  # the handler runs between byte codes
            pass


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_that_python_would_ignore_comes_again(
    number: signal.Signals, capfd: pytest.CaptureFixture[str]
) -> None:
    lost: list[float] = []

    def be_hit() -> None:
        Hit(number)
        lost.append(time.monotonic())
        time.sleep(20)

    with handle_signals(), pytest.raises(KeyboardInterrupt):
        be_hit()
    assert lost, "the interrupt was raised in the finaliser: this test proves nothing"
    assert time.monotonic() - lost[0] < 5
    assert "ignored" not in capfd.readouterr().err


def test_other_errors_of_finalisers_are_reported_as_ever() -> None:
    class Broken:
        def __del__(self) -> None:
            raise ValueError("broken")

    seen = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.unraisablehook", lambda lost: seen.append(lost.exc_type))
        with handle_signals():
            Broken()
    assert seen == [ValueError]


@kernel
def give_back(values: np.ndarray, rounds: int) -> tuple[np.ndarray, np.ndarray]:
    out = np.zeros(4)
    for k in range(rounds):
        out[k % 4] += values[k % len(values)]
    return out, 2 * out


def test_what_is_raised_while_a_kernel_runs_is_an_interrupt_and_nothing_else() -> None:
    """A signal that comes in a kernel is handled where numba makes its result an array, and loses what is raised."""
    values = np.ones(100)
    give_back(values, 1)

    def work() -> None:
        while True:
            give_back(values, 20_000)

    ends = set()
    for k in range(60):
        try:
            # Set outside, it could come outside on a machine that is busy, and end pytest.
            with handle_signals():
                signal.setitimer(signal.ITIMER_REAL, 0.002 + k * 1e-5)
                work()
        except BaseException as error:
            ends.add(type(error))
    assert ends == {Interrupt}


@pytest.fixture(autouse=True)
def _alarm() -> Iterator[None]:
    """An alarm is answered as SIGINT is."""
    before = signal.signal(signal.SIGALRM, lambda number, frame: signal.getsignal(signal.SIGINT)(number, frame))  # type: ignore
    yield
    signal.signal(signal.SIGALRM, before)


def test_compiling_is_left_between_two_passes_and_the_kernel_compiles_afterwards() -> None:
    """Raised in the middle of LLVM, an interrupt leaves a module with two owners, who both free it."""
    passes: list[str] = []

    class Struck(event.Listener):
        def on_start(self, event: Any) -> None:
            passes.append(event.data["name"])
            if len(passes) == 10:
                os.kill(os.getpid(), signal.SIGINT)
                for _ in range(1000):
                    pass

        def on_end(self, event: Any) -> None:
            pass

    @numba.njit
    def doubled(x: float) -> float:
        return 2 * x

    with handle_signals(), pytest.raises(Interrupt) as raised, event.install_listener("numba:run_pass", Struck()):
        doubled(1.0)
    assert len(passes) == 10
    assert raised.traceback[-2].frame.f_globals["__name__"] == "numba.core.compiler_machinery"
    assert doubled(1.5) == 3.0


def test_what_comes_in_llvm_is_raised_when_it_is_left() -> None:
    module = types.ModuleType("llvmlite.binding.struck")
    source = "def strike(kill):\n    kill()\n    for k in range(1000):\n        pass\n    return 'whole'\n"
    exec(source, module.__dict__)
    seen: list[str] = []

    def work() -> None:
        seen.append(module.strike(lambda: signal.raise_signal(signal.SIGINT)))
        seen.append("too late")

    with handle_signals(), pytest.raises(Interrupt):
        work()
    assert seen == ["whole"]
