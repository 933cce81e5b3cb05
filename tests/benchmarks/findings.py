"""What Girolimetto found of parameters, judged by its eight studies on fresh seeds.

    python tests/benchmarks/findings.py [--runs FOLDER] [--studies share,skip-frames] [--seeds 100-104] [--write docs/theses.md]

Runs `lslam sweep STUDY --seeds ...` for each, two at once; an idle machine with two cores takes three quarters of an
hour. Runs in FOLDER are kept and gone on with.
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
    parser.add_argument("--studies", default=",".join(study_names()))
    parser.add_argument("--runs", type=Path, metavar="FOLDER")
    tables.offer(parser)
    args = parser.parse_args()
    studies, seeds, rows = args.studies.split(","), tables.numbers(args.seeds), []
    with tempfile.TemporaryDirectory() as scratch:
        for study in studies:
            for result in swept(study, seeds, args.runs or Path(scratch)):
                rows += [[study, v.text, v.outcome, v.numbers] for v in result.verdicts]
    scenes = {place.scenario for study in studies for place in find_study(study).sequences}
    caption = (
        f"Girolimetto's presets on the simulated flight `{', '.join(sorted(scenes))}`, {tables.seeds_named(seeds)}. A "
        "verdict asks for evidence on both sides of what is stated, beyond what the seeds scatter."
    )
    tables.table("findings", caption, ["study", "the thesis", "verdict", "here"], rows, args.write)


if __name__ == "__main__":
    main()
