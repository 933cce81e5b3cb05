"""The comparisons with both theses that ship with lslam, as tables of the documents.

    python tests/benchmarks/theses.py girolimetto|del-tufo [--quick] [--seeds 100-104] [--jobs 2] [--runs FOLDER] [--write FILE]

Runs `lslam compare NAME`; runs in FOLDER are kept and gone on with. Three tables are made of what it says: numbers of each
drive and system beside the thesis', what is stated of one system against another, and what no number is printed of.
Runs are made by other processes, whose code `ages.py` does not see: `ages.py --made TABLE` then.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import tables

from lslam.cli.compare import command
from lslam.studies.options import COMPARISON
from lslam.studies.ready_comparison import comparison_names

MARKS = {"reproduced": " +", "refuted": " -", "undecided": ""}


def compared(name: str, folder: Path, options: list[str]) -> dict[str, Any]:
    """The document of the comparison."""
    command.main([name, "--out", str(folder), "--table", "csv", "-q", *options], standalone_mode=False)
    document: dict[str, Any] = json.loads((folder / COMPARISON).read_text(encoding="utf-8"))
    return document


def numbers(table: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """A row per drive and system, a column per quantity."""
    rows = [dict(zip(table["header"], row, strict=True)) for row in table["rows"]]
    quantities = list(dict.fromkeys(row["quantity"] for row in rows))
    cells: dict[tuple[str, str, str], dict[str, str]] = {}
    for row in rows:
        own = cells.setdefault((row["sequence"], row["method"], row["ours was"]), {})
        own[row["quantity"]] = f"{row['ours']} ({row['thesis']}){MARKS[row['verdict']]}"
    header = ["drive", "system", "ours was", *quantities]
    return header, [[*key, *(own.get(each, "") for each in quantities)] for key, own in cells.items()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=comparison_names())
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--seeds")
    parser.add_argument("--jobs", default="1")
    parser.add_argument("--runs", type=Path, metavar="FOLDER")
    tables.offer(parser, seeds=None)
    args = parser.parse_args()
    options = [
        "--jobs",
        args.jobs,
        *(["--quick"] if args.quick else []),
        *(["--seeds", args.seeds] if args.seeds else []),
    ]
    with tempfile.TemporaryDirectory() as scratch:
        document = compared(args.name, args.runs or Path(scratch) / args.name, options)
    beside, stated, unprinted = document["beside"]
    seeds = tables.seeds_named(sorted({run["seed"] for run in document["runs"]}))
    recipe = (
        "ours, median / worst, and in brackets what the thesis prints; + reproduced, - refuted, else undecided; `ours was`: how "
        "hard, by the angular error"
    )
    made = (
        ("", recipe, *numbers(beside)),
        *(
            (f"-{mark}", of["recipe"], of["header"], of["rows"])
            for mark, of in (("stated", stated), ("unprinted", unprinted))
        ),
    )
    for mark, said, header, rows in made:
        if rows:
            tables.table(f"{args.name}{mark}", f"On {seeds}: {said}.", header, rows, args.write)


if __name__ == "__main__":
    main()
