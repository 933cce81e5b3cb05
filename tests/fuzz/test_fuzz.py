"""Two thousand inputs, always the same ones, and the harness itself: what it must not let through.

More by hand: `python -m tests.fuzz --count 100000`.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fuzz import campaign, trial
from fuzz.campaign import run_batch, try_all, warm_up
from fuzz.cases import Parser
from fuzz.parsers import PARSERS
from fuzz.trial import attempt, little_memory

from lslam.core.errors import InputError

COUNT = -(-2000 // len(PARSERS))


@pytest.mark.parametrize("parser", PARSERS, ids=lambda parser: parser.name)
def test_every_input_is_read_or_refused_with_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, parser: Parser
) -> None:
    monkeypatch.chdir(tmp_path)
    warm_up(parser, tmp_path)
    assert attempt(parser, parser.corpus(tmp_path / "corpus")[0], tmp_path / "in").kind == trial.READ
    with little_memory():
        verdicts = [(k, verdict) for k, _, verdict in try_all(parser, tmp_path, COUNT)]
    assert not [(k, verdict) for k, verdict in verdicts if not verdict.is_allowed]
    assert len(verdicts) == COUNT


def test_the_same_number_gives_the_same_inputs(tmp_path: Path) -> None:
    (parser,) = (p for p in PARSERS if p.name == "run folder")
    first, second, other = (list(campaign.inputs_of(parser, tmp_path, 20, number)) for number in (1, 1, 2))
    assert first == second
    assert first != other


def _raises(folder: Path) -> None:
    raise KeyError("time")


def _hangs(folder: Path) -> None:
    time.sleep(5)


def _grows(folder: Path) -> None:
    np.ones(3 * trial.BYTES, np.uint8)


def _writes(folder: Path) -> None:
    (folder / "more").write_text("")


def _mutters(folder: Path) -> None:
    raise InputError("")


def _refuses(folder: Path) -> None:
    raise InputError(f"{folder} is no good")


@pytest.mark.parametrize(
    ("read", "kind"),
    [
        (_raises, trial.RAISED), (_hangs, trial.HUNG), (_grows, trial.GREW), (_writes, trial.WROTE), (_mutters, trial.MUTE),
        (_refuses, trial.REFUSED), (lambda folder: None, trial.READ),
    ],
)  # fmt: skip
def test_what_is_not_allowed_is_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, read: Callable[[Path], object], kind: str
) -> None:
    monkeypatch.setattr(trial, "SECONDS", 0.3)
    with little_memory():
        verdict = attempt(Parser("bad", read, lambda folder: []), {"a": b""}, tmp_path / "in")
    assert (verdict.kind, verdict.is_allowed) == (kind, kind in ("read", "refused"))


def test_a_child_that_dies_costs_one_input(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The child is another program here, which dies at the third input as native code does."""
    child = tmp_path / "child.py"
    child.write_text(
        "import json, os, sys\ncount, _, begin = map(int, sys.argv[-3:])\n"
        "for k in range(begin, count):\n    if k == 2: os.abort()\n"
        "    print(json.dumps({'k': k, 'kind': 'read', 'where': '', 'seconds': 0.0}), flush=True)\n"
    )
    python = tmp_path / "python"
    python.write_text(f'#!/bin/sh\nexec {campaign.sys.executable} {child} "$@"\n')
    python.chmod(0o755)
    monkeypatch.setattr(campaign.sys, "executable", str(python))
    kinds = Counter(said["kind"] for said in run_batch(Parser("any", _refuses, lambda folder: []), 5, 0))
    assert kinds == {"read": 4, "died": 1}
