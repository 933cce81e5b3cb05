"""One run in a process of its own, killed at an instant, and what it must leave."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from kills.child import FOLDER, START
from kills.compare import differences
from kills.drives import words_of
from kills.whole import torn

OUT = "out"
# s, for the whole of a run on a machine that does other things too, and for a signal to be answered.
LONGEST, ANSWER = 240.0, 10.0
CHILD = Path(__file__).with_name("child.py")
# What a process ends with that a signal finds before Python, or lslam in it, listens.
UNHEARD = {signal.SIGINT: (-signal.SIGINT, 1), signal.SIGTERM: (-signal.SIGTERM,)}


@dataclass(frozen=True)
class Kill:
    """A signal, so many seconds after a stage began."""

    number: signal.Signals
    seconds: float
    stage: str = START


@dataclass
class Run:
    """What became of a process.

    begun : when each stage began, s of the monotonic clock; stage : the last one before the signal; code : of `subprocess`
    is_hit : whether the signal found it there; answer : s from the signal to its end; said : on stderr
    left, manifest : what it found of an earlier one: locks and half-written files, and manifest.json
    """

    begun: dict[str, float] = field(default_factory=dict)
    stage: str = START
    code: int = 0
    is_hit: bool = False
    left: frozenset[Path] = frozenset()
    manifest: bytes = b""
    answer: float = 0.0
    said: str = ""

    @property
    def lengths(self) -> dict[str, float]:
        """Seconds of each stage, in their order."""
        times = sorted(self.begun.values())
        return {stage: b - a for (stage, a), b in zip(self.begun.items(), times[1:], strict=False)}


def run(drive: str, place: Path, kill: Kill | None = None) -> Run:
    """Run a drive in the folder `place`, going on with what is there."""
    ears, mouth = os.pipe()
    done = Run(left=leavings(place), manifest=manifest_in(place))
    with (place / "stderr.txt").open("wb") as errors:
        began = time.monotonic()
        child = subprocess.Popen(
            [sys.executable, str(CHILD), str(mouth), *words_of(drive, OUT)],
            cwd=place, stdout=subprocess.DEVNULL, stderr=errors, pass_fds=(mouth,),
        )  # fmt: skip
    os.close(mouth)
    done.begun[START] = began
    try:
        if kill is not None and _listen(ears, done, lambda: done.begun.get(kill.stage, began + LONGEST) + kill.seconds):
            asked = time.monotonic()
            child.send_signal(kill.number)
            done.is_hit = True
        # A process that was killed may have said more than was heard; what one says that answers is of its answer.
        _listen(ears, done if kill is None or kill.number == signal.SIGKILL else Run(), lambda: began + LONGEST)
        done.begun["over"] = time.monotonic()
        done.code = child.wait(LONGEST)
    finally:
        child.kill()
        child.wait()
        os.close(ears)
    if done.is_hit:
        done.answer = time.monotonic() - asked
    done.said = (place / "stderr.txt").read_text(errors="replace")
    return done


def _listen(ears: int, done: Run, until: Callable[[], float]) -> bool:
    """Hear which stages begin until a time of the monotonic clock; False when the process ends before."""
    while select.select([ears], [], [], max(until() - time.monotonic(), 0.0))[0]:
        text = os.read(ears, 4096).decode()
        if not text:
            return False
        for stage in text.splitlines():
            done.stage = stage
            done.begun.setdefault(stage, time.monotonic())
    return True


def faults_after_kill(place: Path, done: Run, kill: Kill) -> list[str]:
    """What is wrong with the end of a run that got a signal, and with what it left."""
    out = place / OUT
    manifest = manifest_in(place)
    status = json.loads(manifest)["status"] if manifest else ""
    found = [] if not out.exists() else torn(out)
    if kill.number == signal.SIGKILL:
        return found
    if done.stage == START and done.code in UNHEARD[kill.number]:
        return found
    if done.answer > ANSWER:
        found.append(f"it took {done.answer:.1f} s to answer")
    if "Traceback" in done.said or "mistake" in done.said:
        found.append(f"it says {done.said.splitlines()[-1][:200]}")
    if done.code == 0 and status in ("done", "degraded"):
        return found  # nothing was left to do
    if done.code != 130:
        found.append(f"it ends with {done.code}, not 130")
    # Before it holds the folder it must not touch what is in there.
    is_too_early = done.stage in (START, FOLDER) and manifest == done.manifest
    if status != "interrupted" and not is_too_early:
        found.append(f"its status is {status}, not interrupted")
    return found + [f"it leaves {path.relative_to(place)}" for path in leavings(place) - done.left]


def manifest_in(place: Path) -> bytes:
    """The bytes of the run's manifest; none where there is none."""
    path = place / OUT / "manifest.json"
    return path.read_bytes() if path.is_file() else b""


def leavings(place: Path) -> frozenset[Path]:
    """What only a process that was not asked may leave."""
    return frozenset(path for path in place.rglob("*") if path.suffix == ".part" or path.name == ".lock")


def faults_at_end(place: Path, whole: Path, done: Run) -> list[str]:
    """What a run that went on to its end has otherwise than one that nobody disturbed."""
    if done.code:
        return [f"--resume ends with {done.code}: {''.join(done.said.splitlines()[-1:])[:300]}"]
    return differences(place / OUT, whole / OUT)
