"""Many inputs for every parser, in child processes with little memory, one after the other; a table of what became of them.

A child that dies, or that a parser holds longer than Python's clock can ring, costs the one input it was at: the next child
goes on behind it.
"""

from __future__ import annotations

import argparse
import json
import os
import select
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from random import Random
from typing import Any

from fuzz.cases import Files, Parser
from fuzz.mutate import mutated
from fuzz.parsers import PARSERS
from fuzz.structure import tables, trees
from fuzz.trial import ALLOWED, DIED, HUNG, KINDS, SECONDS, Verdict, attempt, little_memory
from hypothesis import HealthCheck, Phase, given, seed, settings

# Inputs a child works on; hypothesis' share of them.
BATCH = 500
STRUCTURED = 0.3
# What native code does not return from in this time beyond the limit, it never does.
GRACE = 10.0


def inputs_of(parser: Parser, folder: Path, count: int, number: int) -> Iterator[Files]:
    """`count` inputs: the corpus first (in batch 0), then damaged and restructured ones; the same for the same `number`."""
    corpus = parser.corpus(folder)
    made = corpus[: count if number == 0 else 0]
    yield from made
    rng = Random(f"{parser.name} {number}")
    structured = _structured(parser, corpus, round(STRUCTURED * (count - len(made))), rng.randrange(2**32))
    yield from structured
    for _ in range(count - len(made) - len(structured)):
        # Half of the time the good file: damage to what is refused anyway teaches little.
        files = corpus[0] if rng.random() < 0.5 else rng.choice(corpus)
        yield mutated(files, rng, corpus)


def _structured(parser: Parser, corpus: list[Files], count: int, number: int) -> list[Files]:
    good = corpus[0]
    strategies = [trees(good, name) for name in parser.trees if name in good]
    strategies += [tables(good, name) for name in parser.tables if name in good]
    made: list[Files] = []
    for k, strategy in enumerate(strategies):
        share = count // len(strategies) + (k < count % len(strategies))
        if not share:
            continue

        @seed(number)
        @settings(
            max_examples=share,
            database=None,
            deadline=None,
            phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )
        @given(strategy)
        def collect(files: Files) -> None:
            made.append(files)

        collect()
    return made[:count]


def try_all(
    parser: Parser, folder: Path, count: int, number: int = 0, begin: int = 0
) -> Iterator[tuple[int, Files, Verdict]]:
    """Verdicts on the inputs of a batch from the one with number `begin` on."""
    for k, files in enumerate(inputs_of(parser, folder / "corpus", count, number)):
        if k >= begin:
            yield k, files, attempt(parser, files, folder / "in")


def warm_up(parser: Parser, folder: Path) -> None:
    """What the parser imports and compiles for its first files is no part of an input's time, memory or writes."""
    for files in parser.corpus(folder / "corpus")[:3]:
        attempt(parser, files, folder / "in", seconds=120.0)


def work(name: str, count: int, number: int, begin: int) -> None:
    """The child: one line of JSON per input on stdout, the number of the next one before it is tried."""
    (parser,) = (p for p in PARSERS if p.name == name)
    with tempfile.TemporaryDirectory(prefix="lslam-fuzz-") as place:
        folder = Path(place)
        os.chdir(folder)
        warm_up(parser, folder)
        with little_memory():
            for k, files, verdict in try_all(parser, folder, count, number, begin):
                said: dict[str, Any] = {
                    "k": k,
                    "kind": verdict.kind,
                    "where": verdict.where,
                    "seconds": verdict.seconds,
                }
                if not verdict.is_allowed:
                    said["files"] = {file: data.hex() for file, data in files.items()}
                print(json.dumps(said), flush=True)


