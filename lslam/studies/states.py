"""How a job ended, in a small file beside its run folder; written last, so that what it says is there."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from lslam.formats.atomic import write_text
from lslam.untrusted import MISFIT, parse_json

# What a repetition would end with again; everything else is tried anew.
FINAL = ("done", "degraded", "diverged")


@dataclass(frozen=True)
class State:
    """status : `done`, `degraded`, `diverged`, `interrupted`, `failed` or `crashed`; reason : one sentence, empty when done.

    digest : of the job; jobs : runs that shared the machine; load : of the machine before the first run of the study
    seconds : of the whole run; is_alone : whether it had a core to itself, as far as the study knows; waited : share of the
        seconds in which it had none; machine : name of the host
    """

    digest: str
    status: str
    reason: str = ""
    jobs: int = 1
    load: float = 0.0
    seconds: float = 0.0
    is_alone: bool = True
    waited: float = 0.0
    machine: str = ""


def write_state(path: Path, state: State) -> None:
    """Write the file atomically; raises OutputError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, json.dumps(asdict(state), indent=1) + "\n")


def read_state(path: Path) -> State | None:
    """The state; None when there is none that can be read."""
    try:
        tree = parse_json(path.read_text(encoding="utf-8"))
        return State(
            str(tree["digest"]), str(tree["status"]), str(tree["reason"]), int(tree["jobs"]), float(tree["load"]),
            float(tree["seconds"]), bool(tree["is_alone"]), float(tree["waited"]), str(tree["machine"]),
        )  # fmt: skip
    except (OSError, *MISFIT):
        return None


def is_reusable(path: Path, folder: Path, digest: str) -> bool:
    """Whether the job was finished before, by the same configuration, input and version, and its folder is still there."""
    state = read_state(path)
    return (
        state is not None and state.digest == digest and state.status in FINAL and (folder / "manifest.json").is_file()
    )
