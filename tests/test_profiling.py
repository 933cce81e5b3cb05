"""A profile against threads whose work is known."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path
from types import FrameType
from typing import Any, cast

import pytest

from lslam.cli import one_run
from lslam.core.errors import OutputError


def spin(seconds: float) -> None:
    until = time.perf_counter() + seconds
    while time.perf_counter() < until:
        pass


def rest(seconds: float) -> None:
    time.sleep(seconds)


def seconds_in(document: dict[str, Any], thread: str, function: str) -> float:
    """Of the samples of a thread that have the function in their stack."""
    (profile,) = (p for p in document["profiles"] if p["name"] == thread)
    inside = {k for k, frame in enumerate(document["shared"]["frames"]) if frame["name"] == function}
    pairs = zip(profile["samples"], profile["weights"], strict=True)
    return float(sum(weight for sample, weight in pairs if inside & set(sample)))


def test_seconds_are_where_they_were_spent(tmp_path: Path) -> None:
    other = threading.Thread(target=rest, args=(0.4,), name="resting")
    with one_run.profile_to(tmp_path / "p.json"):
        other.start()
        spin(0.3)
        other.join()
        rest(0.2)
    document = json.loads((tmp_path / "p.json").read_text())
    assert seconds_in(document, "MainThread", "spin") == pytest.approx(0.3, abs=0.1)
    assert seconds_in(document, "MainThread", "rest") == pytest.approx(0.2, abs=0.1)
    assert seconds_in(document, "resting", "rest") == pytest.approx(0.4, abs=0.1)
    assert seconds_in(document, "resting", "spin") == 0
    names = {frame["name"] for frame in document["shared"]["frames"]}
    assert "time.sleep(seconds)" in names  # the line, where it waits outside of Python
    for profile in document["profiles"]:
        assert profile["name"] != "profile"
        assert sum(profile["weights"]) == pytest.approx(profile["endValue"], abs=1e-3)
        assert max(k for sample in profile["samples"] for k in sample) < len(document["shared"]["frames"])


def test_a_long_run_is_looked_at_less_often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(one_run, "MAX_STACKS", 10)
    monkeypatch.setattr(one_run, "INTERVAL_S", 0.001)
    profile = one_run.StackProfile()
    profile.start()
    for _ in range(60):
        spin(0.005)
        rest(0.005)
    profile.stop()
    (main,) = (p for p in profile.speedscope("x")["profiles"] if p["name"] == "MainThread")
    assert len(main["samples"]) < 100
    assert sum(main["weights"]) == pytest.approx(main["endValue"], abs=1e-3)


def test_it_is_written_when_the_block_fails(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), one_run.profile_to(tmp_path / "p.json"):
        raise KeyboardInterrupt
    assert json.loads((tmp_path / "p.json").read_text())["exporter"].startswith("lslam")


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"p\.json"), one_run.profile_to(tmp_path / "none" / "p.json"):
        pass


def test_a_frame_between_two_lines_has_the_line_of_its_function() -> None:
    class Between:
        f_code, f_lineno, f_back = spin.__code__, None, None

    outer, inner = one_run.stack_of(cast(FrameType, Between()))
    assert outer == ("spin", spin.__code__.co_filename, spin.__code__.co_firstlineno)
    assert inner[0] == "def spin(seconds: float) -> None:"
