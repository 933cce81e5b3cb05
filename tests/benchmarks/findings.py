"""What Girolimetto found of parameters, judged by its eight studies on fresh seeds.

    python tests/benchmarks/findings.py STUDY [--runs FOLDER] [--seeds 100-104] [--write docs/theses.md]

Runs `lslam sweep STUDY --seeds ...`, two runs at once. Runs in FOLDER are kept and gone on with.
Each study has a table of its own, so that one can be renewed where there is no time for all.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import tables

from lslam.core.types.study import StudyResult
from lslam.studies.options import find_study, study_names
from lslam.studies.study_runs import report_folder


def swept(study: str, seeds: list[int], folder: Path) -> list[StudyResult]:
    words = [
        "sweep",
        study,
        "--seeds",
        ",".join(map(str, seeds)),
        "--jobs",
        "2",
        "--scenes",
        str(folder / "scenes"),
        "-q",
    ]
    out = folder / study
    resume = ["--resume"] if out.is_dir() else []
    subprocess.run(
        [sys.executable, "-m", "lslam", *words, *resume, "--out", str(out)], check=True, stdout=subprocess.DEVNULL
    )
    return report_folder(out)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", choices=study_names())
    parser.add_argument("--runs", type=Path, metavar="FOLDER")
    tables.offer(parser)
    args = parser.parse_args()
    seeds = tables.numbers(args.seeds)
    with tempfile.TemporaryDirectory() as scratch:
        results = swept(args.study, seeds, args.runs or Path(scratch))
    rows = [[verdict.text, verdict.outcome, verdict.numbers] for result in results for verdict in result.verdicts]
    scenes = ", ".join(sorted({place.scenario for place in find_study(args.study).sequences}))
    caption = (
        f"Study `{args.study}`: Girolimetto's presets on the simulated flight `{scenes}`, {tables.seeds_named(seeds)}."
    )
    tables.table(f"findings-{args.study}", caption, ["the thesis", "verdict", "here"], rows, args.write)


if __name__ == "__main__":
    main()
