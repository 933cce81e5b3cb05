"""What several threads ask for at once is made once."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from lslam.backend.loops.gating import SharedResults


def test_whoever_asks_meanwhile_waits_for_the_one_that_makes_it() -> None:
    made: list[int] = []
    everybody = threading.Barrier(4)

    def make(number: int) -> object:
        made.append(number)
        return object()

    results = SharedResults(make)

    def ask(_: int) -> list[object]:
        everybody.wait()
        return [results.get(number) for number in range(50)]

    with ThreadPoolExecutor(4) as pool:
        answers = list(pool.map(ask, range(4)))
    assert sorted(made) == list(range(50))
    assert all(answer == answers[0] for answer in answers)


def test_the_last_used_ones_are_kept() -> None:
    made: list[int] = []
    results = SharedResults(lambda number: made.append(number), size=2)
    for number in (1, 2, 1, 3, 1, 2):
        results.get(number)
    assert made == [1, 2, 3, 2]


def test_what_could_not_be_made_is_said_to_all_that_ask() -> None:
    def make(number: int) -> int:
        raise OSError(f"no cloud {number}")

    results = SharedResults(make)
    for _ in range(2):
        with pytest.raises(OSError, match="no cloud 7"):
            results.get(7)