def run_batch(parser: Parser, count: int, number: int) -> Iterator[dict[str, Any]]:
    """What the child says, input by input, and what became of inputs at which it died."""
    begin = 0
    while begin < count:
        words = [sys.executable, "-m", "tests.fuzz", "--child", parser.name, str(count), str(number), str(begin)]
        root = Path(__file__).resolve().parents[2]
        with subprocess.Popen(
            words, cwd=root, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=_environment()
        ) as child:
            assert child.stdout is not None
            limit = 120.0  # imports and kernels come before the first input
            for said in _lines(child, limit):
                yield said
                begin = said["k"] + 1
            is_late = child.poll() is None
            if is_late:
                child.kill()
            assert child.stderr is not None
            last = child.stderr.read().decode(errors="replace").strip().splitlines()[-1:]
        if begin < count and (is_late or child.returncode):
            what = HUNG if is_late else DIED
            yield {
                "k": begin,
                "kind": what,
                "where": f"exit {child.returncode} {''.join(last)[:150]}",
                "seconds": SECONDS,
            }
            begin += 1
        elif begin < count:
            return  # the child had fewer


def _lines(child: subprocess.Popen[bytes], limit: float) -> Iterator[dict[str, Any]]:
    """Lines of a child until it ends, or until it says nothing for too long."""
    assert child.stdout is not None
    waiting = b""
    while True:
        if not select.select([child.stdout], [], [], limit)[0]:
            return
        data = os.read(child.stdout.fileno(), 1 << 16)
        if not data:
            child.wait()
            return
        limit = SECONDS + GRACE
        *whole, waiting = (waiting + data).split(b"\n")
        yield from (json.loads(line) for line in whole)


def _environment() -> dict[str, str]:
    # Threads take address space that no input asked for.
    return os.environ | {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def main(words: list[str] | None = None) -> int:
    """Entry point of `python -m tests.fuzz`; 1 when an input had an outcome that is not allowed."""
    ask = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    ask.add_argument("--count", type=int, default=2000, help="inputs over all parsers (default 2000)")
    ask.add_argument("--only", action="append", default=[], help="a parser's name, or a part of it")
    ask.add_argument("--seed", type=int, default=0, help="number of the first batch: others give other inputs")
    ask.add_argument("--keep", type=Path, help="a folder for the inputs that were not allowed")
    ask.add_argument("--child", nargs=4, help=argparse.SUPPRESS)
    asked = ask.parse_args(words)
    if asked.child:
        name, *numbers = asked.child
        work(name, *(int(n) for n in numbers))
        return 0
    chosen = [p for p in PARSERS if not asked.only or any(part in p.name for part in asked.only)]
    return _report(chosen, asked.count, asked.seed, asked.keep)


def _report(chosen: list[Parser], count: int, first: int, keep: Path | None) -> int:
    print(f"| {'parser':22} | inputs | " + " | ".join(KINDS) + " | slowest, s |")
    print("|---|" + "---:|" * (len(KINDS) + 2), flush=True)
    total: Counter[str] = Counter()
    faults: dict[tuple[str, str], int] = {}
    began = time.monotonic()
    for at, parser in enumerate(chosen):
        left = count // len(chosen) + (at < count % len(chosen))
        found: Counter[str] = Counter()
        slowest, number = 0.0, first
        while left > 0:
            for said in run_batch(parser, min(BATCH, left), number):
                found[said["kind"]] += 1
                slowest = max(slowest, said["seconds"])
                if said["kind"] not in ALLOWED:
                    key = (parser.name, f"{said['kind']}: {said['where']}")
                    faults[key] = faults.get(key, 0) + 1
                    if keep is not None and faults[key] == 1:
                        _keep(keep / f"{parser.name}-{len(faults)}".replace(" ", "-"), said)
            left -= BATCH
            number += 1
        total += found
        cells = " | ".join(str(found[kind]) for kind in KINDS)
        print(f"| {parser.name:22} | {sum(found.values())} | {cells} | {slowest:.2f} |", flush=True)
    print(f"| all | {sum(total.values())} | " + " | ".join(str(total[kind]) for kind in KINDS) + " | |")
    print(f"\n{sum(total.values())} inputs in {time.monotonic() - began:.0f} s")
    for (name, what), times in faults.items():
        print(f"{name}: {what} ({times} x)")
    return int(bool(faults))


def _keep(folder: Path, said: dict[str, Any]) -> None:
    for name, data in said.get("files", {}).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(bytes.fromhex(data))
