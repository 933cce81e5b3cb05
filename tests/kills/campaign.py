"""Runs that are killed at random instants and go on, and what then differs from runs that nobody disturbed.

Half of the instants lie anywhere in the time of a run, the others in that of its stages that were hit least. A run is killed
up to three times before it may end. SIGKILL is what most get; SIGTERM and SIGINT have to be answered with exit code 130 and the
status `interrupted`. After each, every file under its final name has to be whole.
"""

from __future__ import annotations

import argparse
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from threading import Lock

from kills.child import STAGES
from kills.drives import DRIVES
from kills.trial import Kill, Run, faults_after_kill, faults_at_end, run

NUMBERS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
SHARES = (6, 2, 2)
MOST = 3  # kills of one run


@dataclass
class Whole:
    """A run that nobody disturbed: its folder, and the seconds of its stages."""

    place: Path
    lengths: dict[str, float]

    @property
    def life(self) -> float:
        """Seconds of all stages."""
        return sum(self.lengths.values())


@dataclass
class Tally:
    """What was done and found.

    hits : kills by stage and signal; by_drive : by drive and signal; ended : runs that came to their end, by drive
    faults : sentences; slowest : s to answer a signal, by stage
    """

    hits: Counter[tuple[str, str]] = field(default_factory=Counter)
    by_drive: Counter[tuple[str, str]] = field(default_factory=Counter)
    ended: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)
    slowest: dict[str, float] = field(default_factory=dict)
    kills: int = 0
    lock: Lock = field(default_factory=Lock)

    def by_stage(self, stage: str) -> int:
        """Kills in a stage."""
        return sum(self.hits[stage, number.name] for number in NUMBERS)

    def note(self, drive: str, done: Run, kill: Kill) -> None:
        """Count a kill that hit."""
        with self.lock:
            self.kills += 1
            self.hits[done.stage, kill.number.name] += 1
            self.by_drive[drive, kill.number.name] += 1
            if kill.number != signal.SIGKILL:
                self.slowest[done.stage] = max(self.slowest.get(done.stage, 0.0), done.answer)


def undisturbed(drive: str, folder: Path, tally: Tally) -> Whole:
    """The run to compare with: of two, of which the first may have to compile kernels."""
    places = [folder / f"{drive} {name}" for name in ("whole", "again")]
    for place in places:
        place.mkdir(parents=True)
        done = run(drive, place)
        if done.code:
            raise SystemExit(f"{drive}: the run ends with {done.code} by itself: {done.said[-300:]}")
    tally.faults += [f"{drive}, run twice: {said}" for said in faults_at_end(places[1], places[0], done)]
    return Whole(places[0], done.lengths)


def drawn(rng: Random, whole: Whole, tally: Tally) -> Kill:
    """Signal and instant of the next kill."""
    (number,) = rng.choices(NUMBERS, SHARES)
    if rng.random() < 0.5:
        return Kill(number, rng.uniform(0.0, whole.life))
    with tally.lock:
        stage = min(whole.lengths, key=tally.by_stage)
    return Kill(number, rng.uniform(0.0, whole.lengths[stage]), stage)


def kill_one(
    drive: str, whole: Whole, place: Path, rng: Random, tally: Tally, most: int
) -> tuple[list[str], list[str]]:
    """One run, killed up to `most` times, to its end: what was done to it, and what is wrong."""
    place.mkdir(parents=True)
    story, found = [drive], list[str]()
    for _ in range(rng.randint(1, most)):
        kill = drawn(rng, whole, tally)
        done = run(drive, place, kill)
        if not done.is_hit:
            break
        tally.note(drive, done, kill)
        story.append(f"{kill.number.name} in {done.stage}")
        found += [f"{', '.join(story)}: {said}" for said in faults_after_kill(place, done, kill)]
    done = run(drive, place)
    found += [f"{', '.join(story)}, resumed: {said}" for said in faults_at_end(place, whole.place, done)]
    with tally.lock:
        tally.ended[drive] += 1
        tally.faults += found
    return story, found


def campaign(
    count: int, drives: Sequence[str], folder: Path, seed: int = 0, keep: Path | None = None, jobs: int = 1
) -> Tally:
    """`count` kills over `drives`, one run after the other, or `jobs` at a time; faulty run folders go to `keep`."""
    tally = Tally()
    wholes = {drive: undisturbed(drive, folder, tally) for drive in drives}

    def work(worker: int) -> None:
        number = worker
        while (left := count - tally.kills) > 0:
            drive, place = drives[number % len(drives)], folder / f"{number}"
            rng = Random(f"{seed} {number}")
            story, found = kill_one(drive, wholes[drive], place, rng, tally, min(MOST, left))
            if found and keep is not None:
                shutil.copytree(place, keep / f"{seed}-{number}-{drive}", dirs_exist_ok=True)
            print(f"{tally.kills} of {count}: {', '.join(story)}", *found, sep="\n  ", file=sys.stderr, flush=True)
            shutil.rmtree(place)
            number += jobs

    with ThreadPoolExecutor(jobs) as pool:
        list(pool.map(work, range(jobs)))
    return tally


def main(words: list[str] | None = None) -> int:
    """Entry point of `python -m tests.kills`; 1 when something was found."""
    ask = argparse.ArgumentParser(prog="python -m tests.kills", description=__doc__)
    ask.add_argument("--count", type=int, default=100, help="kills over all drives (default 100)")
    ask.add_argument("--only", action="append", choices=list(DRIVES), help="one of the drives; repeatable")
    ask.add_argument("--seed", type=int, default=0, help="other numbers give other instants")
    ask.add_argument("--keep", type=Path, help="a folder for the run folders in which something was wrong")
    ask.add_argument("--jobs", type=int, default=1, help="runs at a time (default 1)")
    asked = ask.parse_args(words)
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="lslam-kills-") as folder:
        tally = campaign(
            asked.count, asked.only or list(DRIVES), Path(folder), asked.seed, asked.keep, max(asked.jobs, 1)
        )
    _report(tally, time.monotonic() - began)
    return int(bool(tally.faults))


def _report(tally: Tally, seconds: float) -> None:
    names = [number.name for number in NUMBERS]
    print(f"| {'stage':10} | " + " | ".join(names) + " | all | slowest answer, s |\n|---|" + "---:|" * (len(names) + 2))
    for stage in STAGES:
        slowest = f"{tally.slowest[stage]:.1f}" if stage in tally.slowest else ""
        print(
            f"| {stage:10} | {_cells(tally.hits, stage, names)} | {tally.by_stage(stage)} | {slowest} |",
        )
    print(f"\n| {'drive':10} | runs | " + " | ".join(names) + " |\n|---|" + "---:|" * (len(names) + 1))
    for drive, runs in tally.ended.items():
        print(f"| {drive:10} | {runs} | {_cells(tally.by_drive, drive, names)} |")
    print(f"\n{tally.kills} kills of {sum(tally.ended.values())} runs in {seconds:.0f} s, {len(tally.faults)} faults")
    print("\n".join(tally.faults))


def _cells(counts: Counter[tuple[str, str]], row: str, names: list[str]) -> str:
    return " | ".join(str(counts[row, name]) for name in names)
