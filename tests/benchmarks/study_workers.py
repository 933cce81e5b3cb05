"""How much sooner two workers finish a study than one, and what the seconds went into (issue 8: 1.8 times at least).

    python tests/benchmarks/study_workers.py [inlier-ratio] [--workers 1 2 2 1] [--scenes DIR] [--set input.count=40]

A process of its own per number of `--workers` makes the whole study, runs and report, as `lslam sweep` does; scenes are simulated
and kernels compiled before, and the quickest of several rounds counts. Wall seconds mean something on a quiet machine only; CPU
seconds hardly feel who else is at work. A run has one thread: its seconds are those of its CPU and what it waited for.
"""

from __future__ import annotations

import argparse
import csv
import json
import logging
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from resource import RUSAGE_CHILDREN, RUSAGE_SELF, getrusage

from lslam.studies.jobs import Local
from lslam.studies.options import OutputOptions, find_study
from lslam.studies.results_csv import read_state
from lslam.studies.runner import StudyProgress
from lslam.studies.study_runs import Sweep, expand_study, report_folder, run_sweep

GAIN = 1.8


def seconds_of(who: int) -> float:
    """CPU seconds of this process, or of its processes that came to their end."""
    usage = getrusage(who)
    return usage.ru_utime + usage.ru_stime


def study_once(sweep: Sweep, workers: int) -> dict[str, float]:
    """Wall and CPU seconds of a study by part, once this process has imported what it needs."""
    began, imported_s = time.perf_counter(), seconds_of(RUSAGE_SELF)
    run_sweep(sweep, Local(workers))
    ran, own_s = time.perf_counter(), seconds_of(RUSAGE_SELF)
    report_folder(sweep.output.out)
    return {
        "wall: runs": ran - began,
        "wall: report": time.perf_counter() - ran,
        "CPU: workers": seconds_of(RUSAGE_CHILDREN),
        "CPU: start": imported_s,
        "CPU: beside the workers": own_s - imported_s,
        "CPU: report": seconds_of(RUSAGE_SELF) - own_s,
    }


def run_parts(out: Path) -> dict[str, float]:
    """Wall seconds within all runs, by stage, and what they waited for a core."""
    parts: Counter[str] = Counter()
    for file in (out / "runs").glob("*/*.json"):
        state, folder = read_state(file), file.with_suffix("")
        assert state is not None
        parts["all runs"] += state.seconds
        parts["  waited for a core"] += state.waited * state.seconds
        timings = json.loads((folder / "manifest.json").read_text())["timings"]
        parts["  warming up"] += timings["compile_s"]
        parts["  loops and graph"] += timings["back_end_s"]
        with (folder / "timing.csv").open() as stream:
            for line in csv.DictReader(stream):
                for stage, seconds in line.items():
                    if stage not in ("index", "stamp_ns", "total"):
                        parts[f"  {stage}"] += float(seconds)
    beside = sum(v for name, v in parts.items() if name not in ("all runs", "  waited for a core"))
    return dict(parts) | {"  the rest": parts["all runs"] - beside}


def warm_up(sweep: Sweep) -> None:
    """Simulate all scenes, and compile the kernels of every method in a run of it."""
    expanded, engine = expand_study(sweep), Local(os.cpu_count() or 1)
    engine.prepare(expanded.jobs, StudyProgress())
    one_each = {expanded.variants[job.method].method: job for job in expanded.jobs}
    engine.run(list(one_each.values()), StudyProgress(), lambda job: None)


def in_own_process(args: argparse.Namespace, workers: int, out: Path) -> dict[str, float]:
    words = [
        sys.executable,
        __file__,
        args.study,
        "--scenes",
        str(args.scenes),
        "--one",
        str(out),
        "--workers",
        str(workers),
    ]
    for setting in args.settings:
        words += ["--set", setting]
    began = time.perf_counter()
    found: dict[str, float] = json.loads(subprocess.run(words, check=True, stdout=subprocess.PIPE, text=True).stdout)
    whole = {"wall": time.perf_counter() - began, "CPU": sum(v for name, v in found.items() if name.startswith("CPU"))}
    return whole | found | run_parts(out)


def print_table(found: dict[int, list[dict[str, float]]]) -> None:
    """The quickest of the rounds of each number of workers."""
    best = {workers: min(rounds, key=lambda one: one["wall"]) for workers, rounds in found.items()}
    first, *others = best
    print(f"{'s':34s}" + "".join(f"{f'{n} worker' + 's' * (n > 1):>11s}" for n in best) + f"{'ratio':>8s}")
    for name in best[first]:
        values = [one.get(name, 0.0) for one in best.values()]
        ratio = f"{values[0] / values[-1]:8.2f}" if others and values[-1] > 0.05 else ""
        print(f"{name:34s}" + "".join(f"{value:11.2f}" for value in values) + ratio)
    if others:
        gain = best[first]["wall"] / best[others[-1]]["wall"]
        said = "met" if gain >= GAIN else "missed"
        print(f"\n{others[-1]} workers finish {gain:.2f} times as fast, {GAIN} of two is wanted: {said}")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", nargs="?", default="inlier-ratio", help="a file, or a name of lslam sweep --list")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 2, 1])
    parser.add_argument("--scenes", type=Path, help="where simulations lie or are put, otherwise a temporary folder")
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    logging.getLogger("lslam").setLevel(logging.ERROR)

    def sweep(out: Path) -> Sweep:
        return Sweep(find_study(args.study), OutputOptions(out, scenes=args.scenes), tuple(args.settings))

    if args.one is not None:
        print(json.dumps(study_once(sweep(args.one), args.workers[0])))
        return
    with tempfile.TemporaryDirectory(prefix="lslam-workers-") as folder:
        args.scenes = args.scenes or Path(folder) / "scenes"
        warm_up(sweep(Path(folder) / "warm"))
        found: dict[int, list[dict[str, float]]] = {}
        for k, workers in enumerate(args.workers):
            found.setdefault(workers, []).append(in_own_process(args, workers, Path(folder) / str(k)))
    print_table(dict(sorted(found.items())))


if __name__ == "__main__":
    main()
