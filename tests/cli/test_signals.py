"""Signals that Python would lose: raised where nothing can be raised, they come again."""

from __future__ import annotations

import os
import signal
import time

import pytest

from lslam.cli.signals import gentle_stop


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

    with gentle_stop(), pytest.raises(KeyboardInterrupt):
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
        with gentle_stop():
            Broken()
    assert seen == [ValueError]
