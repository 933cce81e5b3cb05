"""Tables of the documents, each made by a benchmark: `python tests/benchmarks/NAME.py --write docs/results.md`.

A table stands between `<!-- table NAME -->` and `<!-- end -->`, with the command that made it and a caption that names
scans, seeds and alignment. Writing replaces what stands there, and nothing else; `ages.py` keeps what made it.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import sys
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from ages import Ages

SEEDS = "100,101,102,103,104"
WIDTH = 132


def offer(parser: argparse.ArgumentParser, seeds: str | None = SEEDS) -> None:
    """The options `--write` and, unless they are None, `--seeds`."""
    if seeds is not None:
        parser.add_argument("--seeds", default=seeds, help="as 100,101 or 100-104")
    parser.add_argument("--write", type=Path, metavar="FILE", help="document in which the table is written anew")


def numbers(text: str) -> list[int]:
    """Of `100,101` and `100-104`."""
    found = []
    for part in text.split(","):
        first, _, last = part.partition("-")
        found += range(int(first), int(last or first) + 1)
    return found


def seeds_named(seeds: Sequence[int]) -> str:
    run = list(range(seeds[0], seeds[0] + len(seeds)))
    return (
        f"seeds {seeds[0]} to {seeds[-1]}"
        if list(seeds) == run and len(run) > 2
        else f"seeds {', '.join(map(str, seeds))}"
    )


def spread(values: Iterable[float], digits: int = 2) -> str:
    """Median / worst, a run without a result (inf) being the worst; `-` without runs, NaN is none."""
    known = np.array([v for v in values if not np.isnan(v)])
    if not len(known):
        return "-"
    # What failed is larger than all: the median of an even number may not be half way to infinity.
    middle = float(np.sort(known)[len(known) // 2]) if np.isinf(known).any() else float(np.median(known))
    return f"{_short(middle, digits)} / {_short(float(known.max()), digits)}"


def _short(value: float, digits: int) -> str:
    """With so many digits after the point, and two that count at least where the value is small."""
    if np.isinf(value):
        return "failed"
    if value == 0:
        return "0"
    more = int(np.ceil(-np.log10(abs(value)))) + 1
    return f"{value:.{min(max(digits, more), 4)}f}" if abs(value) < 10 else f"{value:.{max(digits - 1, 0)}f}"


def command() -> str:
    """What was typed, as somebody else types it: without `--write`, folders by a word."""
    words, skip = [], False
    for word in sys.argv[1:]:
        if not skip and word not in ("--write",) and not word.startswith("--write="):
            words.append("FOLDER" if os.path.isabs(word) else word)
        skip = word == "--write"
    script = Path(sys.argv[0]).resolve().relative_to(Path(__file__).resolve().parents[2])
    return " ".join(["python", str(script), *map(shlex.quote, words)])


def table(name: str, caption: str, header: Sequence[str], rows: Iterable[Sequence[str]], write: Path | None) -> None:
    """Print a table, and write it where a document has one of that name.

    Raises
    ------
    SystemExit
        the document has none of that name
    """
    lines = ["| " + " | ".join(cells) + " |" for cells in [header, *rows]]
    lines.insert(1, "|" + "---|" * len(header))
    text = "\n".join(["```bash", command(), "```", "", textwrap.fill(caption, WIDTH), "", *lines])
    print(f"\n{text}", flush=True)
    if write is None:
        return
    document = write.read_text(encoding="utf-8")
    block = re.compile(rf"(<!-- table {re.escape(name)} -->\n).*?(<!-- end -->)", re.DOTALL)
    if not block.search(document):
        sys.exit(f"{write} has no table {name}: it wants the lines <!-- table {name} --> and <!-- end -->")
    write.write_text(block.sub(lambda m: f"{m[1]}{text}\n{m[2]}", document), encoding="utf-8")
    Ages().stamp(name, command(), write)
